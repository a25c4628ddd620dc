"""A task and its worlds as the arrays that compiled loops need."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import WorldError
from acsar_gym.lidars.base import ray_spec
from acsar_gym.tasks import Barn, ObstacleGoal, PathFollow, PointGoal
from acsar_gym.tasks.barn import SCORES
from acsar_gym.vector.kernel import layout
from acsar_gym.worlds import World, cache, geometry
from acsar_gym.worlds.paths import sampled, to_follow
from acsar_gym.worlds.world import Floats

BatchTask = PointGoal | ObstacleGoal | Barn | PathFollow
"""Tasks that batches know."""
Integers = NDArray[np.int64]
MOST_WORLDS = 10_000
"""Of a batch."""
FAR = 1e6
"""Where unused circles and segments lie [m]."""


def worlds_of(task: BatchTask) -> list[World]:
    """All worlds of a task; none for goals on an open floor.

    Raises WorldError for more than 10,000, before any is made.
    """
    if isinstance(task, PointGoal):
        return []
    if len(task.pool) > MOST_WORLDS:
        raise WorldError(
            f"worlds: {len(task.pool):,} of {task.pool.kind} are too many for a batch, which makes "
            f"them all when it begins: at most {MOST_WORLDS:,}"
        )
    with cache.keeping():
        worlds = list(task.pool)
    return [to_follow(world) for world in worlds] if isinstance(task, PathFollow) else worlds


def first_number(task: BatchTask) -> int:
    """The number of a task's first world."""
    return 0 if isinstance(task, PointGoal) else task.pool.numbers[0]


def told(task: BatchTask) -> dict[str, int]:
    """Keys of the task's info, and the rows of the state that hold them."""
    rows = dict(layout.INFO)
    rows |= layout.PATH_INFO if isinstance(task, PathFollow) else layout.GOAL_INFO
    rows |= {} if isinstance(task, PointGoal) else layout.WORLD_INFO
    rows |= layout.SCAN_INFO if task.sees else {}
    if isinstance(task, Barn):
        rows |= {name: layout.SCORE + number for number, name in enumerate(SCORES)}
    return rows


def job(task: BatchTask, worlds: Sequence[World]) -> layout.Job:
    """The task's figures, and starts, goals and paths of its worlds."""
    follows = isinstance(task, PathFollow)
    paths, lasts = _paths(worlds if follows else ())
    return layout.Job(
        follows=follows,
        scored=isinstance(task, Barn),
        min_distance=task.min_distance if isinstance(task, PointGoal) else 0.0,
        max_distance=task.max_distance if isinstance(task, PointGoal) else 0.0,
        scale=1.0 if isinstance(task, PathFollow) else task.scale,
        tolerance=1.0 if isinstance(task, PathFollow) else task.tolerance,
        boundary=math.inf if isinstance(task, PathFollow) else task.boundary,
        end=0.0 if isinstance(task, PathFollow) else task.end,
        max_cross_track=task.max_cross_track if isinstance(task, PathFollow) else 1.0,
        starts=np.array([_start(world) for world in worlds]).reshape(-1, 4),
        goals=np.array([(w.goal.x, w.goal.y, w.goal.radius) for w in worlds]).reshape(-1, 3),
        lengths=np.array([world.length for world in worlds]),
        paths=paths,
        lasts=lasts,
        order=_order(task),
    )


def _order(task: BatchTask) -> Integers:
    """The worlds from the easiest to the hardest; as they are where they have no difficulty."""
    if isinstance(task, PointGoal):
        return np.zeros(0, np.int64)
    ranked = task.pool.generated
    return task.pool.by_difficulty[0] if ranked else np.arange(len(task.pool), dtype=np.int64)


def _start(world: World) -> tuple[float, float, float, float]:
    start = world.start
    return start.x, start.y, start.radius, math.nan if start.theta is None else start.theta


def _paths(worlds: Sequence[World]) -> tuple[Floats, Integers]:
    """Samples of every world's path, padded to the longest, and the number of each one's last."""
    every = [sampled(world.path) for world in worlds if world.path is not None]
    longest = max((len(samples) for samples in every), default=0)
    padded = np.zeros((len(every), longest, 3))
    for number, samples in enumerate(every):
        padded[number, : len(samples)] = samples
    return padded, np.array([len(samples) - 1 for samples in every], np.int64)


def surroundings(
    worlds: Sequence[World], config: RobotConfig, *, sees: bool
) -> geometry.Surroundings:
    """Obstacles of all worlds, padded to the most crowded one, and the robots' LiDAR."""
    obstacles = geometry.Obstacles(
        _padded([world.circles for world in worlds], (FAR, FAR, 0.0)),
        _padded([world.segments for world in worlds], (FAR, FAR, FAR, FAR)),
    )
    spec = ray_spec(config) if sees else None
    return geometry.surroundings(obstacles, spec, max(len(worlds), 1), config)


def _padded(rows: Sequence[Floats], unused: tuple[float, ...]) -> Floats:
    longest = max((len(array) for array in rows), default=0)
    padded = np.tile(np.array(unused), (max(len(rows), 1), longest, 1))
    for number, array in enumerate(rows):
        padded[number, : len(array)] = array
    return padded
