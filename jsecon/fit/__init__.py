"""Gaussians from images: where they start (initialise, triangulate), what they are fitted to (photometric), how
(optimise)."""
