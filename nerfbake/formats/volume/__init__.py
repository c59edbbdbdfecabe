"""Read and write VDB grids as NanoVDB, OpenVDB and NumPy files."""
