"""Encoders and decoders of octree formats."""
