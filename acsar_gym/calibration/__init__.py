"""Measures wheel radii and the turn factor of a robot on the floor."""
