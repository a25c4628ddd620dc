"""Collisions of exact footprints and LiDAR scans of many robots in their worlds."""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import jit, subroutine
from acsar_gym.lidar.scan import begin_trail, fill_scan
from acsar_gym.lidar.simulated import LidarTraits, make_beams, measure_revolution
from acsar_gym.sensors.map.sensor import MAP_NAMES, clear_map, update_map
from acsar_gym.trigonometry import sincos
from acsar_gym.vector.kernel.layout import BLOCK_ROBOTS, Robots, Setup, Tables, to_world
from acsar_gym.worlds.geometry import Surroundings, footprint_collides


@jit
def true_pose(robots: Robots, i: int) -> tuple[float, float, float, float]:
    """Robot i's pose in the frame of its world: x [m], y [m], cosine and sine of its heading."""
    x, y = to_world(robots, i, robots.x[i], robots.y[i])
    s, c = sincos(robots.theta[i])
    cos, sin = robots.start_cos[i], robots.start_sin[i]
    return x, y, cos * c - sin * s, sin * c + cos * s


@subroutine
def check_contacts(robots: Robots, count: int, around: Surroundings) -> None:
    """Set `contact` of robots that touch an obstacle now."""
    for i in range(count):
        if robots.contact[i] == 0.0:
            x, y, cos, sin = true_pose(robots, i)
            kind = int(robots.kind[i])
            if footprint_collides(x, y, cos, sin, int(robots.world[i]), around, kind):
                robots.contact[i] = 1.0


@jit
def mark_trails(tables: Tables, block: int, i: int, tick: float, setup: Setup) -> None:
    """Mark where a robot is, so many ticks after its reset, by odometry and in truth."""
    robots, trails, robot = tables.blocks[block], tables.trails, block * BLOCK_ROBOTS + i
    x, y = to_world(robots, i, robots.x[i], robots.y[i])
    true = x, y, robots.start_theta[i] + robots.theta[i]
    told = robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i]
    now = robots.loops[i] * setup.dt
    if tick == 0.0:
        begin_trail(trails[0, robot], now, told, setup.period)
        begin_trail(trails[1, robot], now, true, setup.period)
    row = int(tick) % trails.shape[2]
    for k in range(3):
        trails[0, robot, row, 1 + k], trails[1, robot, row, 1 + k] = told[k], true[k]
    trails[0, robot, row, 0] = trails[1, robot, row, 0] = now


@subroutine
def read_scans(
    tables: Tables, block: int, count: int, setup: Setup, around: Surroundings, begins: bool
) -> None:
    """Read LiDARs and maps of a block's robots that drive, or of those in `over` that begin one.

    Robots whose board is silent at the reset have none, as in the single env, whose reset fails.
    """
    robots = tables.blocks[block]
    beams, mapped = make_beams(tables.ranges.shape[1]), np.zeros(len(MAP_NAMES))
    for i in range(count):
        robot = block * BLOCK_ROBOTS + i
        silent = robots.silent[i] > 0.0
        if (silent or not tables.over[robot]) if begins else tables.idle[robot]:
            continue
        tick = 0.0 if begins else (robots.steps[i] + 1.0) * setup.ticks
        newest, own = int(tick) % tables.trails.shape[2], robots.physics
        kind, seen = int(robots.kind[i]), int(robots.rays[i])
        rays = tables.rays[kind]
        if len(beams.times) != seen:
            beams = make_beams(seen)
        traits = LidarTraits(
            own.scan_rate[i],
            own.range_noise[i],
            own.range_bias[i],
            own.range_dropouts[i],
            own.range_outliers[i],
        )
        robots.scan_stamp[i] = measure_revolution(
            tables.trails[1, robot],
            newest,
            int(robots.world[i]),
            around,
            rays,
            (robots.scan_start[i], robots.scan_phase[i], robots.scan_key[i]),
            traits,
            beams,
            kind,
        )
        ranges, told = tables.ranges[robot, :seen], tables.trails[0, robot]
        measured = beams.bearings, beams.distances, beams.times
        fill_scan(*measured, told, newest, rays, ranges)
        for k in range(seen):
            tables.observations[robot, setup.first_ray + k] = ranges[k] / rays.farthest
        if setup.maps:
            if begins:
                clear_map(tables.maps[robot])
            update_map(
                tables.maps[robot],
                (robots.odom_x[i], robots.odom_y[i], robots.odom_theta[i]),
                (robots.goal_x[i], robots.goal_y[i]),
                ranges,
                rays,
                tables.scratch[block],
                mapped,
            )
            for k in range(len(mapped)):
                tables.observations[robot, setup.numbers + k] = mapped[k]
