"""LiDARs, real and simulated, and what their measurements mean for where the robot is now."""
