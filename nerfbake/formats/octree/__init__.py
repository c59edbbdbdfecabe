"""Octrees as bytes."""
