"""Make the arrays of a batch from robots, worlds and a task."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, whole_ratio
from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.jit import record_of
from acsar_gym.lidar.scan import count_trail_rows, make_rays, ray_spec
from acsar_gym.physics import Randomization, compute_physics
from acsar_gym.physics.model import loop_period, wire_loops
from acsar_gym.physics.randomization import DrawnRanges
from acsar_gym.safety.rules import AxisLimits, make_rules
from acsar_gym.sensors.lidar import stale_after
from acsar_gym.sensors.map.sensor import make_record
from acsar_gym.sensors.map.way import SCRATCH
from acsar_gym.tasks.episode import path_from_start
from acsar_gym.tasks.task import Task
from acsar_gym.vector.kernel import layout
from acsar_gym.worlds import World, geometry
from acsar_gym.worlds.crowd import STATE_NUMBERS
from acsar_gym.worlds.movers import make_motions, pad_rows
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import align_with_path

MAX_WORLDS = 10_000
"""Most worlds of a batch, all of which are made when it is."""
PADDING_PLACE = 1e6
"""Coordinates of the unused circles and segments that pad the arrays [m]: any far place will do."""

Floats = NDArray[np.float64]


class Kind(NamedTuple):
    """The robots of a batch that have the same configuration."""

    config: RobotConfig
    randomization: Randomization
    """What they draw for every episode."""
    ranges: DrawnRanges
    """Ranges of that."""
    pool: Pool | None
    """Worlds that fit their footprint."""
    worlds: range
    """Places of these among all worlds of the batch."""


def make_worlds(pools: Sequence[Pool | None], *, follow: bool) -> tuple[list[World], list[range]]:
    """Make all worlds of all pools, each pool's once, and find where those of each pool are."""
    worlds: list[World] = []

    # Footprints of the same size share a pool, which is known by its identity.
    places: dict[int, range] = {id(None): range(0)}
    for pool in pools:
        if pool is None or id(pool) in places:
            continue
        if len(pool) > MAX_WORLDS:
            raise WorldError(
                f"worlds: {len(pool):,} ({pool}) are too many for a batch, which makes them all "
                f"when it begins: at most {MAX_WORLDS:,}"
            )
        first = len(worlds)

        # A robot that follows a path starts on it, wherever the world's own start is.
        worlds += [align_with_path(world) if follow else world for world in pool]
        places[id(pool)] = range(first, len(worlds))
    return worlds, [places[id(pool)] for pool in pools]


def make_setup(kinds: Sequence[Kind], **numbers: Any) -> layout.Setup:
    """Compute the numbers that all robots of a batch share."""
    config = kinds[0].config
    loop_rate = config.firmware.loop_rate

    # Equal friction in all directions is faster to compute, so it has to hold for all kinds.
    turns_freely = any(
        "turn_factor" in kind.randomization.names or kind.config.body.turn_factor is not None
        for kind in kinds
    )

    return layout.Setup(
        dt=loop_period(config),
        period=config.period,
        wire_time=config.wire_time,
        isotropic=not turns_freely,
        window=round(config.encoder.window * loop_rate),
        loops=whole_ratio("firmware.loop_rate", loop_rate, "", config.control_rate),
        **numbers,
    )


def make_ring(blocks: NDArray[Any], slots: int, numbers: int) -> Floats:
    """Zeros for each robot, (blocks, slots, numbers, BLOCK_ROBOTS)."""
    return np.zeros((len(blocks), slots, numbers, layout.BLOCK_ROBOTS))


def count_slots(setup: layout.Setup, kind: Kind) -> int:
    """Size of the ring of encoder counts [firmware loops].

    The oldest feedback line that may still be on its way, and the encoders' window before it.

    Raises:
        ConfigError: Feedback is on its way for as long as `feedback_timeout`.
    """
    config = kind.config
    latency = (kind.randomization.latency or (0.0,))[-1]
    delay = wire_loops(config) + round(latency / setup.dt)
    if delay * setup.dt >= config.feedback_timeout:
        raise ConfigError(
            f"feedback_timeout = {config.feedback_timeout:g} s: feedback takes "
            f"{delay * setup.dt:g} s on this wire (baud_rate, firmware.processing_time): must be "
            "longer"
        )
    slowest_rate = (kind.randomization.feedback_rate or (config.feedback_rate,))[0]

    # Until the next line is there, the counts of the last line are still needed.
    between_lines = math.ceil(1.0 / (slowest_rate * setup.dt))
    return int(setup.window + delay + between_lines + setup.loops + 1)


def count_commands(setup: layout.Setup, kind: Kind) -> int:
    """Size of the ring of commands [ticks]: the longest time until a command has effect."""
    latency = (kind.randomization.latency or (0.0,))[-1] / setup.dt
    delay = kind.randomization.longest_delay(kind.config)
    return 2 + math.ceil(round(wire_loops(kind.config, delay) + latency) / setup.loops)


def make_draws(robots: int, kinds: Sequence[Kind]) -> layout.Draws:
    """Make the arrays from which the physics of episodes is drawn."""
    # Without randomization nothing is kept for info.
    varies = any(kind.randomization.names for kind in kinds)
    delays = [np.reshape(kind.ranges.delays, (-1, 1)) for kind in kinds]
    return layout.Draws(
        nominal=np.array([compute_physics(kind.config) for kind in kinds]),
        low=np.array([kind.ranges.low for kind in kinds]),
        high=np.array([kind.ranges.high for kind in kinds]),
        delays=pad_rows(delays, (0.0,))[:, :, 0],
        delay_counts=np.array([len(rows) for rows in delays], np.int64),
        drawn=np.zeros((robots, len(kinds[0].ranges.low) if varies else 0)),
    )


def make_scans(
    robots: int, worlds: Sequence[World], setup: layout.Setup, kinds: Sequence[Kind]
) -> layout.Scans | None:
    """Make the arrays of obstacles, rays and trails. None if there is nothing to see or touch.

    Obstacles are padded to the world with most of them.
    """
    if not (setup.sees or any(world.obstacles or world.movers for world in worlds)):
        return None
    fleet = [kind.config for kind in kinds]

    # Compiled loops need arrays of one shape: the rest is filled with obstacles far away.
    around = geometry.surround_kinds(
        pad_rows([world.circles for world in worlds], (PADDING_PLACE, PADDING_PLACE, 0.0)),
        pad_rows([world.segments for world in worlds], (PADDING_PLACE,) * 4),
        [ray_spec(config) if setup.sees else None for config in fleet],
        fleet,
    )

    # Two revolutions of the slowest LiDAR.
    slots = 0
    if setup.sees:
        rates = [kind.randomization.lidar_rate or (kind.config.lidar.rate,) for kind in kinds]
        durations = [2.0 / slowest for slowest, *_ in rates]
        slots = max(count_trail_rows(duration, setup.period) for duration in durations)
    return layout.Scans(
        around=around,
        rays=np.concatenate([record_of(make_rays(config)) for config in fleet]),
        trails=np.zeros((2, robots, slots, 4)),
    )


def make_crowds(worlds: Sequence[World], scans: layout.Scans | None) -> layout.Crowds | None:
    """Make the arrays of what moves. None if nothing does."""
    if scans is None or not any(world.movers for world in worlds):
        return None
    motions = make_motions([world.movers for world in worlds])

    # Movers have the same slots as robots, so that a LiDAR finds both in one row.
    _, robots, slots, _ = scans.trails.shape
    movers = motions.movers.shape[1]
    return layout.Crowds(
        motions,
        states=np.zeros((robots, movers, STATE_NUMBERS)),
        trails=np.zeros((robots, slots, movers, 2)),
    )


def make_maps(robots: int, blocks: int, kinds: Sequence[Kind], step: float) -> layout.Maps:
    """Make the robots' empty maps. `step` is the duration of an env step [s]."""
    # Robot i is of kind i % (number of kinds).
    records = np.concatenate([make_record(kind.config, step) for kind in kinds])
    return layout.Maps(
        records[np.arange(robots) % len(records)],
        scratch=np.zeros((blocks, SCRATCH), np.int32),
    )


def write_builds(blocks: NDArray[Any], kinds: Sequence[Kind], setup: layout.Setup) -> None:
    """Write the numbers of `layout.Build`, and those of the safety rules, of all robots."""
    number_of_robot = np.arange(len(blocks) * layout.BLOCK_ROBOTS).reshape(len(blocks), -1)
    kind_of_robot = number_of_robot % len(kinds)

    # Numbers of wheels are (4,) in a description, and (4, BLOCK_ROBOTS) in a block.
    def write(fields: NDArray[Any], rows: Sequence[Mapping[str, Any]]) -> None:
        for name in rows[0]:
            values = [row[name] for row in rows]
            if isinstance(values[0], AxisLimits):
                write(fields[name], [axis._asdict() for axis in values])

            # All robots have the same period, which is in `Setup`.
            elif name != "period":
                columns = np.array(values, np.float64)[kind_of_robot]
                fields[name] = columns if columns.ndim == 2 else np.moveaxis(columns, 2, 1)

    write(blocks, [describe_build(place, kind, setup) for place, kind in enumerate(kinds)])
    write(blocks["rules"], [make_rules(kind.config)._asdict() for kind in kinds])


def describe_build(place: int, kind: Kind, setup: layout.Setup) -> dict[str, Any]:
    """The fields of `layout.Build` of a kind of robots."""
    config = kind.config
    per_radian = config.encoder.counts_per_revolution / (2.0 * math.pi)

    return {
        "kind": place,
        "ramp": [config.motor.of_wheel(wheel).acceleration * setup.dt for wheel in range(4)],
        "counts_per_radian": per_radian,
        "speed_per_count": 1.0 / (per_radian * setup.window * setup.dt),
        "quantum": config.encoder.quantum or 0.0,
        "max_linear": config.max_linear,
        "max_angular": config.max_angular,
        "stale": stale_after(config),
        "rays": config.lidar.rays if setup.sees else 0,
        "first_world": kind.worlds.start,
        "worlds": len(kind.worlds),
    }


def make_spawns(task: Task, worlds: Sequence[World], kinds: Sequence[Kind]) -> layout.Spawns:
    """Make the arrays of starts, goals and paths."""
    nearest, farthest = task.goal_distance
    order = np.arange(len(worlds), dtype=np.int64)

    # A range of difficulties is a range of ranks in this order.
    for kind in kinds:
        if kind.pool is not None and kind.pool.generated:
            places = slice(kind.worlds.start, kind.worlds.stop)
            order[places] = kind.worlds.start + kind.pool.by_difficulty[0]

    # A start without a heading has NaN.
    starts = [world.start for world in worlds]
    headings = [math.nan if start.theta is None else start.theta for start in starts]
    goals = [(world.goal.x, world.goal.y, world.goal.radius) for world in worlds]
    paths = [path_from_start(world) for world in worlds] if task.follows else []
    return layout.Spawns(
        min_distance=float(nearest),
        max_distance=float(farthest),
        starts=np.array(
            [(s.x, s.y, s.radius, theta) for s, theta in zip(starts, headings, strict=True)],
            layout.START,
        ),
        goals=np.array(goals, layout.GOAL),
        lengths=np.array([world.length for world in worlds], np.float64),
        paths=pad_rows(paths, (0.0, 0.0, 0.0)),
        samples=np.array([len(samples) for samples in paths], np.int64),
        order=order,
    )
