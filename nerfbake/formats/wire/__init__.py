"""Formats of bytes that know no scene: containers, codecs, number encodings."""
