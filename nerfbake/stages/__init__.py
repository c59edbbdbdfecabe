"""Verbs: one pure function a file, named <from>_to_<to>.py, so that the listing is the pipeline graph."""
