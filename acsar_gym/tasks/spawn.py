"""Which world an episode takes place in, and where in it the robot stands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, shown
from acsar_gym.tasks.base import Assignment, Goal, point, relative, within
from acsar_gym.worlds import Pose, Region, World
from acsar_gym.worlds.generators import Level
from acsar_gym.worlds.paths import along, sampled, to_follow
from acsar_gym.worlds.pool import Pool, Source, checked
from acsar_gym.worlds.search import footprint_radius
from acsar_gym.worlds.world import Floats

OPTIONS = "world", "difficulty", "goal"
"""Of a reset, for tasks with worlds and goals."""
DRAWS = 6
"""Numbers of [0, 1) that a place takes: world, start (2), heading, goal (2)."""


def pool(source: Source, difficulty: Level, config: RobotConfig) -> Pool:
    """An env's worlds, made for its robot's footprint. Raises WorldError for a bad source."""
    return Pool.of(source, difficulty, footprint_radius(config))


def chosen(worlds: Pool, share: float, options: Mapping[str, Any]) -> tuple[int, World]:
    """Number and world: as the options say, or for a number of [0, 1)."""
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
    """Whether it is a float without a fraction, as info["world"]."""
    return isinstance(value, float | np.floating) and float(value).is_integer()


def _drawn(worlds: Pool, share: float, difficulty: Level) -> int:
    """A world's place in the pool's numbers, drawn from all, or those of a range of difficulty."""
    if difficulty is None:
        return min(int(share * len(worlds)), len(worlds) - 1)
    ranks = worlds.ranks(difficulty)
    return int(worlds.by_difficulty[0][ranks[min(int(share * len(ranks)), len(ranks) - 1)]])


def drawn(
    worlds: Pool, rng: np.random.Generator, options: Mapping[str, Any], *, follow: bool = False
) -> Assignment:
    """A world of the pool, where in it the robot starts, and where its goal is.

    `follow` asks for the world's path, sampled, from one end to the other; WorldError where it has
    none.

    Options: "world", a number or a World; "difficulty", (low, high) of the worlds to draw from;
    "goal", (x, y) in the odometry frame [m].
    """
    u = rng.random(DRAWS).tolist()
    number, world = chosen(worlds, u[0], options)
    ends = to_follow(world) if follow else world
    x, y = within(ends.start.x, ends.start.y, ends.start.radius, u[1], u[2])
    theta = ends.start.theta
    theta = (2.0 * u[3] - 1.0) * math.pi if theta is None else theta
    start: Pose = (x, y, theta)
    if options.get("goal") is not None:  # the world's own path leads elsewhere
        return Assignment(point("goal", options["goal"]), world, number=number, start=start)
    goal_x, goal_y = within(ends.goal.x, ends.goal.y, ends.goal.radius, u[4], u[5])
    goal: Goal = relative(x, y, math.cos(theta), math.sin(theta), goal_x, goal_y)
    path = _followed(ends.path, start) if follow and ends.path is not None else None
    return Assignment(goal, world, path, ends.length, number, start)


def given(path: Any) -> Assignment:
    """A path in the odometry frame: the robot starts at its origin, wherever the path begins."""
    world = along(path)
    goal = (world.goal.x, world.goal.y)
    start = Region(0.0, 0.0, 0.0, 0.0)
    world = replace(world, start=start, name="given")
    followed = None if world.path is None else _followed(world.path, (0.0, 0.0, 0.0))
    return Assignment(goal, world, followed, world.length)


def _followed(path: Floats, pose: Pose) -> Floats:
    """N x 3: the samples of a path, in the odometry frame that begins at the pose."""
    samples = sampled(path)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    points = (samples[:, :2] - pose[:2]) @ np.array([[cos, -sin], [sin, cos]])
    return np.column_stack([points, samples[:, 2] - pose[2]])
