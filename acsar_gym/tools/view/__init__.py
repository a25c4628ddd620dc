"""The dashboard: a page on loopback that shows a recording, also while it is being written."""
