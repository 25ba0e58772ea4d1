"""Gaussians from images: their start (start, depth, triangulate), the loss (photometric), and the fit (optimise)."""
