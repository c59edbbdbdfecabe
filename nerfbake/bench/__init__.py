"""Measuring, and saying what was measured."""
