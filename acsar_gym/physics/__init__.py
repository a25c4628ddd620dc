"""Dynamics: the motor and tyre model, and how a robot's physics varies between episodes."""

from acsar_gym.config.physics import Physics
from acsar_gym.physics.model import GRAVITY, compute_physics
from acsar_gym.physics.randomization import Randomization

__all__ = ["GRAVITY", "Physics", "Randomization", "compute_physics"]
