"""VDB grids as bytes."""
