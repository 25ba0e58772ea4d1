"""Readers and writers of captures, masks, labels and files of Gaussians, all on the host."""
