"""Drive to a point: on an open floor, among obstacles, or through the worlds of BARN.

Observation and the end of an episode see odometry only, so they are the same on hardware; what a
simulated robot alone can tell, that it has touched something, ends an episode among obstacles.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, shown
from acsar_gym.jit import jit
from acsar_gym.tasks import barn
from acsar_gym.tasks import spawn as place
from acsar_gym.tasks.base import (
    OBSERVATION_LIMIT,
    Assignment,
    Goal,
    Info,
    Outcome,
    State,
    clipped,
    known,
    point,
    positive,
    relative,
    world_info,
)
from acsar_gym.worlds import Pose
from acsar_gym.worlds.pool import Pool

GOAL_LAYOUT = (
    "goal_distance",
    "goal_cos",
    "goal_sin",
    "linear_velocity",
    "angular_velocity",
    "last_linear",
    "last_angular",
)
COLLISION_PENALTY = 5.0
"""What a collision costs among obstacles, where it is what a policy must learn to avoid."""


@dataclass(frozen=True)
class _GoalTask:
    """What tasks with a goal share. Lengths in m, speeds in m/s and rad/s."""

    tolerance: float
    scale: float
    """Scales the observed distance."""
    max_linear: float
    max_angular: float
    boundary: float
    """An episode ends without success this far from the start."""
    end: float
    """Reward at the goal; a collision, or leaving the bounds, costs as much."""
    layout: tuple[str, ...] = field(default=GOAL_LAYOUT, init=False)

    def low(self) -> tuple[float, ...]:
        """Least value of each of the observation's numbers."""
        return (0.0, *(-high for high in self.high()[1:]))

    def high(self) -> tuple[float, ...]:
        """Largest value of each of them."""
        limit = OBSERVATION_LIMIT
        return (limit, 1.0, 1.0, limit, limit, 1.0, 1.0)


@dataclass(frozen=True)
class PointGoal(_GoalTask):
    """Reach a point of an open floor."""

    min_distance: float
    """Goals are drawn at least this far from the start."""
    max_distance: float
    """Goals are drawn at most this far from the start."""
    id = "acsar_gym/PointGoal-v0"
    sees = False

    @classmethod
    def of(
        cls, goal_distance: tuple[float, float], goal_tolerance: float, config: RobotConfig
    ) -> PointGoal:
        """From an env's arguments. Raises ConfigError where they make no sense."""
        try:
            nearest, farthest = (float(distance) for distance in goal_distance)
            tolerance = float(goal_tolerance)
        except (TypeError, ValueError, OverflowError):
            raise ConfigError(
                f"goal_distance = {shown(goal_distance)}, goal_tolerance = "
                f"{shown(goal_tolerance)}: must be (nearest, farthest) and one number [m]"
            ) from None
        if not 0.0 < tolerance < nearest <= farthest < math.inf:
            raise ConfigError(
                f"goal_tolerance = {tolerance}, goal_distance = ({nearest}, {farthest}): must be "
                "0 < tolerance < nearest <= farthest [m]"
            )
        return cls(
            tolerance=tolerance,
            scale=farthest,
            max_linear=config.max_linear,
            max_angular=config.max_angular,
            boundary=OBSERVATION_LIMIT * farthest,
            end=2.0,
            min_distance=nearest,
            max_distance=farthest,
        )

    def begin(self, rng: np.random.Generator, options: Mapping[str, Any]) -> GoalCourse:
        """A goal in any direction, its distance uniform between the limits; option "goal"."""
        goal = known(options, ("goal",)).get("goal")
        goal = self._drawn(rng) if goal is None else self.checked(point("goal", goal))
        return GoalCourse(self, Assignment(goal))

    def _drawn(self, rng: np.random.Generator) -> Goal:
        distance = rng.uniform(self.min_distance, self.max_distance)
        return goal_at(distance, rng.uniform(-math.pi, math.pi))

    def checked(self, goal: Goal) -> Goal:
        """A goal (x, y) [m] that this task may have. ConfigError for one too near or too far."""
        if not self.min_distance <= math.hypot(*goal) <= self.max_distance:
            raise ConfigError(
                f"goal = ({goal[0]:g}, {goal[1]:g}): must lie {self.min_distance:g} to "
                f"{self.max_distance:g} m from the start (goal_distance of the env)"
            )
        return goal


@dataclass(frozen=True)
class ObstacleGoal(_GoalTask):
    """Reach a point among obstacles that a LiDAR sees."""

    pool: Pool
    id = "acsar_gym/ObstacleGoal-v0"
    sees = True

    @classmethod
    def of(cls, pool: Pool, goal_tolerance: float, config: RobotConfig) -> ObstacleGoal:
        """From an env's arguments. Raises ConfigError for a bad tolerance."""
        return cls(**_among_obstacles(goal_tolerance, config), pool=pool)

    def begin(self, rng: np.random.Generator, options: Mapping[str, Any]) -> GoalCourse:
        """A world of the pool; options "world", "difficulty" and "goal"."""
        return GoalCourse(self, place.drawn(self.pool, rng, known(options, place.OPTIONS)))


@dataclass(frozen=True)
class Barn(_GoalTask):
    """BARN: 10 m through a field of cylinders, scored by the time it took."""

    pool: Pool
    period: float
    """Of a step of the policy [s]."""
    id = "acsar_gym/Barn-v0"
    sees = True

    @classmethod
    def of(cls, pool: Pool, policy_rate: float, config: RobotConfig) -> Barn:
        """From an env's arguments."""
        period = 1.0 / positive("policy_rate", policy_rate)
        return cls(**_among_obstacles(barn.TOLERANCE, config), pool=pool, period=period)

    def begin(self, rng: np.random.Generator, options: Mapping[str, Any]) -> GoalCourse:
        """A world of the pool; options "world", "difficulty" and "goal"."""
        return BarnCourse(self, place.drawn(self.pool, rng, known(options, place.OPTIONS)))


def _among_obstacles(tolerance: float, config: RobotConfig) -> dict[str, float]:
    return {
        "tolerance": positive("goal_tolerance", tolerance),
        "scale": 10.0,
        "max_linear": config.max_linear,
        "max_angular": config.max_angular,
        "boundary": math.inf,
        "end": COLLISION_PENALTY,
    }


class GoalCourse:
    """An episode of a task with a goal: it remembers the distance at the last step."""

    def __init__(self, task: _GoalTask, assignment: Assignment) -> None:
        self.assignment = assignment
        self.tolerance = task.tolerance
        self._task = task
        self._goal = assignment.goal
        self._distance = math.hypot(*assignment.goal)

    def judge(self, state: State) -> tuple[float, Outcome]:
        """Success within the tolerance, out of bounds beyond the boundary, collision by contact."""
        task, (x, y, _) = self._task, state.pose
        before, self._distance = self._distance, goal_distance(state.pose, self._goal)
        number = goal_outcome(
            self._distance, math.sqrt(x * x + y * y), task.tolerance, task.boundary, state.contact
        )
        reward = goal_reward(before, self._distance, state.action[0], number, task.end)
        return reward, Outcome(number)

    def observe(self, state: State) -> tuple[float, ...]:
        """As GOAL_LAYOUT; distance and speeds scaled."""
        (x, y, theta), task = state.pose, self._task
        seen = seen_from(x, y, math.cos(theta), math.sin(theta), *self._goal)
        scales = (task.scale, task.max_linear, task.max_angular)
        return (*goal_numbers(*seen, state.twist, scales), *state.action)

    def info(self, state: State, truth: Pose) -> Info:
        """Distances to the goal by odometry and in truth [m]."""
        return {
            "goal_distance": self._distance,
            "true_goal_distance": goal_distance(truth, self._goal),
        } | world_info(self.assignment)


class BarnCourse(GoalCourse):
    """An episode of BARN: it counts the steps and keeps the score."""

    def __init__(self, task: Barn, assignment: Assignment) -> None:
        super().__init__(task, assignment)
        self._period, self._top = task.period, task.max_linear
        self._steps, self._success = 0, 0.0

    def judge(self, state: State) -> tuple[float, Outcome]:
        """As among obstacles; the time goes on."""
        reward, outcome = super().judge(state)
        self._steps += 1
        self._success = float(outcome is Outcome.SUCCESS)
        return reward, outcome

    def info(self, state: State, truth: Pose) -> Info:
        """Distances and BARN's scores, which are zero until the goal is reached."""
        time = self._steps * self._period
        scores = barn.scores(self._success, time, self.assignment.length, self._top)
        return super().info(state, truth) | dict(zip(barn.SCORES, scores, strict=True))


# The functions below are compiled, for whole batches of robots, too: scalars in, scalars out.


@jit
def goal_at(distance: float, bearing: float) -> Goal:
    """The point at a distance [m] and a bearing [rad] from the origin."""
    return (distance * math.cos(bearing), distance * math.sin(bearing))


@jit
def seen_from(
    x: float, y: float, cos: float, sin: float, goal_x: float, goal_y: float
) -> tuple[float, float, float]:
    """Distance to a point [m], and its bearing's cosine and sine in the frame of the pose."""
    ahead, left = relative(x, y, cos, sin, goal_x, goal_y)
    dx, dy = goal_x - x, goal_y - y
    distance = math.sqrt(dx * dx + dy * dy)
    near = max(distance, 1e-12)
    return distance, clipped(ahead / near, 1.0), clipped(left / near, 1.0)


@jit
def goal_numbers(
    distance: float,
    ahead: float,
    left: float,
    twist: tuple[float, float],
    scales: tuple[float, float, float],
) -> tuple[float, float, float, float, float]:
    """The observation's first five numbers; `scales` of distance, linear and angular velocity."""
    return (
        min(distance / scales[0], OBSERVATION_LIMIT),
        ahead,
        left,
        clipped(twist[0] / scales[1], OBSERVATION_LIMIT),
        clipped(twist[1] / scales[2], OBSERVATION_LIMIT),
    )


@jit
def goal_outcome(
    distance: float, from_start: float, tolerance: float, boundary: float, contact: bool
) -> int:
    """The Outcome's number for a distance to the goal and one from the start [m]."""
    if contact:
        return 3
    if distance <= tolerance:
        return 1
    return 2 if from_start > boundary else 0


@jit
def goal_reward(before: float, after: float, linear: float, outcome: int, end: float) -> float:
    """Twice the metres gained on the goal, less 0.02 a step and up to 0.05 for driving backwards.

    Plus `end` at the goal, and minus `end` for a collision or beyond the boundary. `before` and
    `after` are goal distances [m], `linear` is the action's linear part in [-1, 1]. Backwards
    costs, because sensors look ahead.
    """
    last = end if outcome == 1 else (-end if outcome > 1 else 0.0)
    return 2.0 * (before - after) - 0.02 + 0.05 * min(linear, 0.0) + last


def goal_distance(pose: Pose, goal: Goal) -> float:
    """Straight-line distance to the goal [m]."""
    dx, dy = goal[0] - pose[0], goal[1] - pose[1]
    return math.sqrt(dx * dx + dy * dy)
