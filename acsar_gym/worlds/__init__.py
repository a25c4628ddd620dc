"""Worlds: obstacles, start and goal of a robot, in frames of REP 105 (x, y [m], theta [rad])."""

from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, walk
from acsar_gym.worlds.registry import register
from acsar_gym.worlds.world import Pose, Region, Scene, World

__all__ = [
    "Mover",
    "Pose",
    "Region",
    "Repeat",
    "Scene",
    "World",
    "follow_keys",
    "register",
    "walk",
]
