"""Trilinear reads of one scene in every structure."""
