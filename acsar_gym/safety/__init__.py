"""What stands between a wanted twist and the wheels."""
