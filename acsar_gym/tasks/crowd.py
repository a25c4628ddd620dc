"""Tasks among people: a hall that others walk through, and the moving obstacles of DynaBARN.

They are tasks with a goal behind obstacles, see `navigation`, in worlds whose movers a robot sees
with its LiDAR alone. Coming close to somebody costs reward, by what the robot observes of them.
"""

from __future__ import annotations

import math
from typing import Any

from acsar_gym.errors import ConfigError
from acsar_gym.jit import compilable
from acsar_gym.sensors import MOVERS
from acsar_gym.sensors.map.movers import MOST_MOVERS, MOST_RADIUS, NUMBERS
from acsar_gym.sensors.map.sensor import FARTHEST_CLEARANCE, MAP_NAMES, length_of_share
from acsar_gym.tasks.goal import goal_distance
from acsar_gym.tasks.navigation import BARN_TOLERANCE, NavigationTask, navigation_reward
from acsar_gym.tasks.state import State
from acsar_gym.tasks.task import Outcome
from acsar_gym.worlds.crowd import PERSONAL_SPACE

FIRST_MOVER = len(MAP_NAMES)
"""Place of the first number of the first mover in `State.sensed`."""
AHEAD, LEFT, RADIUS, MOVES = (NUMBERS.index(name) for name in ("x", "y", "radius", "moves"))
"""Places of a mover's numbers among its own."""
TOP_SPEED = MAP_NAMES.index("top_speed")
"""Place of the robot's top speed there, in ten radii of its footprint a second."""
CROWDING_COST = 0.1
"""What a step costs in which the robot touches somebody's hull."""


class Crowd(NavigationTask):
    """Reach a point in a hall that people walk through, with a LiDAR."""

    id = "acsar_gym/Crowd-v0"
    worlds = "crowd:train"
    sensors: tuple[Any, ...] = ("map", "movers", "lidar")
    goal_tolerance = 0.5
    compiled = True

    def __init_subclass__(cls, **options: Any) -> None:
        """Raise ConfigError if the robot doesn't sense movers, whose numbers the reward reads."""
        super().__init_subclass__(**options)
        if MOVERS not in cls.sensors:
            raise ConfigError(f"{cls.__name__}.sensors = {cls.sensors!r}: must name {MOVERS!r}")

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step: `navigation_reward` less CROWDING_COST times `crowding`."""
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
        cost = CROWDING_COST * crowding(state)
        return navigation_reward(state, outcome, self.end, self.crash) - cost


class DynaBarn(Crowd):
    """Drive 20 m through cylinders that move (DynaBARN), with a LiDAR."""

    id = "acsar_gym/DynaBarn-v0"
    worlds = "dynabarn:train"
    goal_tolerance = BARN_TOLERANCE
    crash = 30.0


@compilable
def crowding(state: State) -> float:
    """How deep the robot is in the personal space of a mover that it observes, 0 to 1, at most.

    0 where the hull of all that has moved is PERSONAL_SPACE or more away from the circle around
    the robot, and 1 where one touches it.
    """
    radius = state.max_twist[0] / (10.0 * float(state.sensed[TOP_SPEED]))
    deepest = 0.0
    for n in range(MOST_MOVERS):
        first = FIRST_MOVER + n * len(NUMBERS)
        if state.sensed[first + MOVES] > 0.0:
            ahead, left = float(state.sensed[first + AHEAD]), float(state.sensed[first + LEFT])
            share = math.sqrt(ahead * ahead + left * left)
            apart = length_of_share(share, FARTHEST_CLEARANCE)
            gap = apart - 1.0 - MOST_RADIUS * float(state.sensed[first + RADIUS])
            deepest = max(deepest, 1.0 - max(gap * radius / PERSONAL_SPACE, 0.0))
    return min(deepest, 1.0)
