"""Scenes with true labels, seen by simulated vision, and their votes: what the experiments on single ideas share."""
