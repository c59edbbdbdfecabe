"""Gaussian splats as arrays: their densities in a grid of voxels, and their pictures."""
