"""The map: a sensor that remembers what the LiDAR has seen, and plans over it."""
