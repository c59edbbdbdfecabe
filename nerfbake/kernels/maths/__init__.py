"""Mathematical functions with the same result on every processor."""
