"""LiDARs, simulated and real."""
