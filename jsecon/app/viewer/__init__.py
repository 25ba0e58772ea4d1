"""The viewer: a field in a browser, and as one HTML file."""
