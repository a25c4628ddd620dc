"""Worlds: obstacles, start and goal of a robot, in frames of REP 105 (x, y [m], theta [rad]).

Example:
    >>> from acsar_gym import worlds
    >>> walker = worlds.walk([[2.0, -1.0], [2.0, 1.0]], speed=0.5)
    >>> goal = worlds.Region(4.0, 0.0)
    >>> world = worlds.World(circles=[[3.0, 0.0, 0.2]], movers=[walker], goal=goal)
    >>> world.obstacles, len(world.movers)
    (1, 1)
"""

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
