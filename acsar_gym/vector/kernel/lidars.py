"""Collisions of exact footprints and LiDAR scans of many robots in their worlds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, subroutine
from acsar_gym.physics.trigonometry import sincos
from acsar_gym.sensors import lidar
from acsar_gym.vector.kernel.layout import (
    CONTACT,
    SCAN_TICK,
    SCANS,
    SILENT,
    START_COS,
    START_SIN,
    STEPS,
    THETA,
    WORLD,
    Floats,
    Setup,
    Tables,
    X,
    Y,
    to_world,
)
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.geometry import Surroundings, cast_rays, footprint_collides

add_noise = lidar.add_noise


@jit
def true_pose(state: Floats, i: int) -> tuple[float, float, float, float]:
    """Robot i's pose in the frame of its world: x [m], y [m], cosine and sine of its heading."""
    x, y = to_world(state, i, state[X, i], state[Y, i])
    s, c = sincos(state[THETA, i])
    cos, sin = state[START_COS, i], state[START_SIN, i]
    return x, y, cos * c - sin * s, sin * c + cos * s


@subroutine
def check_contacts(state: Floats, first: int, last: int, around: Surroundings) -> None:
    """Set CONTACT of robots that touch an obstacle now."""
    for i in range(first, last):
        if state[CONTACT, i] == 0.0:
            x, y, cos, sin = true_pose(state, i)
            if footprint_collides(x, y, cos, sin, int(state[WORLD, i]), around):
                state[CONTACT, i] = 1.0


@subroutine
def take_scan(
    tables: Tables, i: int, tick: int, uniforms: Floats, setup: Setup, around: Surroundings
) -> None:
    """Take robot i's scan at the end of a tick of its step; -1 is the reset.

    `uniforms` is a buffer for the samples that the noise consumes.
    """
    state = tables.state
    ticks = state[STEPS, i] * setup.ticks + tick + 1
    elapsed = ticks * setup.period
    state[SCANS, i] = 1.0 + np.floor(elapsed * setup.lidar_rate + 1e-9)
    state[SCAN_TICK, i] = ticks
    x, y, cos, sin = true_pose(state, i)
    ranges = tables.ranges[i]
    cast_rays(x, y, cos, sin, int(state[WORLD, i]), around, ranges)
    for k in range(setup.draws):
        uniforms[k] = uniform(tables.random, i)
    add_noise(ranges, uniforms, setup.noise, setup.dropouts, setup.min_range, around.reach)
    for k in range(len(ranges)):
        tables.observations[i, setup.numbers + k] = ranges[k] / around.reach


@jit
def is_scan_due(state: Floats, i: int, tick: int, setup: Setup) -> bool:
    """Whether a scan of robot i is due in this tick; inlined, as it is asked in every tick."""
    ticks = state[STEPS, i] * setup.ticks + tick + 1
    due: bool = ticks * setup.period > state[SCANS, i] / setup.lidar_rate - 1e-9
    return due


@subroutine
def take_scans(
    tables: Tables,
    mask: NDArray[np.bool_],
    wanted: bool,
    first: int,
    last: int,
    tick: int,
    setup: Setup,
    around: Surroundings,
) -> None:
    """Take the scans that are due, of robots whose entry in the mask equals `wanted`.

    Robots whose board is silent at the reset (tick -1) take none, as in the single env, whose
    reset then fails.
    """
    uniforms = np.empty(setup.draws)
    for i in range(first, last):
        hears = tick >= 0 or tables.state[SILENT, i] == 0.0
        if mask[i] == wanted and hears and is_scan_due(tables.state, i, tick, setup):
            take_scan(tables, i, tick, uniforms, setup, around)
