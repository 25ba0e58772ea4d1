"""Vision simulated from true instance labels: for experiments and tests."""
