"""What compressed octrees cost in bytes and in pictures."""
