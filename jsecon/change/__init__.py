"""What changed in a scene since it was made."""
