"""Top views, camera pictures and windows."""
