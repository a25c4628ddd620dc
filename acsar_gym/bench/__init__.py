"""Speed: of environments, batches and worlds, side by side with another version."""
