"""Tasks with a goal, and the one on an open floor.

Observation, success and bounds use odometry only, so they are the same on hardware. Only a
simulated robot knows that it has touched something: there a collision ends the episode, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from acsar_gym.errors import ConfigError
from acsar_gym.jit import compilable
from acsar_gym.tasks.options import check_distances, store_positive
from acsar_gym.tasks.state import Goal, Pose, State
from acsar_gym.tasks.task import (
    OBSERVATION_LIMIT,
    Outcome,
    Task,
    clip_to,
    end_reward,
    relative_point,
)
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


class GoalWeights(NamedTuple):
    """Weights of the terms of the reward."""

    progress: float = 2.0
    """Reward for each metre by which the robot comes closer to the goal."""
    time: float = 0.02
    """Cost of a step."""
    backwards: float = 0.05
    """Cost of the backward part of the action, because sensors look ahead."""
    success: float = 2.0
    """Reward at the goal."""
    failure: float = 2.0
    """Cost of leaving the bounds, and of a collision."""


class GoalTask(Task):
    """Base of the tasks in which the robot drives to a goal."""

    observation = GOAL_OBSERVATION
    memory: ClassVar[Mapping[str, float]] = {"goal_distance": 0.0}
    compiled = True
    weights: Any = GoalWeights()
    scale: float = 10.0
    """Observed distances are divided by this [m]."""
    boundary: float = math.inf
    """An episode ends without success this far from the start [m]."""

    def begin(self, state: State, memory: Any) -> None:
        """Remember the distance to the goal."""
        memory.goal_distance = goal_distance(state.pose, state.goal)

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success within the tolerance, out of bounds beyond the boundary, collision by contact."""
        # A robot that touches something at the goal hasn't succeeded.
        if state.contact:
            return Outcome.COLLISION
        if goal_distance(state.pose, state.goal) <= self.goal_tolerance:
            return Outcome.SUCCESS
        is_outside = goal_distance(state.pose, (0.0, 0.0)) > self.boundary
        return Outcome.OUT_OF_BOUNDS if is_outside else Outcome.GOING

    def shortest_path(self, state: State, memory: Any) -> tuple[Goal, ...]:
        """To the goal."""
        return (state.goal,)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Sum of the terms of `GoalWeights`. Remembers the distance to the goal."""
        weights = self.weights
        distance = goal_distance(state.pose, state.goal)
        # Remembered before the memory changes: the change of distance is the progress.
        progress = memory.goal_distance - distance
        memory.goal_distance = distance
        backwards = min(state.action[0], 0.0)
        end = end_reward(outcome, weights.success, weights.failure)
        reward: float = weights.progress * progress - weights.time + weights.backwards * backwards
        return reward + end

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """The numbers that GOAL_OBSERVATION names. Distance and speeds are scaled."""
        x, y, theta = state.pose
        goal_x, goal_y = state.goal
        linear, angular = state.twist
        cos, sin = cos_sin(theta)
        ahead, left_by = relative_point(x, y, cos, sin, other_x=goal_x, other_y=goal_y)
        distance = goal_distance(state.pose, state.goal)

        # At the goal itself any direction will do.
        divisor = max(distance, 1e-12)

        return (
            min(distance / self.scale, OBSERVATION_LIMIT),
            clip_to(ahead / divisor, 1.0),
            clip_to(left_by / divisor, 1.0),
            clip_to(linear / state.max_twist[0], OBSERVATION_LIMIT),
            clip_to(angular / state.max_twist[1], OBSERVATION_LIMIT),
            *state.action,
        )


@dataclass(frozen=True, kw_only=True)
class PointGoal(GoalTask):
    """Reach a point on an open floor.

    Example:
        >>> import gymnasium
        >>> import acsar_gym
        >>> env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar")
        >>> _, info = env.reset(seed=0, options={"goal": (1.5, 0.0)})
        >>> info["goal_distance"]
        1.5
        >>> env.close()
    """

    id = "acsar_gym/PointGoal-v0"
    goal_distance: tuple[float, float] = (0.5, 3.0)
    """Nearest and farthest goal [m]."""
    goal_tolerance: float = 0.15
    """Radius of the goal [m]."""
    distance_scale: float | None = None
    """Observed distances are divided by this [m]. None: by the distance of the farthest goal."""

    def __post_init__(self) -> None:
        distances = check_distances(self.goal_distance)
        object.__setattr__(self, "goal_distance", distances)
        tolerance = store_positive(self, "goal_tolerance")
        # A goal that is nearer than the tolerance would be reached before the first step.
        if tolerance >= distances[0]:
            raise ConfigError(
                f"goal_tolerance = {tolerance:g}: must be below the nearest goal_distance, "
                f"{distances[0]:g} m"
            )
        if self.distance_scale is not None:
            store_positive(self, "distance_scale")

    @property
    def scale(self) -> float:  # type: ignore[override]
        """What observed distances are divided by [m]."""
        return self.goal_distance[1] if self.distance_scale is None else self.distance_scale

    @property
    def boundary(self) -> float:  # type: ignore[override]
        """Twice the largest goal distance [m]."""
        return OBSERVATION_LIMIT * self.goal_distance[1]


@compilable
def goal_distance(pose: Pose, goal: Goal) -> float:
    """Straight-line distance to the goal [m]."""
    dx = goal[0] - pose[0]
    dy = goal[1] - pose[1]
    return math.sqrt(dx * dx + dy * dy)
