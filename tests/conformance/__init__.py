"""Frozen files of every format that is written, with what a reader of them must find beside them in JSON."""
