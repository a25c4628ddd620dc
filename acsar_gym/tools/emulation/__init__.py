"""Emulated board and LiDAR on pseudo-terminals, for running without hardware."""
