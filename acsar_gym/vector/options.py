"""The options that users pass to a batch, checked, and those of its resets as fields of robots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, show_value
from acsar_gym.tasks.episode import Spawn
from acsar_gym.tasks.options import SharedOptions
from acsar_gym.worlds.pool import Pool

Array = NDArray[Any]
ResetOptions = dict[str, Array]
"""Fields of `layout.Options`, (robots,). Missing fields are zero."""
MAX_ROBOTS = 1_000_000
"""Most robots of a batch, which take about 2 GB."""


class BatchOptions(SharedOptions):
    """The options of a batch, which `RobotVectorEnv` describes."""

    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP
    threads: Any = None
    link: Any = "planar"


def check_seeds(seed: Any, robots: int) -> list[int | None] | None:
    """Return a seed for each robot. None if nothing is seeded."""
    if seed is None:
        return None
    is_single = isinstance(seed, int | np.integer)
    try:
        seeds = [seed] if is_single else list(seed)
    except TypeError:
        seeds = [seed]

    for value in seeds:
        if value is not None and (not isinstance(value, int | np.integer) or value < 0):
            raise ConfigError(
                f"seed = {show_value(value)}: must be a whole number of at least 0, or a list"
            )
    if is_single:
        return [int(seed) + robot for robot in range(robots)]
    if len(seeds) != robots:
        raise ConfigError(f"{len(seeds)} seeds for {robots} robots: give each a seed")
    return seeds


def read_reset_options(spawn: Spawn, options: Mapping[str, Any], robots: int) -> ResetOptions:
    """Convert a reset's options "world", "difficulty" and "goal" to fields of the robots."""
    fields: ResetOptions = {}
    if options.get("goal") is not None:
        fields |= _read_goals(spawn, options["goal"], robots)
    if spawn.pool is not None and options.get("world") is not None:
        fields["wished_world"] = _place_worlds(spawn.pool, options["world"], robots)
    if spawn.pool is not None and options.get("difficulty") is not None:
        fields |= _rank_worlds(spawn.pool, options["difficulty"], robots)
        _refuse_contradictions(fields)
    return fields


def _read_goals(spawn: Spawn, value: Any, robots: int) -> ResetOptions:
    """Goals in the odometry frame [m]."""
    goals = _spread_option("goal", value, robots, width=2)
    is_wished: Array = np.asarray(~np.isnan(goals).all(axis=1))
    for robot in np.flatnonzero(is_wished):
        x, y = goals[robot].tolist()
        if not np.isfinite([x, y]).all():
            raise ConfigError(f"goal of robot {robot} = ({x}, {y}): must be finite numbers [m]")

        # Worlds may have goals anywhere, an open floor has limits.
        if spawn.pool is None:
            spawn.check_goal((x, y))
    return {
        "wished_goal": is_wished.astype(np.float64),
        "wished_x": np.where(is_wished, goals[:, 0], 0.0),
        "wished_y": np.where(is_wished, goals[:, 1], 0.0),
    }


def _rank_worlds(pool: Pool, value: Any, robots: int) -> ResetOptions:
    """Ranks of the worlds whose difficulties lie in ranges."""
    ranges = _spread_option("difficulty", value, robots, width=2)
    ranks = np.zeros((robots, 2))

    # Robots share few ranges, and each is looked up once.
    rows, which = np.unique(ranges, axis=0, return_inverse=True)
    for number, (low, high) in enumerate(rows.tolist()):
        if not (np.isnan(low) and np.isnan(high)):
            among = pool.ranks((low, high))
            ranks[which.ravel() == number] = (among.start, among.stop)
    return {"first_rank": ranks[:, 0], "last_rank": ranks[:, 1]}


def _place_worlds(pool: Pool, value: Any, robots: int) -> Array:
    """Places of the worlds that are chosen, from 1. 0 for a robot without a choice."""
    if pool.numbers is None:
        raise ConfigError(
            "world: a number names no world of several sets: draw with 'difficulty', or make a "
            "batch of one set"
        )
    numbers = _spread_option("world", value, robots, width=1)[:, 0]
    first = pool.numbers[0]
    last = pool.numbers[-1]

    is_wished = ~np.isnan(numbers)
    is_sound = (numbers >= first) & (numbers <= last) & (numbers == np.floor(numbers))
    if (is_wished & ~is_sound).any():
        bad = int(np.argmax(is_wished & ~is_sound))
        raise ConfigError(f"world of robot {bad} = {numbers[bad]:g}: must be of {pool}")

    # 0 stands for no choice, so places count from 1.
    places: Array = np.where(is_wished, numbers - first + 1.0, 0.0)
    return places


def _refuse_contradictions(fields: ResetOptions) -> None:
    """ConfigError for a robot whose world is chosen by its number and by its difficulty."""
    has_number = fields.get("wished_world", 0.0) > 0.0
    robots = np.flatnonzero(has_number & (fields["last_rank"] > 0.0))
    if robots.size:
        raise ConfigError(
            f"reset options 'world' and 'difficulty' of robot {robots[0]} contradict each other, "
            "as each chooses the surroundings: give one of them"
        )


def _spread_option(name: str, value: Any, robots: int, width: int) -> Array:
    """(robots, width) numbers of an option that has one row for each robot, or one for all."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    of_all = () if width == 1 else (width,)
    of_each = (robots, *of_all)
    if array.shape not in (of_all, of_each):
        shapes = "a number, or" if width == 1 else "(2,), or"
        raise ConfigError(
            f"{name}: must be {shapes} an array of shape {of_each}; NaN leaves the robot without it"
        )
    return np.broadcast_to(array.reshape(-1, width), (robots, width))
