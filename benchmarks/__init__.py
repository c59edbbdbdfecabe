"""The scripts behind every published figure."""
