"""Batches: thousands of planar robots in one environment, simulated by compiled loops."""
