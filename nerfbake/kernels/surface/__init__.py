"""Triangles, their textures, and directions on the sphere."""
