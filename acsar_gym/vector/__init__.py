"""Thousands of planar robots at once."""
