"""Kernels that fit a sparse field to pictures: bricks, rays through them, and optimisation steps."""
