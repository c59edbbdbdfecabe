"""USD stages as bytes: a model of what is written, the three containers, and the reader."""
