"""Benchmark of fits on NeRF-Synthetic, beside published figures."""
