"""Splatting: project, list tiles, composite front to back, and the readable float64 twin that defines the image."""
