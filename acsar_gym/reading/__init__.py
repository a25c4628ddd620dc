"""Reads untrusted files within limits of size and depth."""
