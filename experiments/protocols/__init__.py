"""How others measure."""
