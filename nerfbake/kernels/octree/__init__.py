"""Arrays of trees with 2^3 or N^3 children per node."""
