"""Fitting to one's own photographs: how good how soon, and what the field costs in each structure."""
