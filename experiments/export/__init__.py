"""Graphs of the official CLIP, SAM and SAM 2 packages, and the check that they compute the same."""
