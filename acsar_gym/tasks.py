"""Tasks: goals, observation, reward and end of an episode, as pure functions of numbers.

Everything here sees odometry only, so it is the same in simulation and on hardware.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.worlds import Pose

Observation = NDArray[np.float32]
Goal = tuple[float, float]

POINT_GOAL_LAYOUT = (
    "goal_distance",
    "goal_cos",
    "goal_sin",
    "linear_velocity",
    "angular_velocity",
    "last_linear",
    "last_angular",
)
"""Names of the observation's numbers, in order; a trained policy's file carries them."""
OBSERVATION_LIMIT = 2.0
"""Scaled distance and speeds are clipped to this, which bounds the observation space."""


class Outcome(Enum):
    """Whether and how an episode has ended."""

    GOING = "going"
    SUCCESS = "success"
    OUT_OF_BOUNDS = "out_of_bounds"


@dataclass(frozen=True, slots=True)
class PointGoal:
    """Reach a point of the odometry frame. Lengths in m, speeds in m/s and rad/s."""

    min_distance: float = 0.5
    """Goals are drawn at least this far from the start."""
    max_distance: float = 3.0
    """Goals are drawn at most this far from the start; also scales the observed distance."""
    tolerance: float = 0.15
    """An odometry position this close to the goal is a success."""
    max_linear: float = 0.5
    """Scales the observed linear velocity."""
    max_angular: float = 1.5
    """Scales the observed angular velocity."""

    def __post_init__(self) -> None:
        if not 0.0 < self.tolerance < self.min_distance <= self.max_distance < math.inf:
            raise ConfigError(
                f"goal_tolerance = {self.tolerance}, goal_distance = ({self.min_distance}, "
                f"{self.max_distance}): must be 0 < tolerance < nearest <= farthest [m]"
            )

    @property
    def boundary(self) -> float:
        """An episode ends without success this far from the start [m]."""
        return OBSERVATION_LIMIT * self.max_distance

    def sample_goal(self, rng: np.random.Generator) -> Goal:
        """A goal in any direction, its distance uniform between the two limits."""
        distance = rng.uniform(self.min_distance, self.max_distance)
        bearing = rng.uniform(-math.pi, math.pi)
        return (distance * math.cos(bearing), distance * math.sin(bearing))

    def check_goal(self, goal: Goal) -> Goal:
        """The goal as floats; ConfigError if it is malformed or out of range."""
        try:
            x, y = (float(value) for value in goal)
        except (TypeError, ValueError):
            raise ConfigError(f"goal = {goal!r}: must be two numbers (x, y) [m]") from None
        if not self.min_distance <= math.hypot(x, y) <= self.max_distance:
            raise ConfigError(
                f"goal = ({x:g}, {y:g}): must lie {self.min_distance:g} to {self.max_distance:g} m "
                "from the start (set goal_distance to change that)"
            )
        return (x, y)

    def observe(
        self, pose: Pose, twist: tuple[float, float], goal: Goal, last_action: tuple[float, float]
    ) -> Observation:
        """float32 of shape (7,), laid out as POINT_GOAL_LAYOUT; distance and speeds scaled."""
        x, y, theta = pose
        bearing = math.atan2(goal[1] - y, goal[0] - x) - theta
        return np.array(
            (
                _clipped(goal_distance(pose, goal) / self.max_distance),
                math.cos(bearing),
                math.sin(bearing),
                _clipped(twist[0] / self.max_linear),
                _clipped(twist[1] / self.max_angular),
                last_action[0],
                last_action[1],
            ),
            np.float32,
        )

    def outcome(self, pose: Pose, goal: Goal) -> Outcome:
        """Success within the tolerance, out of bounds beyond the boundary."""
        if goal_distance(pose, goal) <= self.tolerance:
            return Outcome.SUCCESS
        if math.hypot(pose[0], pose[1]) > self.boundary:
            return Outcome.OUT_OF_BOUNDS
        return Outcome.GOING


def goal_distance(pose: Pose, goal: Goal) -> float:
    """Straight-line distance to the goal [m]."""
    return math.hypot(goal[0] - pose[0], goal[1] - pose[1])


def point_goal_reward(before: float, after: float, linear: float, outcome: Outcome) -> float:
    """Twice the metres gained on the goal, less 0.02 a step and up to 0.05 for driving backwards.

    Plus 2 at the goal, or -2 beyond the boundary. `before` and `after` are goal distances [m],
    `linear` is the action's linear part in [-1, 1]. Backwards costs, because sensors look ahead.
    """
    end = {Outcome.GOING: 0.0, Outcome.SUCCESS: 2.0, Outcome.OUT_OF_BOUNDS: -2.0}
    return 2.0 * (before - after) - 0.02 + 0.05 * min(linear, 0.0) + end[outcome]


def _clipped(value: float) -> float:
    return min(max(value, -OBSERVATION_LIMIT), OBSERVATION_LIMIT)
