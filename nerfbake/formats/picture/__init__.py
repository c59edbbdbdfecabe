"""Pictures and depth as bytes."""
