"""Octahedral atlases as bytes."""
