"""The worlds of a task as the arrays that compiled loops need."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import WorldError
from acsar_gym.lidars.base import ray_spec
from acsar_gym.tasks.base import Task
from acsar_gym.tasks.spawn import followed
from acsar_gym.vector.kernel import layout
from acsar_gym.worlds import World, cache, geometry
from acsar_gym.worlds.paths import to_follow
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.world import Floats

Integers = NDArray[np.int64]
MOST_WORLDS = 10_000
"""Worlds of a batch, at most."""
FAR = 1e6
"""Coordinates of the unused circles and segments that pad the arrays [m]."""


def worlds_of(pool: Pool | None, *, follow: bool) -> list[World]:
    """Make all worlds of a pool.

    Args:
        pool: the worlds; None on an open floor, for which the list is empty.
        follow: whether robots follow the worlds' paths, from their beginnings.

    Raises:
        WorldError: for more than 10,000, before any is made.
    """
    if pool is None:
        return []
    if len(pool) > MOST_WORLDS:
        raise WorldError(
            f"worlds: {len(pool):,} of {pool.kind} are too many for a batch, which makes "
            f"them all when it begins: at most {MOST_WORLDS:,}"
        )
    with cache.keeping():
        worlds = list(pool)
    return [to_follow(world) for world in worlds] if follow else worlds


def spawns(task: Task, pool: Pool | None, worlds: Sequence[World]) -> layout.Spawns:
    """Make the arrays of starts, goals and paths.

    Args:
        task: of the batch; has the goal distances for an open floor.
        pool: the worlds, or None.
        worlds: all worlds of the pool, in its order.
    """
    paths, samples = _paths(worlds if task.follows else ())
    low, high = task.goal_distance
    return layout.Spawns(
        min_distance=float(low),
        max_distance=float(high),
        starts=np.array([_start(world) for world in worlds]).reshape(-1, 4),
        goals=np.array([(w.goal.x, w.goal.y, w.goal.radius) for w in worlds]).reshape(-1, 3),
        lengths=np.array([world.length for world in worlds], np.float64),
        paths=paths,
        samples=samples,
        order=_order(pool),
    )


def _order(pool: Pool | None) -> Integers:
    """Indices of the worlds from the easiest to the hardest, or unsorted."""
    if pool is None:
        return np.zeros(0, np.int64)
    return pool.by_difficulty[0] if pool.generated else np.arange(len(pool), dtype=np.int64)


def _start(world: World) -> tuple[float, float, float, float]:
    """x, y, radius [m] and theta [rad] of a world's start region; NaN for any direction."""
    start = world.start
    return start.x, start.y, start.radius, math.nan if start.theta is None else start.theta


def _paths(worlds: Sequence[World]) -> tuple[Floats, Integers]:
    """Samples of every world's path, padded to the longest, and the number of samples of each."""
    every = [followed(world) for world in worlds]
    longest = max((len(samples) for samples in every), default=0)
    padded = np.zeros((max(len(every), 1), longest, 3))
    for number, samples in enumerate(every):
        padded[number, : len(samples)] = samples
    return padded, np.array([len(samples) for samples in every], np.int64)


def surroundings(
    worlds: Sequence[World], config: RobotConfig, *, sees: bool
) -> geometry.Surroundings:
    """Make the arrays of obstacles of all worlds, padded to the world with most of them, and rays.

    Args:
        worlds: of the batch; none on an open floor.
        config: of the robots.
        sees: whether the robots have a LiDAR.
    """
    obstacles = geometry.Obstacles(
        _padded([world.circles for world in worlds], (FAR, FAR, 0.0)),
        _padded([world.segments for world in worlds], (FAR, FAR, FAR, FAR)),
    )
    spec = ray_spec(config) if sees else None
    return geometry.surroundings(obstacles, spec, max(len(worlds), 1), config)


def _padded(rows: Sequence[Floats], unused: tuple[float, ...]) -> Floats:
    """Stack arrays of different lengths to (arrays, longest, numbers), padded with `unused`."""
    longest = max((len(array) for array in rows), default=0)
    padded = np.tile(np.array(unused), (max(len(rows), 1), longest, 1))
    for number, array in enumerate(rows):
        padded[number, : len(array)] = array
    return padded
