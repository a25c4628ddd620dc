"""Recordings and live drives in Rerun's viewer."""
