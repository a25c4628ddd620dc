"""Safety: limits, geofence, stale feedback and emergency stop, between a command and the wheels."""
