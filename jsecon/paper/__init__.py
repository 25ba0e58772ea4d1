"""The published method (arXiv 2503.21767): masklets, region embeddings, codes, distillation, queries on codes."""
