"""Scene types: frozen dataclasses of arrays that check their shapes, their order and their values."""
