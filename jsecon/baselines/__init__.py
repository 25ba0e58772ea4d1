"""Rivals, on the same Gaussians and masks as jsecon's own field and on the same engine: one file a method."""
