"""Collisions of exact footprints and LiDAR scans of many robots in their worlds."""

from __future__ import annotations

import numpy as np

from acsar_gym.jit import jit, subroutine
from acsar_gym.trigonometry import sincos
from acsar_gym.sensors.scan import begin_trail, fill_scan
from acsar_gym.sensors.simulated import LidarTraits, measure_revolution
from acsar_gym.vector.kernel import layout as rows
from acsar_gym.vector.kernel.layout import Floats, Setup, Tables, to_world
from acsar_gym.worlds.geometry import Surroundings, footprint_collides


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


@jit
def mark_trails(tables: Tables, i: int, setup: Setup, tick: float) -> None:
    """Mark where robot i is, so many ticks after its reset, by odometry and in truth."""
    state = tables.state
    x, y = to_world(state, i, state[rows.X, i], state[rows.Y, i])
    true = x, y, state[rows.START_THETA, i] + state[rows.THETA, i]
    told = state[rows.ODOM_X, i], state[rows.ODOM_Y, i], state[rows.ODOM_THETA, i]
    now, slots = state[rows.LOOPS, i] * setup.dt, tables.trails.shape[2]
    for trail, pose in ((tables.trails[0, i], told), (tables.trails[1, i], true)):
        if tick == 0.0:
            begin_trail(trail, now, pose, setup.period)
        row = trail[int(tick) % slots]
        row[0], (row[1], row[2], row[3]) = now, pose


@subroutine
def read_scans(
    tables: Tables, first: int, last: int, setup: Setup, around: Surroundings, begins: bool
) -> None:
    """Read the LiDARs of robots that drive, or of those in `over` that begin an episode.

    Robots whose board is silent at the reset have none, as in the single env, whose reset fails.
    """
    state, rays = tables.state, tables.ranges.shape[1]
    bearings, distances, times = np.empty((3, rays))
    origins = np.empty((rays, 2))
    for i in range(first, last):
        if tables.idle[i] if not begins else not tables.over[i] or state[rows.SILENT, i] > 0.0:
            continue
        tick = 0.0 if begins else (state[rows.STEPS, i] + 1.0) * setup.ticks
        newest = int(tick) % tables.trails.shape[2]
        episode = state[rows.SCAN_START, i], state[rows.SCAN_PHASE, i], state[rows.SCAN_KEY, i]
        own = rows.SCAN_RATE
        traits = LidarTraits(
            state[own, i],
            state[own + 1, i],
            state[own + 2, i],
            state[own + 3, i],
            state[own + 4, i],
        )
        state[rows.SCAN_STAMP, i] = measure_revolution(
            tables.trails[1, i],
            newest,
            int(state[rows.WORLD, i]),
            around,
            setup.rays,
            episode,
            traits,
            bearings,
            distances,
            times,
            origins,
        )
        ranges = tables.ranges[i]
        fill_scan(bearings, distances, times, tables.trails[0, i], newest, setup.rays, ranges)
        for k in range(rays):
            tables.observations[i, setup.numbers + k] = ranges[k] / around.reach
