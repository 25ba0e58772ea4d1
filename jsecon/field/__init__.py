"""Language fields: regions, votes and their file."""
