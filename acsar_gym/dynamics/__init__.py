"""Dynamics: the motor and tyre model, and how a robot's physics varies between episodes."""

from acsar_gym.dynamics.model import GRAVITY, Physics, physics
from acsar_gym.dynamics.randomization import Randomization

__all__ = ["GRAVITY", "Physics", "Randomization", "physics"]
