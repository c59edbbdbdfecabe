"""Pages for people as bytes."""
