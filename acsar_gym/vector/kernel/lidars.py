"""Collisions of exact footprints and LiDAR scans of many robots in their worlds."""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import jit, subroutine
from acsar_gym.physics.trigonometry import sincos
from acsar_gym.sensors.lidar import add_noise
from acsar_gym.vector.kernel import layout as rows
from acsar_gym.vector.kernel.layout import Floats, Setup, Tables, to_world
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.geometry import Surroundings, cast_rays, footprint_collides


@jit
def true_pose(state: Floats, i: int) -> tuple[float, float, float, float]:
    """Robot i's pose in the frame of its world: x [m], y [m], cosine and sine of its heading."""
    x, y = to_world(state, i, state[rows.X, i], state[rows.Y, i])
    s, c = sincos(state[rows.THETA, i])
    cos, sin = state[rows.START_COS, i], state[rows.START_SIN, i]
    return x, y, cos * c - sin * s, sin * c + cos * s


@subroutine
def check_contacts(state: Floats, first: int, last: int, around: Surroundings) -> None:
    """Set CONTACT of robots that touch an obstacle now."""
    for i in range(first, last):
        if state[rows.CONTACT, i] == 0.0:
            x, y, cos, sin = true_pose(state, i)
            if footprint_collides(x, y, cos, sin, int(state[rows.WORLD, i]), around):
                state[rows.CONTACT, i] = 1.0


@subroutine
def take_scans(
    tables: Tables, first: int, last: int, tick: int, setup: Setup, around: Surroundings
) -> None:
    """Take the scans that are due at the end of a tick; -1 is the reset of robots in `over`.

    Robots whose board is silent at the reset take none, as in the single env, whose reset fails.
    """
    state, uniforms = tables.state, np.empty(setup.draws)
    for i in range(first, last):
        ticks = state[rows.STEPS, i] * setup.ticks + tick + 1
        elapsed = ticks * setup.period
        due = elapsed > state[rows.SCANS, i] / setup.lidar_rate - 1e-9
        begins = tables.over[i] and state[rows.SILENT, i] == 0.0
        if not (due and (begins if tick < 0 else not tables.idle[i])):
            continue
        state[rows.SCANS, i] = 1.0 + np.floor(elapsed * setup.lidar_rate + 1e-9)
        state[rows.SCAN_TICK, i] = ticks
        x, y, cos, sin = true_pose(state, i)
        ranges = tables.ranges[i]
        cast_rays(x, y, cos, sin, int(state[rows.WORLD, i]), around, ranges)
        for k in range(setup.draws):
            uniforms[k] = uniform(tables.random, i)
        add_noise(ranges, uniforms, setup.noise, setup.dropouts, setup.min_range, around.reach)
        for k in range(len(ranges)):
            tables.observations[i, setup.numbers + k] = ranges[k] / around.reach
