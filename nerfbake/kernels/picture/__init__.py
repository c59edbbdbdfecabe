"""Pixels: metrics, palettes, letters."""
