"""Rays through cells."""
