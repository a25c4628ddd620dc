"""Recordings of episodes in MCAP files: writer, reader, exports."""
