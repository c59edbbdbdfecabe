"""Lattices of values: interpolation between nodes, samples along rays, and colours of nodes."""
