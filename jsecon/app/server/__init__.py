"""The server: fields behind HTTP."""
