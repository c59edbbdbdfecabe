"""Read and write the cameras of captures."""
