"""Training of policies with stable-baselines3 on batches of robots."""
