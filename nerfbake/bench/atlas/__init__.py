"""Octahedral atlases in every method and size."""
