"""Benchmark of the octree formats and of their libraries."""
