"""Files of 3D Gaussians."""
