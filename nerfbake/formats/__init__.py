"""Bytes: encode(scene) yields buffers, decode(view) gives the scene back; <scene>_<format>.py."""
