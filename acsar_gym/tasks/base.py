"""What a task is: names and bounds of its observation, a reward, an end, and what it remembers.

A task is written once. The single environment calls its methods in Python; a batch calls them for
every robot, in Python too, or compiled by numba where the task says `compiled = True`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from enum import IntEnum
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import compilable
from acsar_gym.sensors import Sensor

Observation = NDArray[np.float32]
Floats = NDArray[np.float64]
Pose = tuple[float, float, float]
Goal = tuple[float, float]
Info = dict[str, float]
Memory = SimpleNamespace
"""What a task remembers in one episode, as attributes; a record of floats where it is compiled."""

OBSERVATION_LIMIT = 2.0
"""Scaled distances and speeds are clipped to this, which bounds the observation space."""


NO_RANGES: Floats = np.zeros(0)
NO_PATH: Floats = np.zeros((0, 3))
NOTHING_SENSED: Observation = np.zeros(0, np.float32)


class Outcome(IntEnum):
    """Whether and how an episode has ended."""

    GOING = 0
    SUCCESS = 1
    OUT_OF_BOUNDS = 2
    COLLISION = 3


class State(NamedTuple):
    """What a task is told after every step; a real robot knows all of it, but for `contact`.

    Poses and points are in the odometry frame, in which the robot starts at the origin.
    """

    pose: Pose = (0.0, 0.0, 0.0)
    """By odometry: x [m], y [m], theta [rad]."""
    twist: tuple[float, float] = (0.0, 0.0)
    """By odometry: linear [m/s], angular [rad/s]."""
    wheel_speeds: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """By the encoders, in the order of the wheels a to d [rad/s]."""
    action: tuple[float, float] = (0.0, 0.0)
    """The last action (linear, angular), in [-1, 1]; zeros at a reset."""
    sent: tuple[float, float] = (0.0, 0.0)
    """The twist that was really sent in the last tick [m/s, rad/s]."""
    reason: int = 0
    """Why it isn't the one that was asked for: a `safety.layer.Reason`; 0 where it is."""
    ranges: Floats = NO_RANGES
    """(rays,): the LiDAR's newest scan [m]; empty where the task uses none."""
    sensed: Observation = NOTHING_SENSED
    """(numbers,): what all sensors add to the observation, as it stands there."""
    time: float = 0.0
    """Since the reset, in whole steps of the policy [s]."""
    feedback_age: float = 0.0
    """Since the board was last heard of [s]."""
    contact: bool = False
    """Whether a simulated robot has touched an obstacle; False on hardware."""
    goal: Goal = (1.0, 0.0)
    """[m]"""
    path: Floats = NO_PATH
    """(samples, 3): x, y [m] and direction [rad] every 0.05 m along the path to follow; empty
    unless the task says `follows`."""
    length: float = math.nan
    """Of the world's own path from start to goal [m]; NaN where there is none."""
    max_twist: tuple[float, float] = (1.0, 1.0)
    """The twist of a full action [m/s, rad/s]."""
    period: float = 0.1
    """Of a step of the policy [s]."""


class Task:
    """A job for the robot. Subclass it; options are fields of a dataclass, or of `__init__`.

    A task never changes; what it remembers in an episode are the attributes of `memory`. The env
    calls `begin` and `observe` at a reset; after every step `outcome`, then `reward`, `observe`.

    Where `compiled` is true, numba compiles these four methods for batches. `self` is then a named
    tuple of the task's numbers (fields, class attributes and properties that are numbers, tuples of
    numbers or arrays), so that methods can't call each other; functions of a module can be called
    from all of them where `acsar_gym.jit.compilable` decorates them. A subclass that overrides a
    method of a compiled task runs in Python unless it says `compiled = True` itself.

    Class attributes:
        observation: name and (least, largest) value of each number that `observe` returns.
        memory: name and first value of each number that an episode remembers.
        told: names of the memory that are keys of info; None is all of them.
        sensors: what the robot senses beside its odometry: "lidar", or a factory, see `Sensor`.
        worlds: the default worlds, such as "clutter:train"; None is an open floor with a goal.
        difficulty: of generated worlds; None or (low, high) varies it.
        goal_distance: nearest and farthest goal on an open floor [m].
        goal_tolerance: radius of the goal in pictures [m].
        follows: whether the robot follows the world's path, and starts on it, looking along it.
        compiled: whether numba compiles the methods for batches.
        id: of the environment; `gymnasium.make` sets it.
    """

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {}
    memory: ClassVar[Mapping[str, float]] = {}
    told: ClassVar[tuple[str, ...] | None] = None
    sensors: tuple[Any, ...] = ()
    worlds: Any = None
    difficulty: Any = None
    goal_distance: tuple[float, float] = (0.5, 3.0)
    goal_tolerance: float = 0.15
    follows: ClassVar[bool] = False
    compiled: ClassVar[bool] = False
    id: str = ""

    def begin(self, state: State, memory: Any) -> None:
        """Note what an episode begins with.

        Args:
            state: of the robot at rest, after a reset.
            memory: holds the first values; set its attributes.
        """

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Whether and how the episode has ended with this step.

        Args:
            state: after the step.
            memory: of the episode; may be changed.

        Returns:
            An Outcome, or its number.
        """
        return Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """What the step was worth.

        Args:
            state: after the step.
            memory: of the episode; may be changed.
            outcome: of the step; compare it with `==`.

        Returns:
            The reward.
        """
        raise NotImplementedError

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """What the policy sees, besides what the sensors add.

        Args:
            state: after the reset or step.
            memory: of the episode.

        Returns:
            As many numbers as `observation` has names, in its order.
        """
        raise NotImplementedError


METHODS = ("begin", "outcome", "reward", "observe")
"""What a task's class may override, and a batch compiles."""


def is_compiled(task: Task) -> bool:
    """Whether a batch compiles the task's methods: not those that override compiled ones."""
    for one in type(task).__mro__:
        if "compiled" in vars(one):
            return bool(vars(one)["compiled"])
        if any(name in vars(one) for name in METHODS):
            return False
    return False


def remembered(task: Task) -> Memory:
    """A new episode's memory."""
    return SimpleNamespace(**task.memory)


def told(task: Task) -> tuple[str, ...]:
    """Names of the memory that are keys of info."""
    return tuple(task.memory) if task.told is None else task.told


def signature(task: Task, sensors: Iterable[Sensor]) -> str:
    """What an observation consists of, in words; a policy fits an env that has the same."""
    return ",".join([*task.observation, *(sensor.layout for sensor in sensors)])


# Compiled functions for tasks: scalars in, scalars out.


@compilable
def within(x: float, y: float, radius: float, u: float, v: float) -> tuple[float, float]:
    """A point of the disc around (x, y) for two numbers u, v of [0, 1)."""
    distance, bearing = radius * math.sqrt(u), 2.0 * math.pi * v
    return x + distance * math.cos(bearing), y + distance * math.sin(bearing)


@compilable
def relative(
    x: float, y: float, cos: float, sin: float, other_x: float, other_y: float
) -> tuple[float, float]:
    """A point as seen from (x, y) in the direction of this cosine and sine: ahead and left [m]."""
    dx, dy = other_x - x, other_y - y
    return dx * cos + dy * sin, dy * cos - dx * sin


@compilable
def clipped(value: float, limit: float) -> float:
    """The value within -limit to limit."""
    return min(max(value, -limit), limit)


Factory = Callable[..., Task]
"""Makes a task of its options."""
