"""Tasks with a goal behind obstacles: a cluttered floor, or the worlds of BARN.

A policy without a memory of its own stands still for ever where the way to the goal is blocked:
what it sees doesn't change. So the observation tells how long the robot hasn't come nearer.

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

from acsar_gym.jit import compilable
from acsar_gym.tasks.base import OBSERVATION_LIMIT, Outcome, State, clip_to, scan_clearance
from acsar_gym.tasks.factory import check_positive
from acsar_gym.tasks.goal import (
    GOAL_OBSERVATION,
    GoalTask,
    goal_distance,
    goal_numbers,
)

BARN_TOLERANCE = 1.0
"""The run is a success once odometry is this close to the goal [m]."""
CHALLENGE_SPEED = 2.0
"""The reference speed of the challenge [m/s]."""
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


NEAR_CLEARANCE = 0.15
"""Less clearance than this costs reward [m]."""
PROGRESS_STEP = 0.05
"""The robot has come nearer once its distance to the goal is so much below the least one [m]."""
STALL_TIME = 10.0
"""Time without coming nearer that counts as 1 [s]."""
TURN_RATE_TIME = 3.0
"""Time constant of the mean turn rate [s]."""


class NavigationTask(GoalTask):
    """Base of the tasks with a goal behind obstacles, which the robot sees with a LiDAR."""

    sensors = ("lidar",)
    observation: ClassVar[Mapping[str, tuple[float, float]]] = {
        **GOAL_OBSERVATION,
        "stalled": (0.0, 1.0),
        "detour": (0.0, OBSERVATION_LIMIT),
        "turning": (-OBSERVATION_LIMIT, OBSERVATION_LIMIT),
    }
    memory: ClassVar[Mapping[str, float]] = {
        "goal_distance": 0.0,
        "least_distance": 0.0,
        "nearest_at": 0.0,
        "turn_rate": 0.0,
    }
    told: ClassVar[tuple[str, ...] | None] = ("goal_distance",)
    compiled = True
    crash: float = 15.0
    """What a collision costs; more than the goal pays, so that haste isn't worth the risk."""

    def begin(self, state: State, memory: Any) -> None:
        """Remember the distance to the goal."""
        remember_start(state, memory)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `navigation_reward`."""
        return navigation_reward(state, memory, outcome, self.end, self.crash)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The numbers of `observation`; distances and speeds are scaled."""
        scales = (self.scale, state.max_twist[0], state.max_twist[1])
        seen = goal_numbers(state.pose, state.twist, state.goal, scales, state.action)
        detour = min(max(memory.goal_distance - memory.least_distance, 0.0), OBSERVATION_LIMIT)
        turning = clip_to(memory.turn_rate / state.max_twist[1], OBSERVATION_LIMIT)
        return (*seen, stalled_share(state, memory), detour, turning)


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
        remember_start(state, memory)
        store_scores(state, memory, 0)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `navigation_reward`; remembers the scores."""
        store_scores(state, memory, outcome)
        return navigation_reward(state, memory, outcome, self.end, self.crash)


# The functions below are compiled for batches, too.


@compilable
def remember_start(state: State, memory: Any) -> None:
    """Remember the distance to the goal at a start."""
    memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
    memory.least_distance = memory.goal_distance
    memory.nearest_at = state.time
    memory.turn_rate = 0.0


@compilable
def stalled_share(state: State, memory: Any) -> float:
    """Time since the robot last came nearer to the goal, as a share of STALL_TIME, at most 1."""
    return float(min((state.time - memory.nearest_at) / STALL_TIME, 1.0))


@compilable
def navigation_reward(state: State, memory: Any, outcome: int, end: float, crash: float) -> float:
    """Reward of a step towards a goal behind obstacles; updates the memory.

        2 gained - 0.01 - 0.05 stalled - 0.15 max(0, 1 - clearance / 0.15 m)
            + 0.05 min(linear, 0) + (end, -crash or 0)

    `gained` is how much nearer the goal is after the step [m]. A gap that is hardly wider than the
    robot costs more than a detour of a metre, and standing still costs ever more. Driving backwards
    costs up to 0.05 a step, because sensors look ahead.

    Args:
        state: after the step.
        memory: of the episode.
        outcome: number of the step's Outcome.
        end: added at success.
        crash: subtracted for a collision.
    """
    gained = memory.goal_distance - goal_distance(state.pose[0], state.pose[1], state.goal)
    memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
    if memory.goal_distance < memory.least_distance - PROGRESS_STEP:
        memory.least_distance = memory.goal_distance
        memory.nearest_at = state.time
    share = min(state.period / TURN_RATE_TIME, 1.0)
    memory.turn_rate += (state.twist[1] - memory.turn_rate) * share
    near = 1.0 - scan_clearance(state.ranges, state.edges, NEAR_CLEARANCE) / NEAR_CLEARANCE
    last = end if outcome == 1 else (-crash if outcome > 1 else 0.0)
    costs = (
        0.01 + 0.05 * stalled_share(state, memory) + 0.15 * near - 0.05 * min(state.action[0], 0.0)
    )
    return float(2.0 * gained - costs + last)


@compilable
def store_scores(state: State, memory: Any, outcome: int) -> None:
    """Write BARN's scores of the run so far into the memory; zeros without success."""
    success, own = 1.0 if outcome == 1 else 0.0, state.max_twist[0]
    time, length = state.time, state.length
    memory.barn_score = barn_score(success, time, length, CHALLENGE_SPEED, 2.0)
    memory.barn_score_k4 = barn_score(success, time, length, CHALLENGE_SPEED, 4.0)
    memory.barn_score_own = barn_score(success, time, length, own, 2.0)
    memory.barn_score_own_k4 = barn_score(success, time, length, own, 4.0)
