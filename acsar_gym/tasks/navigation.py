"""Tasks with a goal behind obstacles: a cluttered floor, or the worlds of BARN.

A policy without a memory of its own stands still for ever where the way to the goal is blocked:
what it sees doesn't change. So the observation tells how long the robot hasn't come nearer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from acsar_gym.jit import compilable
from acsar_gym.tasks import barn
from acsar_gym.tasks.base import OBSERVATION_LIMIT, Outcome, State, clearance, clipped
from acsar_gym.tasks.goal import (
    GOAL_OBSERVATION,
    GoalTask,
    goal_distance,
    goal_numbers,
)
from acsar_gym.tasks.options import positive

NEAR = 0.15
"""Less clearance than this costs reward [m]."""
NEARER = 0.05
"""The robot has come nearer once its distance to the goal is so much below the least one [m]."""
PATIENCE = 10.0
"""Time without coming nearer that counts as 1 [s]."""
TURNING = 3.0
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
        begun(state, memory)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `navigation_reward`."""
        return navigation_reward(state, memory, outcome, self.end, self.crash)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The numbers of `observation`; distances and speeds are scaled."""
        scales = (self.scale, state.max_twist[0], state.max_twist[1])
        seen = goal_numbers(state.pose, state.twist, state.goal, scales, state.action)
        detour = min(max(memory.goal_distance - memory.least_distance, 0.0), OBSERVATION_LIMIT)
        turning = clipped(memory.turn_rate / state.max_twist[1], OBSERVATION_LIMIT)
        return (
            seen[0],
            seen[1],
            seen[2],
            seen[3],
            seen[4],
            seen[5],
            seen[6],
            stalled(state, memory),
            detour,
            turning,
        )


@dataclass(frozen=True, kw_only=True)
class ObstacleGoal(NavigationTask):
    """Reach a point among obstacles, with a LiDAR."""

    id = "acsar_gym/ObstacleGoal-v1"
    worlds = "clutter:train"
    goal_tolerance: float = 0.3
    """Radius of the goal [m]."""

    def __post_init__(self) -> None:
        tolerance = positive("goal_tolerance", self.goal_tolerance)
        object.__setattr__(self, "goal_tolerance", tolerance)


class Barn(NavigationTask):
    """Drive 10 m through a field of cylinders (BARN), with a LiDAR; info has the score."""

    id = "acsar_gym/Barn-v1"
    worlds = "barn:train"
    goal_tolerance = barn.TOLERANCE
    memory: ClassVar[Mapping[str, float]] = {
        **NavigationTask.memory,
        **dict.fromkeys(barn.SCORES, 0.0),
    }
    told: ClassVar[tuple[str, ...] | None] = ("goal_distance", *barn.SCORES)
    compiled = True

    def begin(self, state: State, memory: Any) -> None:
        """Remember the distance to the goal; the scores are zero until it is reached."""
        begun(state, memory)
        score(state, memory, 0)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `navigation_reward`; remembers the scores."""
        score(state, memory, outcome)
        return navigation_reward(state, memory, outcome, self.end, self.crash)


# The functions below are compiled for batches, too.


@compilable
def begun(state: State, memory: Any) -> None:
    """Remember the distance to the goal at a start."""
    memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
    memory.least_distance = memory.goal_distance
    memory.nearest_at = state.time
    memory.turn_rate = 0.0


@compilable
def followed(state: State, memory: Any) -> float:
    """Update the memory after a step; returns how much nearer the goal is [m]."""
    before = memory.goal_distance
    memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
    if memory.goal_distance < memory.least_distance - NEARER:
        memory.least_distance = memory.goal_distance
        memory.nearest_at = state.time
    memory.turn_rate += (state.twist[1] - memory.turn_rate) * min(state.period / TURNING, 1.0)
    return float(before - memory.goal_distance)


@compilable
def stalled(state: State, memory: Any) -> float:
    """Time since the robot last came nearer to the goal, as a share of PATIENCE, at most 1."""
    return float(min((state.time - memory.nearest_at) / PATIENCE, 1.0))


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
    gained = followed(state, memory)
    near = 1.0 - clearance(state.ranges, state.edges, NEAR) / NEAR
    last = end if outcome == 1 else (-crash if outcome > 1 else 0.0)
    costs = 0.01 + 0.05 * stalled(state, memory) + 0.15 * near - 0.05 * min(state.action[0], 0.0)
    return float(2.0 * gained - costs + last)


@compilable
def score(state: State, memory: Any, outcome: int) -> None:
    """Write BARN's scores of the run so far into the memory; zeros without success."""
    success = 1.0 if outcome == 1 else 0.0
    s2, s4, own2, own4 = barn.scores(success, state.time, state.length, state.max_twist[0])
    memory.barn_score, memory.barn_score_k4 = s2, s4
    memory.barn_score_own, memory.barn_score_own_k4 = own2, own4
