"""Tasks with a goal behind obstacles: a cluttered floor, or the worlds of BARN.

The robot sees with a LiDAR and remembers in a map what it has seen; reward counts the way to the
goal over that map, so that turning back in a dead end pays.

The score of the BARN challenge (Xiao et al., ICRA 2022) for one run is

    score = success * OT / clip(AT, k * OT, 8 * OT)

OT, the optimal time, is the length of the world's own path divided by a reference speed. AT is
the time that the run took.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from acsar_gym.errors import ConfigError
from acsar_gym.jit import compilable
from acsar_gym.sensors import MAP
from acsar_gym.sensors.map.sensor import (
    FARTHEST_CLEARANCE,
    FIRST_SECTOR,
    GAINED,
    SECTORS,
    SLIDE_ACCELERATION,
    STALLED,
    log_share,
)
from acsar_gym.tasks.goal import GoalTask, goal_distance
from acsar_gym.tasks.options import check_positive
from acsar_gym.tasks.state import State
from acsar_gym.tasks.task import Outcome

BARN_TOLERANCE = 1.0  # the run is a success once odometry is this close to the goal [m]
CHALLENGE_SPEED = 2.0  # the reference speed of the challenge [m/s]
BARN_SCORES = ("barn_score", "barn_score_k4", "barn_score_own", "barn_score_own_k4")
"""Names of the four scores in info: k = 2 (since 2024) and k = 4 (2022), each with the
challenge's reference speed of 2 m/s and with the robot's own top speed."""


@compilable
def barn_score(success: float, time: float, length: float, speed: float, k: float) -> float:
    """Compute the score of one run.

    Args:
        success: 1 for a run that reached the goal, otherwise 0.
        time: that the run took [s].
        length: of the world's own path from start to goal [m]; NaN where there is none.
        speed: reference speed of the optimal time [m/s].
        k: a run faster than k times the optimal time earns no more.

    Returns:
        0 to 1 / k; NaN where `length` is NaN.
    """
    optimal = length / speed
    if math.isnan(optimal):
        return optimal
    return success * optimal / min(max(time, k * optimal), 8.0 * optimal)


NEAR_SHARE = log_share(0.5, FARTHEST_CLEARANCE)
"""Less clearance than this costs reward: half a radius of the footprint, as the map observes it."""


class NavigationTask(GoalTask):
    """Base of the tasks with a goal behind obstacles, which the robot sees with a LiDAR."""

    sensors: tuple[Any, ...] = ("map", "lidar")
    memory: ClassVar[Mapping[str, float]] = {"goal_distance": 0.0}
    told: ClassVar[tuple[str, ...] | None] = ("goal_distance",)
    compiled = True
    crash: float = 15.0
    """What a collision costs; more than the goal pays, so that haste isn't worth the risk."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Check that the robot has a map, whose numbers the reward reads. ConfigError without."""
        super().__init_subclass__(**options)
        if MAP not in cls.sensors:
            raise ConfigError(f"{cls.__name__}.sensors = {cls.sensors!r}: must name {MAP!r}")

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `navigation_reward`."""
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
        return navigation_reward(state, outcome, self.end, self.crash)


@dataclass(frozen=True, kw_only=True)
class ObstacleGoal(NavigationTask):
    """Reach a point among obstacles, with a LiDAR."""

    id = "acsar_gym/ObstacleGoal-v1"
    worlds = "clutter:train"
    goal_tolerance: float = 0.3
    """Radius of the goal [m]."""

    def __post_init__(self) -> None:
        tolerance = check_positive("goal_tolerance", self.goal_tolerance)
        object.__setattr__(self, "goal_tolerance", tolerance)


class Barn(NavigationTask):
    """Drive 10 m through a field of cylinders (BARN), with a LiDAR; info has the score."""

    id = "acsar_gym/Barn-v1"
    worlds = "barn:train"
    goal_tolerance = BARN_TOLERANCE
    memory: ClassVar[Mapping[str, float]] = {
        **NavigationTask.memory,
        **dict.fromkeys(BARN_SCORES, 0.0),
    }
    told: ClassVar[tuple[str, ...] | None] = ("goal_distance", *BARN_SCORES)
    compiled = True

    def begin(self, state: State, memory: Any) -> None:
        """Remember the distance to the goal; the scores are zero until it is reached."""
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
        store_scores(state, memory, 0)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `navigation_reward`; remembers the scores."""
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
        store_scores(state, memory, outcome)
        return navigation_reward(state, outcome, self.end, self.crash)


# The functions below are compiled for batches, too.


@compilable
def navigation_reward(state: State, outcome: int, end: float, crash: float) -> float:
    """Reward of a step towards a goal behind obstacles.

        0.1 gained - 0.04 - 0.1 stalled - 0.15 near - 0.1 slide + 0.05 min(linear, 0)
            + (end, -crash or 0)

    `gained` is how much shorter the way to the goal is after the step, by the robot's map, in parts
    of what its top speed would give. `stalled` grows to 1 in 50 steps in which the way doesn't
    become shorter. `near` is 0 where the footprint's least clearance is half its radius or more,
    and 1 where it touches something. `slide` is by how much the acceleration sideways is over
    0.7 m/s^2, at most 2, because tyres slide there and odometry drifts. Driving backwards costs up
    to 0.05 a step, because sensors look ahead.

    Args:
        state: after the step; `sensed` begins with the numbers of the map.
        outcome: number of the step's Outcome.
        end: added at success.
        crash: subtracted for a collision.
    """
    least = NEAR_SHARE
    for n in range(FIRST_SECTOR, FIRST_SECTOR + SECTORS):
        least = min(least, float(state.sensed[n]))
    last = end if outcome == 1 else (-crash if outcome > 1 else 0.0)
    slide = max(abs(state.twist[0] * state.twist[1]) - SLIDE_ACCELERATION, 0.0)
    costs = 0.04 + 0.15 * (1.0 - least / NEAR_SHARE) - 0.05 * min(state.action[0], 0.0)
    costs += 0.1 * min(slide, 2.0) + 0.1 * float(state.sensed[STALLED])
    return 0.1 * float(state.sensed[GAINED]) - costs + last


@compilable
def store_scores(state: State, memory: Any, outcome: int) -> None:
    """Write BARN's scores of the run so far into the memory; zeros without success."""
    success, own = 1.0 if outcome == 1 else 0.0, state.max_twist[0]
    time, length = state.time, state.length
    memory.barn_score = barn_score(success, time, length, CHALLENGE_SPEED, 2.0)
    memory.barn_score_k4 = barn_score(success, time, length, CHALLENGE_SPEED, 4.0)
    memory.barn_score_own = barn_score(success, time, length, own, 2.0)
    memory.barn_score_own_k4 = barn_score(success, time, length, own, 4.0)
