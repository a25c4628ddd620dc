"""Fits the twin's motors, delays and encoders to what went over the wire."""
