"""What tasks have in common: their contract with the environment, outcomes, draws of a place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, shown, suggestion
from acsar_gym.jit import jit
from acsar_gym.worlds import Pose, World
from acsar_gym.worlds.world import Floats

Observation = NDArray[np.float32]
Goal = tuple[float, float]
Info = dict[str, float]

OBSERVATION_LIMIT = 2.0
"""Scaled distances and speeds are clipped to this, which bounds the observation space."""


class Outcome(IntEnum):
    """Whether and how an episode has ended."""

    GOING = 0
    SUCCESS = 1
    OUT_OF_BOUNDS = 2
    COLLISION = 3


@dataclass(frozen=True, slots=True)
class Assignment:
    """What one episode is about."""

    goal: Goal
    """In the odometry frame, in which the robot starts at the origin [m]."""
    world: World | None = None
    path: Floats | None = None
    """N x 3: x, y [m] and direction [rad] of a path to follow, in the odometry frame."""
    length: float = math.nan
    """Of the world's own path from start to goal [m]."""
    number: int = -1
    """Of the world: its generator's number, its place in a list or folder, or -1."""
    start: Pose = (0.0, 0.0, 0.0)
    """Where the robot starts, in the frame of the world."""


@dataclass(frozen=True, slots=True)
class State:
    """What a task sees after a step; all of it is known to a real robot, but for the truth."""

    pose: Pose
    """By odometry: x [m], y [m], theta [rad]."""
    twist: tuple[float, float]
    """By odometry: linear [m/s], angular [rad/s]."""
    action: tuple[float, float]
    """The last action, in [-1, 1]."""
    truth: GroundTruth | None = None
    """Of a simulated robot: where it is, and whether it has touched something."""

    @property
    def contact(self) -> bool:
        """Whether a simulated robot has touched an obstacle; False on hardware."""
        return self.truth is not None and self.truth.contact


class Course(Protocol):
    """One episode of a task: it keeps what the task remembers from step to step."""

    @property
    def assignment(self) -> Assignment:
        """What the episode is about."""

    @property
    def tolerance(self) -> float:
        """An odometry position this close to the goal is a success [m]."""

    def judge(self, state: State) -> tuple[float, Outcome]:
        """Reward of the step that led to this state, and whether the episode has ended."""

    def observe(self, state: State) -> tuple[float, ...]:
        """The observation's numbers, as many as the task's `layout` has names."""

    def info(self, state: State, truth: Pose) -> Info:
        """Figures of the task: the same keys at every step. Truth is NaN on hardware."""


class Task(Protocol):
    """A job for the robot: a value that never changes. It makes a Course for every episode."""

    @property
    def id(self) -> str:
        """Of the registered environment."""

    @property
    def layout(self) -> tuple[str, ...]:
        """Names of the observation's numbers, in order; a trained policy's file carries them."""

    @property
    def sees(self) -> bool:
        """Whether the ranges of a LiDAR follow those numbers."""

    @property
    def max_linear(self) -> float:
        """Linear velocity of a full action [m/s]."""

    @property
    def max_angular(self) -> float:
        """Angular velocity of a full action [rad/s]."""

    def low(self) -> tuple[float, ...]:
        """Least value of each of the observation's numbers."""

    def high(self) -> tuple[float, ...]:
        """Largest value of each of them."""

    def begin(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Course:
        """A new episode. Raises ConfigError for options of a reset that make no sense."""


def signature(task: Task, config: RobotConfig) -> str:
    """What an observation consists of, in words; a policy fits an env that has the same."""
    lidar = config.lidar
    rays = f"{lidar.rays} ranges over {lidar.field_of_view:.4g} rad to {lidar.max_range:g} m"
    return ",".join([*task.layout, *([rays] if task.sees else [])])


def known(options: Mapping[str, Any], names: tuple[str, ...]) -> Mapping[str, Any]:
    """The options of a reset; ConfigError for one that the task doesn't know."""
    if not isinstance(options, Mapping):
        raise ConfigError(f"options = {shown(options)}: must be a mapping of names to values")
    for name in options:
        if name not in names:
            raise ConfigError(
                f"unknown reset option {shown(name)}{suggestion(str(name)[:40], names)}"
            )
    return options


def positive(name: str, value: Any) -> float:
    """A positive number; ConfigError for anything else."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not 0.0 < number < math.inf:
        raise ConfigError(f"{name} = {shown(value)}: must be a positive number")
    return number


def point(name: str, value: Any) -> Goal:
    """A point as two finite floats; ConfigError where it is malformed."""
    try:
        x, y = (float(number) for number in value)
        sound = math.isfinite(x + y)
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        raise ConfigError(f"{name} = {shown(value)}: must be two finite numbers (x, y) [m]")
    return (x, y)


def world_info(assignment: Assignment) -> Info:
    """The number of the world; -1 for one that was given. Nothing where there are no worlds."""
    return {} if assignment.world is None else {"world": float(assignment.number)}


# The functions below are compiled, for whole batches of robots, too: scalars in, scalars out.


@jit
def within(x: float, y: float, radius: float, u: float, v: float) -> tuple[float, float]:
    """A point of the disc around (x, y) for two numbers u, v of [0, 1)."""
    distance, bearing = radius * math.sqrt(u), 2.0 * math.pi * v
    return x + distance * math.cos(bearing), y + distance * math.sin(bearing)


@jit
def relative(
    x: float, y: float, cos: float, sin: float, other_x: float, other_y: float
) -> tuple[float, float]:
    """A point as seen from (x, y) in the direction of this cosine and sine: ahead and left [m]."""
    dx, dy = other_x - x, other_y - y
    return dx * cos + dy * sin, dy * cos - dx * sin


@jit
def clipped(value: float, limit: float) -> float:
    """The value within -limit to limit."""
    return min(max(value, -limit), limit)
