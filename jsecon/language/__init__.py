"""The language field: masklets, regions, votes, codes, their distillation, and the file that holds it all."""
