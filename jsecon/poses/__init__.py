"""Camera poses: structure from motion, corrections, alignment."""
