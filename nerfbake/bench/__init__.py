"""Measurements of time, memory, size and error, and reports about them."""
