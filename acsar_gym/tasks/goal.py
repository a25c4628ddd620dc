"""Tasks with a goal, and the one on an open floor.

Observation, success and bounds use odometry only, so they are the same on hardware. Only a
simulated robot knows that it has touched something: there a collision ends the episode, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from acsar_gym.errors import ConfigError
from acsar_gym.jit import compilable
from acsar_gym.tasks.options import check_distances, check_positive
from acsar_gym.tasks.state import Goal, Pose, State
from acsar_gym.tasks.task import OBSERVATION_LIMIT, Outcome, Task, clip_to, relative_point
from acsar_gym.trigonometry import cos_sin

GOAL_OBSERVATION: Mapping[str, tuple[float, float]] = {
    "goal_distance": (0.0, OBSERVATION_LIMIT),
    "goal_cos": (-1.0, 1.0),
    "goal_sin": (-1.0, 1.0),
    "linear_velocity": (-OBSERVATION_LIMIT, OBSERVATION_LIMIT),
    "angular_velocity": (-OBSERVATION_LIMIT, OBSERVATION_LIMIT),
    "last_linear": (-1.0, 1.0),
    "last_angular": (-1.0, 1.0),
}


class GoalTask(Task):
    """Base of the tasks in which the robot drives to a goal."""

    observation = GOAL_OBSERVATION
    memory: ClassVar[Mapping[str, float]] = {"goal_distance": 0.0}
    compiled = True
    scale: float = 10.0
    """Observed distances are divided by this [m]."""
    boundary: float = math.inf
    """An episode ends without success this far from the start [m]."""
    end: float = 5.0
    """Reward at the goal; a collision, or leaving the bounds, costs as much."""

    def begin(self, state: State, memory: Any) -> None:
        """Remember the distance to the goal."""
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success within the tolerance, out of bounds beyond the boundary, collision by contact."""
        x, y, _ = state.pose
        if state.contact:
            return Outcome.COLLISION
        if goal_distance(x, y, state.goal) <= self.goal_tolerance:
            return Outcome.SUCCESS
        return Outcome.OUT_OF_BOUNDS if math.sqrt(x * x + y * y) > self.boundary else Outcome.GOING

    def shortest_path(self, state: State, memory: Any) -> tuple[Goal, ...]:
        """To the goal."""
        return (state.goal,)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Reward of the step, see `goal_reward`; remembers the distance to the goal."""
        before = memory.goal_distance
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
        return goal_reward(before, memory.goal_distance, state.action[0], outcome, self.end)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The numbers that GOAL_OBSERVATION names; distance and speeds are scaled."""
        return goal_numbers(
            state.pose, state.twist, state.goal, (self.scale, *state.max_twist), state.action
        )


@dataclass(frozen=True, kw_only=True)
class PointGoal(GoalTask):
    """Reach a point on an open floor."""

    id = "acsar_gym/PointGoal-v0"
    goal_distance: tuple[float, float] = (0.5, 3.0)
    """Nearest and farthest goal [m]."""
    goal_tolerance: float = 0.15
    """Radius of the goal [m]."""
    distance_scale: float | None = None
    """Observed distances are divided by this [m]; None: by the distance of the farthest goal."""
    end = 2.0

    def __post_init__(self) -> None:
        limits = check_distances(self.goal_distance)
        tolerance = check_positive("goal_tolerance", self.goal_tolerance)
        if tolerance >= limits[0]:
            raise ConfigError(
                f"goal_tolerance = {tolerance:g}: must be below the nearest goal_distance, "
                f"{limits[0]:g} m"
            )
        object.__setattr__(self, "goal_distance", limits)
        object.__setattr__(self, "goal_tolerance", tolerance)
        if self.distance_scale is not None:
            scale = check_positive("distance_scale", self.distance_scale)
            object.__setattr__(self, "distance_scale", scale)

    @property
    def scale(self) -> float:  # type: ignore[override]
        """What observed distances are divided by [m]."""
        return self.goal_distance[1] if self.distance_scale is None else self.distance_scale

    @property
    def boundary(self) -> float:  # type: ignore[override]
        """Twice the largest goal distance [m]."""
        return OBSERVATION_LIMIT * self.goal_distance[1]


# The functions below take and return scalars, so that numba can compile them for batches.


@compilable
def goal_numbers(
    pose: Pose,
    twist: tuple[float, float],
    goal: Goal,
    scales: tuple[float, float, float],
    action: tuple[float, float],
) -> tuple[float, float, float, float, float, float, float]:
    """Compute the numbers that GOAL_OBSERVATION names."""
    x, y, theta = pose
    cos, sin = cos_sin(theta)
    ahead, left = relative_point(x, y, cos, sin, goal[0], goal[1])
    distance = goal_distance(x, y, goal)
    near = max(distance, 1e-12)
    return (
        min(distance / scales[0], OBSERVATION_LIMIT),
        clip_to(ahead / near, 1.0),
        clip_to(left / near, 1.0),
        clip_to(twist[0] / scales[1], OBSERVATION_LIMIT),
        clip_to(twist[1] / scales[2], OBSERVATION_LIMIT),
        action[0],
        action[1],
    )


@compilable
def goal_distance(x: float, y: float, goal: Goal) -> float:
    """Straight-line distance to the goal [m]."""
    dx, dy = goal[0] - x, goal[1] - y
    return math.sqrt(dx * dx + dy * dy)


@compilable
def goal_reward(before: float, after: float, linear: float, outcome: int, end: float) -> float:
    """Reward of a step towards a goal.

        2 (before - after) - 0.02 + 0.05 min(linear, 0) + (end, -end or 0)

    Driving backwards costs up to 0.05 a step, because sensors look ahead.

    Args:
        before: distance to the goal before the step [m].
        after: distance to the goal after it [m].
        linear: the action's linear part, in [-1, 1].
        outcome: number of the step's Outcome.
        end: added at success, subtracted for a collision or beyond the boundary.
    """
    last = end if outcome == 1 else (-end if outcome > 1 else 0.0)
    return 2.0 * (before - after) - 0.02 + 0.05 * min(linear, 0.0) + last
