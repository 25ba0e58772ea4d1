"""What changed in a scene since it was made."""

MIN_PROBABILITY = 0.5
"""Probability of what became of an object below which it is "unsure": neither reported nor applied as a change."""
