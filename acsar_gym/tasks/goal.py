"""Drive to a point: on an open floor, among obstacles, or through the worlds of BARN.

Observation and the end of an episode see odometry only, so they are the same on hardware; what a
simulated robot alone can tell, that it has touched something, ends an episode among obstacles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from acsar_gym.dynamics.trigonometry import direction
from acsar_gym.errors import ConfigError, shown
from acsar_gym.jit import compilable
from acsar_gym.tasks import barn
from acsar_gym.tasks.base import (
    OBSERVATION_LIMIT,
    Goal,
    Outcome,
    State,
    Task,
    clipped,
    relative,
)
from acsar_gym.tasks.options import positive

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
    """What tasks with a goal share."""

    observation = GOAL_OBSERVATION
    memory: ClassVar[Mapping[str, float]] = {"goal_distance": 0.0}
    compiled = True
    scale: float = 10.0
    """Observed distances are divided by it [m]."""
    boundary: float = math.inf
    """An episode ends without success this far from the start [m]."""
    end: float = 5.0
    """Reward at the goal; a collision, or leaving the bounds, costs as much."""

    def begin(self, state: State, memory: Any) -> None:
        """Note the distance to the goal."""
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Success within the tolerance, out of bounds beyond the boundary, collision by contact."""
        x, y, _ = state.pose
        distance, start = goal_distance(x, y, state.goal), math.sqrt(x * x + y * y)
        return goal_outcome(  # type: ignore[return-value]  # its number
            distance, start, self.goal_tolerance, self.boundary, state.contact
        )

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """See `goal_reward`."""
        before = memory.goal_distance
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
        return goal_reward(before, memory.goal_distance, state.action[0], outcome, self.end)

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """As GOAL_OBSERVATION; distance and speeds scaled."""
        return goal_numbers(
            state.pose, state.twist, state.goal, (self.scale, *state.max_twist), state.action
        )


@dataclass(frozen=True, kw_only=True)
class PointGoal(GoalTask):
    """Reach a point of an open floor."""

    id = "acsar_gym/PointGoal-v0"
    goal_distance: tuple[float, float] = (0.5, 3.0)
    goal_tolerance: float = 0.15
    end = 2.0

    def __post_init__(self) -> None:
        try:
            nearest, farthest = (float(distance) for distance in self.goal_distance)
            tolerance = float(self.goal_tolerance)
        except (TypeError, ValueError, OverflowError):
            raise ConfigError(
                f"goal_distance = {shown(self.goal_distance)}, goal_tolerance = "
                f"{shown(self.goal_tolerance)}: must be (nearest, farthest) and one number [m]"
            ) from None
        if not 0.0 < tolerance < nearest <= farthest < math.inf:
            raise ConfigError(
                f"goal_tolerance = {tolerance}, goal_distance = ({nearest}, {farthest}): must be "
                "0 < tolerance < nearest <= farthest [m]"
            )
        object.__setattr__(self, "goal_distance", (nearest, farthest))
        object.__setattr__(self, "goal_tolerance", tolerance)

    @property
    def scale(self) -> float:  # type: ignore[override]
        """The largest goal distance [m]."""
        return self.goal_distance[1]

    @property
    def boundary(self) -> float:  # type: ignore[override]
        """Twice that [m]."""
        return OBSERVATION_LIMIT * self.goal_distance[1]


@dataclass(frozen=True, kw_only=True)
class ObstacleGoal(GoalTask):
    """Reach a point among obstacles that a LiDAR sees."""

    id = "acsar_gym/ObstacleGoal-v0"
    sensors = ("lidar",)
    worlds = "clutter:train"
    goal_tolerance: float = 0.3

    def __post_init__(self) -> None:
        tolerance = positive("goal_tolerance", self.goal_tolerance)
        object.__setattr__(self, "goal_tolerance", tolerance)


class Barn(GoalTask):
    """BARN: 10 m through a field of cylinders, scored by the time it took."""

    id = "acsar_gym/Barn-v0"
    sensors = ("lidar",)
    worlds = "barn:train"
    goal_tolerance = barn.TOLERANCE
    memory: ClassVar[Mapping[str, float]] = {"goal_distance": 0.0} | dict.fromkeys(barn.SCORES, 0.0)
    compiled = True

    def begin(self, state: State, memory: Any) -> None:
        """Note the distance to the goal; the scores are zero until it is reached."""
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
        score(state, memory, 0)

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """As among obstacles; the score is kept."""
        before = memory.goal_distance
        memory.goal_distance = goal_distance(state.pose[0], state.pose[1], state.goal)
        score(state, memory, outcome)
        return goal_reward(before, memory.goal_distance, state.action[0], outcome, self.end)


# The functions below are compiled, for whole batches of robots, too: scalars in, scalars out.


@compilable
def seen_from(
    x: float, y: float, cos: float, sin: float, goal_x: float, goal_y: float
) -> tuple[float, float, float]:
    """Distance to a point [m], and its bearing's cosine and sine in the frame of the pose."""
    ahead, left = relative(x, y, cos, sin, goal_x, goal_y)
    dx, dy = goal_x - x, goal_y - y
    distance = math.sqrt(dx * dx + dy * dy)
    near = max(distance, 1e-12)
    return distance, clipped(ahead / near, 1.0), clipped(left / near, 1.0)


@compilable
def goal_numbers(
    pose: tuple[float, float, float],
    twist: tuple[float, float],
    goal: Goal,
    scales: tuple[float, float, float],
    action: tuple[float, float],
) -> tuple[float, float, float, float, float, float, float]:
    """As GOAL_OBSERVATION; `scales` of distance, linear and angular velocity."""
    x, y, theta = pose
    cos, sin = direction(theta)
    distance, ahead, left = seen_from(x, y, cos, sin, goal[0], goal[1])
    return (
        min(distance / scales[0], OBSERVATION_LIMIT),
        ahead,
        left,
        clipped(twist[0] / scales[1], OBSERVATION_LIMIT),
        clipped(twist[1] / scales[2], OBSERVATION_LIMIT),
        action[0],
        action[1],
    )


@compilable
def goal_distance(x: float, y: float, goal: Goal) -> float:
    """Straight-line distance to the goal [m]."""
    dx, dy = goal[0] - x, goal[1] - y
    return math.sqrt(dx * dx + dy * dy)


@compilable
def score(state: State, memory: Any, outcome: int) -> None:
    """Note BARN's scores at the end of a step."""
    success = 1.0 if outcome == 1 else 0.0
    s2, s4, own2, own4 = barn.scores(success, state.time, state.length, state.max_twist[0])
    memory.barn_score, memory.barn_score_k4 = s2, s4
    memory.barn_score_own, memory.barn_score_own_k4 = own2, own4


@compilable
def goal_outcome(
    distance: float, from_start: float, tolerance: float, boundary: float, contact: bool
) -> int:
    """The Outcome's number for a distance to the goal and one from the start [m]."""
    if contact:
        return 3
    if distance <= tolerance:
        return 1
    return 2 if from_start > boundary else 0


@compilable
def goal_reward(before: float, after: float, linear: float, outcome: int, end: float) -> float:
    """Twice the metres gained on the goal, less 0.02 a step and up to 0.05 for driving backwards.

    Plus `end` at the goal, and minus `end` for a collision or beyond the boundary. `before` and
    `after` are goal distances [m], `linear` is the action's linear part in [-1, 1]. Backwards
    costs, because sensors look ahead.
    """
    last = end if outcome == 1 else (-end if outcome > 1 else 0.0)
    return 2.0 * (before - after) - 0.02 + 0.05 * min(linear, 0.0) + last
