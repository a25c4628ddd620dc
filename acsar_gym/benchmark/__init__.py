"""Compare agents over scenes, seeds and conditions, and write the table."""
