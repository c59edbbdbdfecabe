"""Coding of numbers as bits."""
