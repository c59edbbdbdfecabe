"""Ray marching through trees of cells."""
