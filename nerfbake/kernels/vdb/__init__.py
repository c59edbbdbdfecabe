"""Arrays of VDB trees: masks, ranks, bricks."""
