"""Range sensors, simulated and real."""
