"""Read and write octahedral atlases."""
