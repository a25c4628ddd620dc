"""The pages of `gap` and `compare`."""
