"""Containers, codecs and number encodings that do not depend on scene types."""
