"""Numbers: the same on every processor."""
