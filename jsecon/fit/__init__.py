"""Gaussians from images: their start (start, triangulate), the loss (photometric), and the fit (optimise)."""
