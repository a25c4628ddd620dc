"""Tasks among people: a room that others walk through, and the moving obstacles of DynaBARN.

They are tasks with a goal behind obstacles, see `navigation`, in worlds whose movers a robot sees
with its LiDAR alone. Whoever comes too near to somebody pays for it, by what the robot observes.
"""

from __future__ import annotations

from typing import Any

from acsar_gym.sensors import MAP
from acsar_gym.tasks.goal import goal_distance
from acsar_gym.tasks.navigation import BARN_TOLERANCE, NavigationTask, navigation_reward
from acsar_gym.tasks.state import State
from acsar_gym.tasks.task import Outcome


class Crowd(NavigationTask):
    """Reach a point in a room that people walk through, with a LiDAR."""

    id = "acsar_gym/Crowd-v0"
    worlds = "crowd:train"
    goal_tolerance = 0.5


class DynaBarn(Crowd):
    """Drive 20 m through obstacles that move (DynaBARN), with a LiDAR."""

    id = "acsar_gym/DynaBarn-v0"
    worlds = "dynabarn:train"
    goal_tolerance = BARN_TOLERANCE
