"""Array maths: arrays in, arrays out, vectorised over nodes, voxels and points."""
