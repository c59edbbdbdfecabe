"""Gaussian splats: projection, sorting, blending, and their gradients."""
