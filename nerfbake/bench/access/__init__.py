"""Benchmark of trilinear reads in many data structures."""
