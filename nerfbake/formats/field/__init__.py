"""Read and write the radiance-field files of other programs."""
