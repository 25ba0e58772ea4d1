"""Readers and writers of captures, masks and files of Gaussians."""
