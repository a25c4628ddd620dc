"""Draw the world of an episode, and the robot's start and goal in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, WorldError, shown
from acsar_gym.jit import jit
from acsar_gym.tasks.base import Goal, Info, Task, relative, within
from acsar_gym.tasks.options import known, point
from acsar_gym.worlds import Pose, Region, World
from acsar_gym.worlds.generators import Level
from acsar_gym.worlds.paths import along, sampled, to_follow
from acsar_gym.worlds.pool import Pool, Source, checked
from acsar_gym.worlds.search import footprint_radius
from acsar_gym.worlds.world import Floats

DRAWS = 6
"""How many uniform samples an episode in a world takes: world, start (2), heading, goal (2)."""


@dataclass(frozen=True, slots=True)
class Assignment:
    """World, start, goal and path of one episode."""

    goal: Goal
    """The goal x, y in the odometry frame, in which the robot starts at the origin [m]."""
    world: World | None = None
    """Obstacles; None on an open floor."""
    path: Floats | None = None
    """(samples, 3): x [m], y [m] and direction [rad] of the path to follow, in the odometry
    frame."""
    length: float = math.nan
    """Length of the world's own path from start to goal [m]; NaN where there is none."""
    number: int = -1
    """Number of the world: its generator's number, or its place in a list or folder; -1 for
    none."""
    start: Pose = (0.0, 0.0, 0.0)
    """Where the robot starts: x [m], y [m], theta [rad] in the frame of the world."""

    @property
    def info(self) -> Info:
        """What it adds to info: the world's number; nothing on an open floor."""
        return {} if self.world is None else {"world": float(self.number)}


class Spawn:
    """Draws the assignments of a task's episodes.

    Attributes: `pool`, the worlds, or None on an open floor; `options`, the names that a reset
    knows.
    """

    def __init__(
        self, task: Task, worlds: Source | None, difficulty: Level, config: RobotConfig
    ) -> None:
        """Make the pool of worlds.

        Args:
            task: its worlds and difficulty are used where none are given here.
            worlds: see `Pool.of`; None for the task's own.
            difficulty: of generated worlds; None for the task's own.
            config: of the robot, whose footprint must fit into the worlds.

        Raises:
            ConfigError, WorldError: for unknown worlds, or a difficulty where there are no worlds.
        """
        self._task = task
        source = task.worlds if worlds is None else worlds
        level = task.difficulty if difficulty is None else difficulty
        if source is None and level is not None:
            raise ConfigError(f"difficulty = {shown(level)}: {task.id} has no worlds")
        self.pool = None if source is None else Pool.of(source, level, footprint_radius(config))
        _check_distances(task)
        self.options: tuple[str, ...] = ("goal",)
        if self.pool is not None:
            self.options = ("world", "difficulty", "path" if task.follows else "goal")

    def draw(self, rng: np.random.Generator, options: Mapping[str, Any]) -> Assignment:
        """Draw the assignment of the next episode.

        Args:
            rng: the env's generator.
            options: of the reset: "goal", (x, y) in the odometry frame [m]; in worlds "world", a
                number or a World, and "difficulty", (low, high) of the worlds to draw from; for
                tasks that follow "path", points (x, y) [m], instead of "goal".

        Raises:
            ConfigError, WorldError: for unknown options, or values that are malformed or out of
                range.
        """
        options = known(options, self.options)
        if options.get("path") is not None:
            return given(options["path"])
        if self.pool is not None:
            return drawn(self.pool, rng, options, follow=self._task.follows)
        goal = options.get("goal")
        return Assignment(self._goal(rng) if goal is None else self.checked(point("goal", goal)))

    def _goal(self, rng: np.random.Generator) -> Goal:
        """Draw a goal in any direction, its distance uniform between the task's limits."""
        distance = rng.uniform(*self._task.goal_distance)
        return goal_at(distance, rng.uniform(-math.pi, math.pi))

    def checked(self, goal: Goal) -> Goal:
        """Return a goal on an open floor once its distance is checked.

        Args:
            goal: x, y in the odometry frame [m].

        Raises:
            ConfigError: where it is nearer or farther than the task's `goal_distance`.
        """
        nearest, farthest = self._task.goal_distance
        if not nearest <= math.hypot(*goal) <= farthest:
            raise ConfigError(
                f"goal = ({goal[0]:g}, {goal[1]:g}): must lie {nearest:g} to {farthest:g} m from "
                "the start: give the env another goal_distance, run --goal-distance"
            )
        return goal


def _check_distances(task: Task) -> None:
    """Raise ConfigError unless `goal_distance` is 0 < nearest <= farthest."""
    try:
        nearest, farthest = (float(distance) for distance in task.goal_distance)
    except (TypeError, ValueError):
        nearest, farthest = math.nan, math.nan
    if not 0.0 < nearest <= farthest < math.inf:
        raise ConfigError(
            f"goal_distance = {shown(task.goal_distance)}: must be (nearest, farthest) [m], with "
            "0 < nearest <= farthest"
        )


@jit
def goal_at(distance: float, bearing: float) -> Goal:
    """The point at a distance [m] and a bearing [rad] from the origin."""
    return (distance * math.cos(bearing), distance * math.sin(bearing))


def chosen(worlds: Pool, share: float, options: Mapping[str, Any]) -> tuple[int, World]:
    """Choose the world of an episode.

    Args:
        worlds: to choose from.
        share: a uniform sample of [0, 1), used where the options name no world.
        options: of the reset; "world" and "difficulty" are used.

    Returns:
        Number of the world (-1 for a World object) and the world.

    Raises:
        ConfigError, WorldError: for a world that isn't in the pool, or isn't one.
    """
    asked = options.get("world")
    if asked is None:
        number = worlds.numbers[_drawn(worlds, share, options.get("difficulty"))]
        return number, worlds[number]
    if isinstance(asked, World):
        return -1, checked(asked, worlds.radius)
    if not (isinstance(asked, int | np.integer) or _whole(asked)):
        raise ConfigError(
            f"world = {shown(asked)}: must be a number of the env's worlds, or a World"
        )
    return int(asked), worlds[int(asked)]


def _whole(value: Any) -> bool:
    """Whether a value is a float without a fraction, as info["world"] is."""
    return isinstance(value, float | np.floating) and float(value).is_integer()


def _drawn(worlds: Pool, share: float, difficulty: Level) -> int:
    """Index into the pool's numbers for a uniform sample, among all or a range of difficulty."""
    if difficulty is None:
        return min(int(share * len(worlds)), len(worlds) - 1)
    ranks = worlds.ranks(difficulty)
    return int(worlds.by_difficulty[0][ranks[min(int(share * len(ranks)), len(ranks) - 1)]])


def drawn(
    worlds: Pool, rng: np.random.Generator, options: Mapping[str, Any], *, follow: bool = False
) -> Assignment:
    """Draw a world, the start in it and the goal.

    Args:
        worlds: to draw from.
        rng: the env's generator; DRAWS numbers are taken.
        options: of the reset: "world", "difficulty" and "goal", see `Spawn.draw`.
        follow: whether the assignment gets the world's path, and starts at one of its ends.

    Raises:
        ConfigError, WorldError: for options out of range, and for a world without a path to follow.
    """
    u = rng.random(DRAWS).tolist()
    number, world = chosen(worlds, u[0], options)
    ends = to_follow(world) if follow else world
    x, y = within(ends.start.x, ends.start.y, ends.start.radius, u[1], u[2])
    theta = ends.start.theta
    theta = (2.0 * u[3] - 1.0) * math.pi if theta is None else theta
    start: Pose = (x, y, theta)
    if options.get("goal") is not None:  # without the world's path, which leads elsewhere
        return Assignment(point("goal", options["goal"]), world, number=number, start=start)
    goal_x, goal_y = within(ends.goal.x, ends.goal.y, ends.goal.radius, u[4], u[5])
    goal: Goal = relative(x, y, math.cos(theta), math.sin(theta), goal_x, goal_y)
    path = followed(ends) if follow else None
    return Assignment(goal, world, path, ends.length, number, start)


def given(path: Any) -> Assignment:
    """Make an assignment of a path that a user gives as points (x, y) in the odometry frame [m].

    The robot starts at the origin of that frame, wherever the path begins.
    """
    world = along(path)
    goal = (world.goal.x, world.goal.y)
    start = Region(0.0, 0.0, 0.0, 0.0)
    world = replace(world, start=start, name="given")
    return Assignment(goal, world, followed(world), world.length)


def followed(world: World) -> Floats:
    """Transform a world's path from the frame of the world into that of its start.

    Args:
        world: whose start is at the path's beginning.

    Returns:
        (samples, 3): x [m], y [m], direction [rad].

    Raises:
        WorldError: where the world has no path.
    """
    if world.path is None or world.start.theta is None:
        raise WorldError(f"{world.name or 'the world'}: has no path to follow")
    samples, start, theta = sampled(world.path), world.start, world.start.theta
    cos, sin = math.cos(theta), math.sin(theta)
    points = (samples[:, :2] - (start.x, start.y)) @ np.array([[cos, -sin], [sin, cos]])
    seen: Floats = np.column_stack([points, samples[:, 2] - theta])
    seen.setflags(write=False)  # tasks are told it
    return seen
