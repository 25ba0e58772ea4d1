"""SAM: masks of one frame."""
