"""What other programs train, made of a scene that is there: files to measure reading and baking with."""
