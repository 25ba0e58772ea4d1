"""SAM 2: masks followed through the frames."""
