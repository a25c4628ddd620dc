"""The options that users pass to a batch, checked, and those of its resets as fields of robots."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from acsar_gym.config import LINE_BYTES, RobotConfig
from acsar_gym.errors import ConfigError, show_value
from acsar_gym.links.faults import WIRE_BUFFER, Faults
from acsar_gym.tasks.episode import Spawn
from acsar_gym.tasks.options import SharedOptions, check_reset_options
from acsar_gym.worlds.pool import Pool

Array = NDArray[Any]
ResetOptions = dict[str, Array]  # a field of `layout.Options` -> (robots,). Missing ones are zero
MAX_ROBOTS = 1_000_000  # robots of a batch, at most; so many take about 2 GB


class BatchOptions(SharedOptions):
    """The options of a batch; `RobotVectorEnv` describes them."""

    autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP
    threads: Any = None
    link: Any = "planar"


def check_seeds(seed: Any, robots: int) -> list[int | None] | None:
    """A seed for each robot; None where nothing is seeded."""
    if seed is None:
        return None
    single = isinstance(seed, int | np.integer)
    try:
        seeds = [seed] if single else list(seed)
    except TypeError as error:
        raise ConfigError(
            f"seed = {show_value(seed)}: must be a whole number, or a list"
        ) from error
    if not single and len(seeds) != robots:
        raise ConfigError(f"{len(seeds)} seeds for {robots} robots: give one each")
    for value in seeds:
        if value is not None and (not isinstance(value, int | np.integer) or value < 0):
            raise ConfigError(f"seed = {show_value(value)}: must be a whole number of at least 0")
    return [int(seed) + index for index in range(robots)] if single else seeds


def check_faults(faults: Mapping[str, Any] | Faults | None, config: RobotConfig) -> Faults:
    """Check the faults of a batch."""
    chosen = Faults.of(faults)
    most = WIRE_BUFFER / (max(config.control_rate, config.feedback_rate) * (LINE_BYTES + 1))
    if chosen.late_lines > 0.0 and chosen.lateness > most:
        raise ConfigError(
            f"faults: lateness = {chosen.lateness:g}: must be at most {most:.3g} s in a batch, so "
            "that no lines are lost behind a late one"
        )
    return chosen


def read_reset_options(spawn: Spawn, options: Mapping[str, Any], robots: int) -> ResetOptions:
    """Convert a reset's options "world", "difficulty" and "goal" to fields of the robots."""
    given = check_reset_options(options, tuple(name for name in spawn.options if name != "path"))
    fields: ResetOptions = {}
    if given.get("goal") is not None:
        goals = _spread_option("goal", given["goal"], robots, 2)
        is_given: Array = np.asarray(~np.isnan(goals).all(axis=1))
        for robot in np.flatnonzero(is_given):
            x, y = goals[robot].tolist()
            if not np.isfinite([x, y]).all():
                raise ConfigError(f"goal of robot {robot} = ({x}, {y}): must be finite numbers [m]")
            if spawn.pool is None:
                spawn.check_goal((x, y))
        wanted = np.where(is_given, goals.T, 0.0)
        fields = dict(zip(("wished_x", "wished_y"), wanted, strict=True))
        fields["wished_goal"] = is_given.astype(np.float64)
    if spawn.pool is not None and given.get("world") is not None:
        fields["wished_world"] = _place_worlds(spawn.pool, given["world"], robots)
    if spawn.pool is not None and given.get("difficulty") is not None:
        ranks, ranges = np.zeros((robots, 2)), given["difficulty"]
        ranges = _spread_option("difficulty", ranges, robots, 2)
        rows, which = np.unique(ranges, axis=0, return_inverse=True)
        for number, (low, high) in enumerate(rows.tolist()):
            if not (np.isnan(low) and np.isnan(high)):
                among = spawn.pool.ranks((low, high))
                ranks[which.ravel() == number] = among.start, among.stop
        fields |= {"first_rank": ranks[:, 0], "last_rank": ranks[:, 1]}
        _refuse_contradictions(fields)
    return fields


def _place_worlds(pool: Pool, value: Any, robots: int) -> Array:
    """Places of the worlds that are asked for, from 1; 0 for a robot without a wish."""
    if pool.numbers is None:
        raise ConfigError(
            "world: a number names no world of several sets: draw with 'difficulty', or make a "
            "batch of one set"
        )
    numbers = _spread_option("world", value, robots, 1)[:, 0]
    is_given = ~np.isnan(numbers)
    first, last = pool.numbers[0], pool.numbers[-1]
    sound = (numbers >= first) & (numbers <= last) & (numbers == np.floor(numbers))
    if (is_given & ~sound).any():
        bad = int(np.argmax(is_given & ~sound))
        raise ConfigError(f"world of robot {bad} = {numbers[bad]:g}: must be of {pool}")
    places: Array = np.where(is_given, numbers - first + 1.0, 0.0)
    return places


def _refuse_contradictions(fields: ResetOptions) -> None:
    """ConfigError for a robot whose world is chosen by its number and by its difficulty."""
    both = np.flatnonzero((fields.get("wished_world", 0.0) > 0.0) & (fields["last_rank"] > 0.0))
    if both.size:
        raise ConfigError(
            f"reset options 'world' and 'difficulty' of robot {both[0]} contradict each other, as "
            "each chooses the surroundings: give one of them"
        )


def _spread_option(name: str, value: Any, robots: int, width: int) -> Array:
    """(robots, width) numbers of an option that has one row for each robot, or one for all."""
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        array = np.zeros(0)
    for_all, for_each = ((), (robots,)) if width == 1 else ((width,), (robots, width))
    if array.shape not in (for_all, for_each):
        shapes = "a number, or" if width == 1 else "(2,), or"
        raise ConfigError(
            f"{name}: must be {shapes} an array of shape {for_each}; NaN is not to ask"
        )
    return np.broadcast_to(array.reshape(-1, width), (robots, width))
