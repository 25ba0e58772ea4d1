"""Stiff and extreme scenes, a row each."""
