"""Conversions between scenes: pure functions in files named <from>_to_<to>.py, so the listing is the pipeline graph."""
