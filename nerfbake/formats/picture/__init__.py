"""Encoders and decoders of pictures and depth."""
