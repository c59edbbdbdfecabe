"""Cameras of captures as bytes."""
