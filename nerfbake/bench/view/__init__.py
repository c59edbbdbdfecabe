"""Pages to look around in, timed in a browser."""
