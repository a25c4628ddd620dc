"""Tasks among people: a hall that others walk through, and the moving obstacles of DynaBARN.

They are tasks with a goal behind obstacles, see `navigation`, in worlds whose movers a robot sees
with its LiDAR alone. Coming close to a person costs reward, by what the robot observes of them.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

from acsar_gym.jit import compilable
from acsar_gym.sensors import MAP, MOVERS
from acsar_gym.sensors.map.movers import MOST_MOVERS, MOST_RADIUS, NUMBERS
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, MAP_NAMES, length_of_share
from acsar_gym.tasks.goal import goal_distance
from acsar_gym.tasks.navigation import (
    BARN_TOLERANCE,
    NavigationTask,
    NavigationWeights,
    navigation_reward,
)
from acsar_gym.tasks.state import State
from acsar_gym.tasks.task import Outcome
from acsar_gym.worlds.crowd import PERSONAL_SPACE

FIRST_MOVER = len(MAP_NAMES)
"""Place of the first number of the first mover in `State.sensed`."""
AHEAD, LEFT, RADIUS, MOVES = (NUMBERS.index(name) for name in ("x", "y", "radius", "moves"))
"""Places of a mover's numbers among its own."""
TOP_SPEED = MAP_NAMES.index("top_speed")
"""Place of the robot's top speed there, in ten radii of its footprint a second."""


_make_class: Any = namedtuple  # mypy can't follow fields of another class
CrowdWeights = _make_class(
    "CrowdWeights",
    [*NavigationWeights._fields, "crowding"],
    defaults=[*NavigationWeights(), 0.1],
)
"""`NavigationWeights`, and `crowding`: the cost of touching a person's hull. It falls to 0 at the
edge of their personal space."""


class Crowd(NavigationTask):
    """Reach a point in a hall that people walk through, with a LiDAR.

    Example:
        >>> from acsar_gym import RobotEnv
        >>> from acsar_gym.tasks import Crowd
        >>> env = RobotEnv(Crowd, link="planar", worlds="crowd:2")
        >>> env.reset(seed=0)[1]["person_contact"]
        0.0
        >>> env.close()
    """

    id = "acsar_gym/Crowd-v0"
    worlds = "crowd:train"
    sensors: tuple[Any, ...] = ("map", "movers", "lidar")
    needs = (MAP, MOVERS)
    goal_tolerance = 0.5
    compiled = True
    weights: Any = CrowdWeights()

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step: `navigation_reward` less what `crowding` costs."""
        memory.goal_distance = goal_distance(state.pose, state.goal)
        reward = navigation_reward(state, outcome, self.weights)
        cost: float = self.weights.crowding * crowding(state)
        return reward - cost


class DynaBarn(Crowd):
    """Drive 20 m through cylinders that move (DynaBARN), with a LiDAR.

    Example:
        >>> from acsar_gym.tasks import Crowd, DynaBarn
        >>> Crowd().weights.collision, DynaBarn().weights.collision
        (15.0, 30.0)
    """

    id = "acsar_gym/DynaBarn-v0"
    worlds = "dynabarn:train"
    goal_tolerance = BARN_TOLERANCE
    weights = CrowdWeights(collision=30.0)


@compilable
def crowding(state: State) -> float:
    """How deep the robot is in the personal space of a mover that it observes, 0 to 1, at most.

    0 where the hull of all that has moved is PERSONAL_SPACE or more away from the circle around
    the robot, and 1 where one touches it.
    """
    # The observed top speed is in ten radii of the footprint a second, so the radius follows.
    reach = state.max_twist[0] / (10.0 * float(state.sensed[TOP_SPEED]))
    deepest = 0.0
    for n in range(MOST_MOVERS):
        first = FIRST_MOVER + n * len(NUMBERS)
        # Only what has moved counts: `near` already makes standing obstacles cost.
        if state.sensed[first + MOVES] > 0.0:
            ahead = float(state.sensed[first + AHEAD])
            left_by = float(state.sensed[first + LEFT])

            # Lengths are observed on a logarithmic scale, from the robot's middle.
            share = math.sqrt(ahead * ahead + left_by * left_by)
            distance = length_of_share(share, FARTHEST_CLEARANCE)
            # In radii of the footprint, of which the robot's own circle takes 1.
            gap = distance - 1.0 - MOST_RADIUS * float(state.sensed[first + RADIUS])
            deepest = max(deepest, 1.0 - max(gap * reach / PERSONAL_SPACE, 0.0))
    return min(deepest, 1.0)
