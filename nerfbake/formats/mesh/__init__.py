"""Read and write triangle meshes."""
