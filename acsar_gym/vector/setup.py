"""What compiled loops take: shared numbers, the worlds as arrays, and reset options as fields."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import LINE_BYTES, RobotConfig, whole_ratio
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.lidar.scan import count_trail_rows, ray_spec
from acsar_gym.links.faults import WIRE_BUFFER, Faults
from acsar_gym.physics.model import loop_period, wire_loops
from acsar_gym.physics.randomization import DrawnRanges, longest_delay
from acsar_gym.safety import rules
from acsar_gym.sensors.lidar import stale_after
from acsar_gym.sensors.map.sensor import MAP_NAMES
from acsar_gym.tasks.episode import Spawn, path_from_start
from acsar_gym.tasks.factory import check_reset_options
from acsar_gym.tasks.task import Task
from acsar_gym.vector.kernel import layout
from acsar_gym.vector.kernel.layout import LineFaults
from acsar_gym.wire import STANDSTILL_TIMEOUT
from acsar_gym.worlds import World, geometry
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import align_with_path

Array = NDArray[Any]
ResetOptions = dict[str, Array]
"""A field of `layout.Options` -> (robots,). Missing ones are zero."""


def read_reset_options(spawn: Spawn, options: Mapping[str, Any], robots: int) -> ResetOptions:
    """Convert a reset's options "world", "difficulty" and "goal" to fields of the robots.

    Args:
        spawn: knows which options the task has.
        options: of the reset, without the mask.
        robots: number of robots.

    Raises:
        ConfigError, WorldError: for an unknown option, or a bad value; names the robot.
    """
    given = check_reset_options(options, tuple(name for name in spawn.options if name != "path"))
    found: ResetOptions = {}
    if given.get("goal") is not None:
        goals = _spread_option("goal", given["goal"], robots, 2)
        asked: Array = np.asarray(~np.isnan(goals).all(axis=1))
        for robot in np.flatnonzero(asked):
            x, y = goals[robot].tolist()
            if not np.isfinite([x, y]).all():
                raise ConfigError(f"goal of robot {robot} = ({x}, {y}): must be finite numbers [m]")
            if spawn.pool is None:
                spawn.check_goal((x, y))
        wanted = np.where(asked, goals.T, 0.0)
        found = dict(zip(("wished_x", "wished_y"), wanted, strict=True))
        found["wished_goal"] = asked.astype(np.float64)
    if spawn.pool is not None and given.get("world") is not None:
        numbers = _spread_option("world", given["world"], robots, 1)[:, 0]
        asked, (first, last) = ~np.isnan(numbers), (spawn.pool.numbers[0], spawn.pool.numbers[-1])
        sound = (numbers >= first) & (numbers <= last) & (numbers == np.floor(numbers))
        if (asked & ~sound).any():
            bad = int(np.argmax(asked & ~sound))
            raise ConfigError(
                f"world of robot {bad} = {numbers[bad]:g}: must be {first} to {last} "
                f"({spawn.pool.kind})"
            )
        found["wished_world"] = np.where(asked, numbers - first + 1.0, 0.0)
    if spawn.pool is not None and given.get("difficulty") is not None:
        ranks, ranges = np.zeros((robots, 2)), given["difficulty"]
        ranges = _spread_option("difficulty", ranges, robots, 2)
        rows, which = np.unique(ranges, axis=0, return_inverse=True)
        for number, (low, high) in enumerate(rows.tolist()):
            if not (np.isnan(low) and np.isnan(high)):
                among = spawn.pool.ranks((low, high))
                ranks[which.ravel() == number] = among.start, among.stop
        found |= {"first_rank": ranks[:, 0], "last_rank": ranks[:, 1]}
        _refuse_contradictions(found)
    return found


def _refuse_contradictions(found: ResetOptions) -> None:
    """ConfigError for a robot whose world is chosen by its number and by its difficulty."""
    both = np.flatnonzero((found.get("wished_world", 0.0) > 0.0) & (found["last_rank"] > 0.0))
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
    one, each = ((), (robots,)) if width == 1 else ((width,), (robots, width))
    if array.shape not in (one, each):
        shapes = "a number, or" if width == 1 else "(2,), or"
        raise ConfigError(f"{name}: must be {shapes} an array of shape {each}; NaN is not to ask")
    return np.broadcast_to(array.reshape(-1, width), (robots, width))


BATCH_FAULTS = ("dropped_lines", "late_lines", "lateness", "episodes", "direction")
"""Faults that a batch can simulate: lines that are lost or late."""


def make_setup(  # noqa: PLR0913 - all that a batch is made of
    fleet: Sequence[RobotConfig],
    ranges: Sequence[DrawnRanges],
    ticks: int,
    max_steps: int | None,
    numbers: int,
    faults: Faults,
    *,
    sees: bool,
    maps: bool,
    turns_vary: bool,
) -> layout.Setup:
    """Compute the numbers that all robots of a batch share.

    Args:
        fleet: the kinds of robots, whose `SHARED_FIELDS` are equal.
        ranges: what each kind draws for every episode.
        ticks: control periods in an env step.
        max_steps: time limit of an episode [env steps].
        numbers: how many numbers of the observation are the task's own.
        faults: of the wire.
        sees: whether the robots have a LiDAR.
        maps: whether they have a map.
        turns_vary: whether any kind's turn factor is drawn.
    """
    config = fleet[0]
    dt, firmware = loop_period(config), config.firmware
    limited = any(one.geofence is not None or not rules.is_unlimited(one) for one in fleet)
    delay = max(command_loops(one, drawn) for one, drawn in zip(fleet, ranges, strict=True))
    late = delay * dt > ticks * config.period - dt / 2.0
    return layout.Setup(
        dt=dt,
        period=config.period,
        wire_time=config.wire_time,
        isotropic=not turns_vary and all(one.body.turn_factor is None for one in fleet),
        window=round(config.encoder.window * firmware.loop_rate),
        ticks=ticks,
        loops=whole_ratio("firmware.loop_rate", firmware.loop_rate, "", config.control_rate),
        max_steps=math.inf if max_steps is None else float(max_steps),
        guarded=limited or late or faults.possible,
        faults=LineFaults(
            possible=faults.possible,
            episodes=float(faults.episodes),
            feedback=faults.direction != "commands",
            commands=faults.direction != "feedback",
            dropped=float(faults.dropped_lines),
            late=float(faults.late_lines),
            lateness=float(faults.lateness),
            patience=math.ceil(STANDSTILL_TIMEOUT / config.period),
            line_time=config.line_time,
            processing_time=firmware.processing_time,
            command_timeout=firmware.command_timeout or math.inf,
        ),
        falls_silent=faults.possible and faults.direction != "commands",
        sees=sees,
        numbers=numbers,
        maps=maps,
        first_ray=numbers + maps * len(MAP_NAMES),
    )


def compute_build(
    config: RobotConfig, setup: layout.Setup, kind: int, worlds: range
) -> list[float]:
    """Compute the numbers of `layout.Build` for one kind of robots, and those of its rules.

    Args:
        config: of the kind.
        setup: of the batch.
        kind: its index.
        worlds: indices of the worlds that were made for its footprint.
    """
    per_radian = config.encoder.counts_per_revolution / (2.0 * math.pi)
    accelerations = [config.motor.of_wheel(wheel).acceleration for wheel in range(4)]
    built: dict[str, list[float]] = {
        "kind": [kind],
        "ramp": [acceleration * setup.dt for acceleration in accelerations],
        "counts_per_radian": [per_radian],
        "speed_per_count": [1.0 / (per_radian * setup.window * setup.dt)],
        "quantum": [config.encoder.quantum or 0.0],
        "max_linear": [config.max_linear],
        "max_angular": [config.max_angular],
        "stale": [stale_after(config)],
        "rays": [config.lidar.rays if setup.sees else 0],
        "first_world": [worlds.start],
        "worlds": [len(worlds)],
    }
    own = rules.make_rules(config)[1:]  # but for the period
    guards: list[list[float]] = [[*value] if isinstance(value, tuple) else [value] for value in own]
    each = [*(built[name] for name in layout.BUILD), *guards]
    return [float(number) for numbers in each for number in numbers]


def command_slots(setup: layout.Setup, ranges: DrawnRanges, config: RobotConfig) -> int:
    """Size of the ring of command lines [ticks]: the longest time that one can be on its way."""
    late = 2 * math.ceil(setup.faults.lateness / setup.period) if setup.faults.possible else 0
    return 2 + late + math.ceil(command_loops(config, ranges) / setup.loops)


def count_slots(setup: layout.Setup, ranges: DrawnRanges, config: RobotConfig) -> int:
    """Size of the ring of encoder counts [firmware loops].

    The oldest feedback line that may still be on its way, and the encoders' window before it.

    Args:
        setup: of the batch.
        ranges: of the randomized parameters.
        config: of the robots.

    Raises:
        ConfigError: where feedback is on its way for as long as `feedback_timeout`.
    """
    delay = wire_loops(config) + round(ranges.high.latency / setup.dt)
    if delay * setup.dt >= config.feedback_timeout:
        raise ConfigError(
            f"feedback_timeout = {config.feedback_timeout:g} s: feedback takes "
            f"{delay * setup.dt:g} s on this wire (baud_rate, firmware.processing_time): must be "
            "longer"
        )
    rare = ranges.low.feedback_rate
    rate = config.feedback_rate if math.isnan(rare) else rare
    slowest = math.ceil(1.0 / (rate * setup.dt))
    late = math.ceil(setup.faults.lateness / setup.dt) if setup.faults.possible else 0
    return int(setup.window + delay + late + slowest + setup.loops + 1)


def trail_slots(setup: layout.Setup, ranges: DrawnRanges, config: RobotConfig) -> int:
    """Rows of a robot's trail: two revolutions of the slowest LiDAR; none without one."""
    slowest = ranges.low.lidar_rate
    rate = config.lidar.rate if math.isnan(slowest) else slowest
    return count_trail_rows(2.0 / rate, config.period) if setup.sees else 0


def command_loops(config: RobotConfig, ranges: DrawnRanges) -> int:
    """The longest time until a command has effect, without faults [firmware loops]."""
    latency = ranges.high.latency / loop_period(config)
    return round(wire_loops(config, longest_delay(ranges, config)) + latency)


def check_faults(faults: Mapping[str, Any] | Faults | None, config: RobotConfig) -> Faults:
    """Check the faults of a batch.

    Args:
        faults: as users pass `faults=`; see `Faults.of`.
        config: of the robots.

    Raises:
        ConfigError: for a fault that a batch can't simulate, or a value out of range.
    """
    asked, sound = Faults.of(faults), Faults()
    for name in Faults.model_fields:
        if name not in BATCH_FAULTS and getattr(asked, name) != getattr(sound, name):
            raise ConfigError(
                f"faults: {name}: a batch knows {', '.join(BATCH_FAULTS)}; for others "
                "make_vec with vectorization_mode='sync'"
            )
    most = WIRE_BUFFER / (max(config.control_rate, config.feedback_rate) * (LINE_BYTES + 1))
    if asked.late_lines > 0.0 and asked.lateness > most:
        raise ConfigError(
            f"faults: lateness = {asked.lateness:g}: must be at most {most:.3g} s in a batch, so "
            "that no lines are lost behind a late one"
        )
    return asked


MAX_WORLDS = 10_000
"""Worlds of a batch, at most."""
PADDING_PLACE = 1e6
"""Coordinates of the unused circles and segments that pad the arrays [m]."""


def make_worlds(pools: Sequence[Pool | None], *, follow: bool) -> tuple[list[World], list[range]]:
    """Make all worlds of all pools, each pool's once.

    Args:
        pools: of each kind of robots, the same object where footprints are as large; None on an
            open floor.
        follow: whether robots follow the worlds' paths, from their beginnings.

    Returns:
        The worlds of one pool after another's, and where those of each kind are.

    Raises:
        WorldError: for more than 10,000 of a footprint, before any is made.
    """
    worlds: list[World] = []
    places: dict[int, range] = {}
    for pool in pools:
        if pool is None or id(pool) in places:
            continue
        if len(pool) > MAX_WORLDS:
            raise WorldError(
                f"worlds: {len(pool):,} of {pool.kind} are too many for a batch, which makes "
                f"them all when it begins: at most {MAX_WORLDS:,}"
            )
        made = [align_with_path(world) if follow else world for world in pool]
        places[id(pool)] = range(len(worlds), len(worlds) + len(made))
        worlds += made
    return worlds, [range(0) if pool is None else places[id(pool)] for pool in pools]


def spawn_arrays(
    task: Task, worlds: Sequence[World], pools: Sequence[Pool | None], places: Sequence[range]
) -> layout.Spawns:
    """Make the arrays of starts, goals and paths.

    Args:
        task: of the batch; has the goal distances for an open floor.
        worlds: all worlds, from `make_worlds`.
        pools: of each kind of robots.
        places: where their worlds are.
    """
    low, high = task.goal_distance
    starts = [world.start for world in worlds]
    order = np.arange(len(worlds), dtype=np.int64)
    for pool, place in zip(pools, places, strict=True):
        if pool is not None and pool.generated:
            order[place.start : place.stop] = place.start + pool.by_difficulty[0]
    paths = [path_from_start(world) for world in worlds] if task.follows else []
    return layout.Spawns(
        min_distance=float(low),
        max_distance=float(high),
        starts=np.array(
            [(s.x, s.y, s.radius, math.nan if s.theta is None else s.theta) for s in starts]
        ).reshape(-1, 4),
        goals=np.array([(w.goal.x, w.goal.y, w.goal.radius) for w in worlds]).reshape(-1, 3),
        lengths=np.array([world.length for world in worlds], np.float64),
        paths=geometry.pad_rows(paths, (0.0, 0.0, 0.0)),
        samples=np.array([len(samples) for samples in paths], np.int64),
        order=order,
    )


def pad_surroundings(
    worlds: Sequence[World], fleet: Sequence[RobotConfig], *, sees: bool
) -> geometry.Surroundings:
    """Make the arrays of obstacles of all worlds, padded to the world with most of them, and rays.

    Args:
        worlds: of the batch; none on an open floor.
        fleet: the kinds of robots.
        sees: whether the robots have a LiDAR.
    """
    far = PADDING_PLACE
    obstacles = geometry.Obstacles(
        geometry.pad_rows([world.circles for world in worlds], (far, far, 0.0)),
        geometry.pad_rows([world.segments for world in worlds], (far, far, far, far)),
    )
    specs = [ray_spec(config) if sees else None for config in fleet]
    return geometry.surround_kinds(obstacles, specs, max(len(worlds), 1), fleet)
