"""From a capture to a language field: the stages of a run, what they keep on disk, and what a run is told."""
