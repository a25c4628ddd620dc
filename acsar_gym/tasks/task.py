"""The base class of all tasks, and functions that they share.

A task is written once. The single environment calls its methods in Python. A batch calls them for
every robot: in Python, too, or compiled by numba where the task sets `compiled = True`.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Mapping, Sequence
from enum import IntEnum
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np

from acsar_gym.jit import compilable
from acsar_gym.tasks.state import Goal, Observation, State

Memory = SimpleNamespace
"""What a task remembers in one episode, as attributes. A record of floats where it is compiled."""

OBSERVATION_LIMIT = 2.0
"""Scaled distances and speeds in observations are clipped to -2 to 2, so that spaces are
bounded."""


class Outcome(IntEnum):
    """Whether and how an episode has ended.

    Example:
        >>> from acsar_gym import Outcome, State
        >>> from acsar_gym.tasks import PointGoal
        >>> PointGoal().outcome(State(contact=True), memory=None) == Outcome.COLLISION
        True
    """

    GOING = 0
    SUCCESS = 1
    OUT_OF_BOUNDS = 2
    COLLISION = 3


class Task:
    """Base class of all tasks. Subclass it. Options are fields of a dataclass, or of `__init__`.

    A task object never changes. What changes during an episode are the attributes of `memory`. The
    env calls `begin` and `observe` at a reset, and `outcome`, `reward`, `observe` after every step.

    If `compiled` is True, numba compiles these four methods for batches. `self` is then a named
    tuple of the task's numbers (fields, class attributes and properties that are numbers, tuples of
    numbers or arrays), so that methods can't call each other. They can call functions that
    `acsar_gym.jit.compilable` decorates. A subclass that overrides a method of a compiled task
    isn't compiled unless it sets `compiled = True` itself.

    Attributes:
        observation: Name and (least, largest) value of each number that `observe` returns.
        memory: Name and first value of each number that an episode remembers.
        told: Names of the memory that are keys of info. None is all of them.
        sensors: What the robot senses in addition to its odometry: "lidar", or a factory, see
            `Sensor`.
        needs: Sensors whose numbers the methods read, and that `sensors` has to name.
        worlds: The default worlds, such as "clutter:train". None is an open floor with a goal.
        difficulty: Difficulty of generated worlds. None or (low, high) varies it.
        goal_distance: Nearest and farthest goal on an open floor [m].
        goal_tolerance: Radius of the goal in pictures [m].
        follows: Whether the robot is to follow the world's path. It then starts at the path's
            beginning, heading along it.
        compiled: Whether numba compiles the methods, which a batch needs.
        weights: A NamedTuple of floats that `reward` reads as `self.weights`. Users change weights
            by an argument of the env, such as weights={"near": 0.3}.
        id: Id of the environment, which `gymnasium.make` sets.

    Example:
        >>> import acsar_gym
        >>> class Forward(acsar_gym.Task):
        ...     observation = {"speed": (-2.0, 2.0)}
        ...
        ...     def reward(self, state, memory, outcome):
        ...         return state.twist[0]
        ...
        ...     def observe(self, state, memory):
        ...         return (state.twist[0],)
        >>> env = acsar_gym.RobotEnv(Forward, link="planar")
        >>> env.reset(seed=0)[0]
        array([0.], dtype=float32)
        >>> env.close()
    """

    observation: ClassVar[Mapping[str, tuple[float, float]]] = {}
    memory: ClassVar[Mapping[str, float]] = {}
    told: ClassVar[tuple[str, ...] | None] = None
    sensors: tuple[Any, ...] = ()
    needs: ClassVar[tuple[str, ...]] = ()
    worlds: Any = None
    difficulty: Any = None
    goal_distance: tuple[float, float] = (0.5, 3.0)
    goal_tolerance: float = 0.15
    follows: ClassVar[bool] = False
    compiled: ClassVar[bool] = False
    weights: Any = ()
    id: str = ""

    def begin(self, state: State, memory: Any) -> None:
        """Initialize the memory of an episode.

        Args:
            state: State of the robot at rest, after a reset.
            memory: Memory of the episode with its first values. Set its attributes.
        """

    def outcome(self, state: State, memory: Any) -> Outcome:
        """Decide whether and how the episode has ended with this step.

        Args:
            state: State after the step.
            memory: Memory of the episode, which may be changed.

        Returns:
            An Outcome, or its number.
        """
        return Outcome.GOING

    def reward(self, state: State, memory: Any, outcome: Outcome) -> float:
        """Compute the reward of a step.

        Args:
            state: State after the step.
            memory: Memory of the episode, which may be changed.
            outcome: Outcome of the step. Compare it with `==`.

        Returns:
            The reward.
        """
        raise NotImplementedError("a task needs the method reward(state, memory, outcome)")

    def observe(self, state: State, memory: Any) -> tuple[float, ...]:
        """Compute the task's own part of the observation. That of the sensors follows it.

        Args:
            state: State after the reset or step.
            memory: Memory of the episode.

        Returns:
            One number for each name in `observation`, in its order.
        """
        raise NotImplementedError("a task needs the method observe(state, memory)")

    def shortest_path(self, state: State, memory: Any) -> Sequence[Goal] | float | None:
        """Return the shortest way to success. Optional, for SPL and completion time.

        An evaluation calls it after the reset, and at the end for what remains. It is never
        compiled. A subclass that overrides `outcome` has to override it, too.

        Args:
            state: State after the reset or the last step, with the true pose if it is known.
            memory: Memory of the episode.

        Returns:
            The places (x, y) [m] to pass, in their order, such as `[state.goal]`: the evaluation
            measures the way from the robot through them, around obstacles. Or its length [m]. None
            where there is no shortest way: then these figures are left out.
        """
        return None


TASK_METHODS = ("begin", "outcome", "reward", "observe")
"""The methods of a task that a batch calls, and compiles where the task is compiled."""


def is_compiled(instance: Any, methods: Collection[str] = TASK_METHODS) -> bool:
    """Whether a batch compiles these methods. Not where a subclass overrides compiled ones."""
    # The nearest class that sets `compiled`, or overrides a method without it, decides.
    for kind in type(instance).__mro__:
        if "compiled" in vars(kind):
            return bool(vars(kind)["compiled"])
        if any(name in vars(kind) for name in methods):
            return False
    return False


def says_shortest_path(task: Task) -> bool:
    """Whether a task has a `shortest_path` that belongs to its `outcome`."""
    # A subclass with its own `outcome` may end elsewhere than the inherited way.
    for kind in type(task).__mro__:
        if "shortest_path" in vars(kind) or "outcome" in vars(kind):
            return "shortest_path" in vars(kind) and kind is not Task
    return False


def new_memory(task: Task) -> Memory:
    """Make a new episode's memory, with the first values and nothing of other episodes."""
    return SimpleNamespace(**copy.deepcopy(dict(task.memory)))


def observation_bounds(task: Task) -> tuple[Observation, Observation]:
    """Least and largest values of a task's own part of the observation, each (numbers,)."""
    bounds = np.array(list(task.observation.values()), np.float64).reshape(-1, 2).T
    # Bounds beyond the largest float32 become infinite, which a space allows.
    with np.errstate(over="ignore"):
        low, high = bounds.astype(np.float32)
    return low, high


def info_names(task: Task) -> tuple[str, ...]:
    """Names of the memory that are keys of info."""
    return tuple(task.memory) if task.told is None else task.told


# Functions for tasks. They take and return scalars, so that numba can compile them.


@compilable
def point_in_disc(x: float, y: float, radius: float, u: float, v: float) -> tuple[float, float]:
    """Map two uniform samples u, v of [0, 1) to a point of the disc around (x, y)."""
    # Without the root, points would crowd around the middle of the disc.
    distance = radius * math.sqrt(u)
    bearing = 2.0 * math.pi * v
    return x + distance * math.cos(bearing), y + distance * math.sin(bearing)


@compilable
def relative_point(
    x: float, y: float, cos: float, sin: float, other_x: float, other_y: float
) -> tuple[float, float]:
    """Transform a point into the frame of a pose.

    Args:
        x: Position of the pose [m].
        y: Position of the pose [m].
        cos: Cosine of the pose's heading.
        sin: Sine of the pose's heading.
        other_x: Position of the point [m].
        other_y: Position of the point [m].

    Returns:
        How far the point lies ahead and to the left of the pose [m].
    """
    dx = other_x - x
    dy = other_y - y
    return dx * cos + dy * sin, dy * cos - dx * sin


@compilable
def clip_to(value: float, limit: float) -> float:
    """Clip a value to -limit to limit."""
    return min(max(value, -limit), limit)


@compilable
def end_reward(outcome: int, success: float, failure: float) -> float:
    """Return the part of the reward that depends on how the episode has ended."""
    if outcome == Outcome.SUCCESS:
        return success
    return 0.0 if outcome == Outcome.GOING else -failure
