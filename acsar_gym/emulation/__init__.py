"""A board and a LiDAR on pseudo-terminals, for driving without hardware."""
