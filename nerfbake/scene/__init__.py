"""Nouns: frozen dataclasses of arrays that know their shapes, their order and what is wrong with them."""
