"""Triangle meshes as bytes."""
