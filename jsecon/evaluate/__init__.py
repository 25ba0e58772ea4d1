"""Metrics and protocols; each number says in its name or its docstring how it was measured."""
