"""Collisions of exact footprints and LiDAR scans of many robots in their worlds."""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import jit, subroutine
from acsar_gym.physics.trigonometry import sincos
from acsar_gym.sensors.lidar import add_noise
from acsar_gym.vector.kernel.layout import BLOCK_ROBOTS, Robots, Setup, Tables, to_world
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.geometry import Surroundings, cast_rays, footprint_collides


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
            if footprint_collides(x, y, cos, sin, int(robots.world[i]), around):
                robots.contact[i] = 1.0


@subroutine
def take_scans(
    tables: Tables,
    block: int,
    count: int,
    tick: int,
    setup: Setup,
    around: Surroundings,
) -> None:
    """Take a block's scans that are due at the end of a tick; -1 is the reset of robots in `over`.

    Robots whose board is silent at the reset take none, as in the single env, whose reset fails.
    """
    robots, uniforms = tables.blocks[block], np.empty(setup.draws)
    for i in range(count):
        robot = block * BLOCK_ROBOTS + i
        ticks = robots.steps[i] * setup.ticks + tick + 1
        elapsed = ticks * setup.period
        due = elapsed > robots.scans[i] / setup.lidar_rate - 1e-9
        begins = tables.over[robot] and robots.silent[i] == 0.0
        if not (due and (begins if tick < 0 else not tables.idle[robot])):
            continue
        robots.scans[i] = 1.0 + np.floor(elapsed * setup.lidar_rate + 1e-9)
        robots.scan_tick[i] = ticks
        x, y, cos, sin = true_pose(robots, i)
        ranges = tables.ranges[robot]
        cast_rays(x, y, cos, sin, int(robots.world[i]), around, ranges)
        for k in range(setup.draws):
            uniforms[k] = uniform(tables.random, robot)
        add_noise(ranges, uniforms, setup.noise, setup.dropouts, setup.min_range, around.reach)
        for k in range(len(ranges)):
            tables.observations[robot, setup.numbers + k] = ranges[k] / around.reach
