"""A sparse field that is fitted to pictures: its bricks, the rays through them, and the steps that it takes."""
