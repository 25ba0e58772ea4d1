"""Other methods, trained on the same Gaussians and masks."""
