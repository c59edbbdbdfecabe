"""Radiance fields as bytes."""
