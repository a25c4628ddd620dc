"""The options of a batch's reset, as rows of the state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.tasks.options import known
from acsar_gym.tasks.spawn import Spawn
from acsar_gym.vector.kernel import layout
from acsar_gym.worlds.pool import Pool

Array = NDArray[Any]
Wishes = dict[int, Array]
"""Rows of the state that hold reset options: the row's number -> (robots,). Missing rows are
zero."""


def wishes(spawn: Spawn, options: Mapping[str, Any], robots: int) -> Wishes:
    """Convert a reset's options "world", "difficulty" and "goal" to rows of the state.

    Args:
        spawn: knows which options the task has.
        options: of the reset, without the mask.
        robots: number of robots.

    Raises:
        ConfigError, WorldError: for an unknown option, or a bad value; names the robot.
    """
    given = known(options, tuple(name for name in spawn.options if name != "path"))
    found: Wishes = {}
    if given.get("goal") is not None:
        found |= _goals(spawn, _numbers("goal", given["goal"], robots, 2))
    if spawn.pool is None:
        return found
    if given.get("world") is not None:
        worlds = _numbers("world", given["world"], robots, 1)[:, 0]
        found[layout.WISHED_WORLD] = _worlds(spawn.pool, worlds)
    if given.get("difficulty") is not None:
        found |= _ranks(spawn.pool, _numbers("difficulty", given["difficulty"], robots, 2))
    return found


def _numbers(name: str, value: Any, robots: int, width: int) -> Array:
    """(robots, width) numbers of an option that has one row for each robot, or one for all."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    one, each = ((), (robots,)) if width == 1 else ((width,), (robots, width))
    if array.shape not in (one, each):
        shapes = "a number, or" if width == 1 else "(2,), or"
        raise ConfigError(f"{name}: must be {shapes} an array of shape {each}; NaN is not to ask")
    return np.broadcast_to(array.reshape(-1, width), (robots, width))


def _goals(spawn: Spawn, goals: Array) -> Wishes:
    """Goals (x, y) in the odometry frame [m]; NaN for robots that draw theirs."""
    asked = ~np.isnan(goals).all(axis=1)
    for robot in np.flatnonzero(asked):
        x, y = goals[robot].tolist()
        if not np.isfinite(x + y):
            raise ConfigError(f"goal of robot {robot} = ({x}, {y}): must be finite numbers [m]")
        if spawn.pool is None:
            spawn.checked((x, y))
    x, y = np.where(asked, goals.T, 0.0)
    return {layout.WISHED_GOAL: asked * 1.0, layout.WISHED_X: x, layout.WISHED_Y: y}


def _worlds(pool: Pool, numbers: Array) -> Array:
    """Indices of worlds in the pool, from 1; 0 for robots that draw theirs."""
    asked = ~np.isnan(numbers)
    first, last = pool.numbers[0], pool.numbers[-1]
    sound = (numbers >= first) & (numbers <= last) & (numbers == np.floor(numbers))
    if (asked & ~sound).any():
        robot = int(np.argmax(asked & ~sound))
        raise ConfigError(
            f"world of robot {robot} = {numbers[robot]:g}: must be {first} to {last} ({pool.kind})"
        )
    return np.where(asked, numbers - first + 1.0, 0.0)


def _ranks(pool: Pool, ranges: Array) -> Wishes:
    """First and last rank of each robot's range of difficulty; 0 and 0 where it is NaN."""
    ranks = np.zeros((len(ranges), 2))
    rows, which = np.unique(ranges, axis=0, return_inverse=True)
    for number, (low, high) in enumerate(rows.tolist()):
        if not (np.isnan(low) and np.isnan(high)):
            among = pool.ranks((low, high))
            ranks[which.ravel() == number] = among.start, among.stop
    return {layout.FIRST_RANK: ranks[:, 0], layout.LAST_RANK: ranks[:, 1]}
