"""The octree in every format and by every library."""
