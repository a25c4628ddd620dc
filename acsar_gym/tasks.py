"""Tasks: goals, observation, reward and end of an episode, as pure functions of numbers.

Everything here sees odometry only, so it is the same in simulation and on hardware.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
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


class Outcome(IntEnum):
    """Whether and how an episode has ended."""

    GOING = 0
    SUCCESS = 1
    OUT_OF_BOUNDS = 2
    COLLISION = 3


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

    @classmethod
    def of(
        cls, goal_distance: tuple[float, float], goal_tolerance: float, config: RobotConfig
    ) -> PointGoal:
        """From an env's arguments. Raises ConfigError where they make no sense."""
        try:
            nearest, farthest = (float(distance) for distance in goal_distance)
            tolerance = float(goal_tolerance)
        except (TypeError, ValueError):
            raise ConfigError(
                f"goal_distance = {goal_distance!r}, goal_tolerance = {goal_tolerance!r}: must be "
                "(nearest, farthest) and one number [m]"
            ) from None
        return cls(nearest, farthest, tolerance, config.max_linear, config.max_angular)

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
        return goal_at(distance, rng.uniform(-math.pi, math.pi))

    def check_goal(self, goal: Goal) -> Goal:
        """The goal as floats; ConfigError if it is malformed or out of range."""
        try:
            x, y = (float(value) for value in goal)
        except (TypeError, ValueError):
            raise ConfigError(f"goal = {goal!r}: must be two numbers (x, y) [m]") from None
        if not self.min_distance <= math.hypot(x, y) <= self.max_distance:
            raise ConfigError(
                f"goal = ({x:g}, {y:g}): must lie {self.min_distance:g} to {self.max_distance:g} m "
                "from the start (goal_distance of the env)"
            )
        return (x, y)

    def observe(
        self, pose: Pose, twist: tuple[float, float], goal: Goal, last_action: tuple[float, float]
    ) -> Observation:
        """float32 of shape (7,), laid out as POINT_GOAL_LAYOUT; distance and speeds scaled."""
        x, y, theta = pose
        c, s = math.cos(theta), math.sin(theta)
        distance, ahead, left = seen_from(x, y, c, s, goal[0], goal[1])
        scales = (self.max_distance, self.max_linear, self.max_angular)
        return np.array(
            (*point_goal_numbers(distance, ahead, left, twist, scales), *last_action), np.float32
        )

    def outcome(self, pose: Pose, goal: Goal) -> Outcome:
        """Success within the tolerance, out of bounds beyond the boundary."""
        start = math.hypot(pose[0], pose[1])
        return Outcome(
            point_goal_outcome(goal_distance(pose, goal), start, self.tolerance, self.boundary)
        )


# The functions below are compiled for whole batches of robots, too: scalars in, scalars out.


def goal_at(distance: float, bearing: float) -> Goal:
    """The point at a distance [m] and a bearing [rad] from the origin."""
    return (distance * math.cos(bearing), distance * math.sin(bearing))


def seen_from(
    x: float, y: float, cos: float, sin: float, goal_x: float, goal_y: float
) -> tuple[float, float, float]:
    """Distance to a point [m], and its bearing's cosine and sine in the frame of the pose."""
    dx, dy = goal_x - x, goal_y - y
    distance = math.sqrt(dx * dx + dy * dy)
    near = max(distance, 1e-12)
    ahead, left = (dx * cos + dy * sin) / near, (dy * cos - dx * sin) / near
    return distance, min(max(ahead, -1.0), 1.0), min(max(left, -1.0), 1.0)


def point_goal_numbers(
    distance: float,
    ahead: float,
    left: float,
    twist: tuple[float, float],
    scales: tuple[float, float, float],
) -> tuple[float, float, float, float, float]:
    """The observation's first five numbers; `scales` of distance, linear and angular velocity."""
    limit = OBSERVATION_LIMIT
    return (
        min(distance / scales[0], limit),
        ahead,
        left,
        min(max(twist[0] / scales[1], -limit), limit),
        min(max(twist[1] / scales[2], -limit), limit),
    )


def point_goal_outcome(
    distance: float, from_start: float, tolerance: float, boundary: float
) -> int:
    """The Outcome's number for a distance to the goal and one from the start [m]."""
    if distance <= tolerance:
        return 1
    return 2 if from_start > boundary else 0


def point_goal_reward(before: float, after: float, linear: float, outcome: int) -> float:
    """Twice the metres gained on the goal, less 0.02 a step and up to 0.05 for driving backwards.

    Plus 2 at the goal, or -2 beyond the boundary or for a collision. `before` and `after` are goal
    distances [m], `linear` is the action's linear part in [-1, 1]. Backwards costs, because sensors
    look ahead.
    """
    end = 2.0 if outcome == 1 else (-2.0 if outcome > 1 else 0.0)
    return 2.0 * (before - after) - 0.02 + 0.05 * min(linear, 0.0) + end


def goal_distance(pose: Pose, goal: Goal) -> float:
    """Straight-line distance to the goal [m]."""
    dx, dy = goal[0] - pose[0], goal[1] - pose[1]
    return math.sqrt(dx * dx + dy * dy)
