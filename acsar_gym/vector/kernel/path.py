"""Robots that follow a path: progress, reward and observation, in the frame of the world."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit
from acsar_gym.tasks.base import OBSERVATION_LIMIT, clipped, relative
from acsar_gym.tasks.path import (
    LENGTH_SCALE,
    LOOKAHEAD,
    STRIDE,
    heading_error,
    nearest,
    path_outcome,
    path_reward,
)
from acsar_gym.vector.kernel.dynamics import sincos
from acsar_gym.vector.kernel.layout import (
    ANGULAR,
    BEARING,
    CROSS,
    CROSS_SUM,
    GOAL_X,
    GOAL_Y,
    HEADING,
    HEADING_SUM,
    LAST_ANGULAR,
    LAST_LINEAR,
    LINEAR,
    MEAN_CROSS,
    MEAN_HEADING,
    ODOM_THETA,
    ODOM_X,
    ODOM_Y,
    PROGRESS,
    SHARE,
    START_COS,
    START_SIN,
    START_THETA,
    STEPS,
    WORLD,
    Floats,
    Job,
    Setup,
    to_world,
)


@jit
def progress(state: Floats, i: int, job: Job) -> None:
    """Where robot i takes itself to be on its path."""
    world = int(state[WORLD, i])
    x, y = to_world(state, i, state[ODOM_X, i], state[ODOM_Y, i])
    place, cross, bearing = nearest(job.paths[world], job.lasts[world], state[PROGRESS, i], x, y)
    state[PROGRESS, i] = place
    state[CROSS, i] = cross
    state[BEARING, i] = bearing
    state[HEADING, i] = heading_error(state[ODOM_THETA, i] + state[START_THETA, i], bearing)
    state[SHARE, i] = place / job.lasts[world]


@jit
def judge_path(state: Floats, i: int, job: Job) -> tuple[float, int]:
    """Reward and outcome of robot i on its path."""
    world, before = int(state[WORLD, i]), state[PROGRESS, i]
    progress(state, i, job)
    last = job.lasts[world]
    spacing = job.lengths[world] / last
    steps = state[STEPS, i] + 1.0
    state[CROSS_SUM, i] += abs(state[CROSS, i])
    state[HEADING_SUM, i] += abs(state[HEADING, i])
    state[MEAN_CROSS, i] = state[CROSS_SUM, i] / steps
    state[MEAN_HEADING, i] = state[HEADING_SUM, i] / steps
    dx, dy = state[GOAL_X, i] - state[ODOM_X, i], state[GOAL_Y, i] - state[ODOM_Y, i]
    remaining, far = (last - state[PROGRESS, i]) * spacing, math.sqrt(dx * dx + dy * dy)
    outcome = path_outcome(remaining, far, abs(state[CROSS, i]), job.max_cross_track)
    gain = (state[PROGRESS, i] - before) * spacing
    return path_reward(gain, state[CROSS, i], state[LAST_LINEAR, i], outcome), outcome


@jit
def observe_path(
    state: Floats, observations: NDArray[np.float32], i: int, setup: Setup, job: Job
) -> None:
    """Robot i's observation on its path."""
    world = int(state[WORLD, i])
    last, place, limit = job.lasts[world], state[PROGRESS, i], OBSERVATION_LIMIT
    x, y = to_world(state, i, state[ODOM_X, i], state[ODOM_Y, i])
    s, c = sincos(state[ODOM_THETA, i])
    cos = state[START_COS, i] * c - state[START_SIN, i] * s
    sin = state[START_SIN, i] * c + state[START_COS, i] * s
    hs, hc = sincos(state[HEADING, i])
    observations[i, 0] = clipped(state[CROSS, i] / job.max_cross_track, limit)
    observations[i, 1] = hc
    observations[i, 2] = hs
    remaining = (last - place) * (job.lengths[world] / last) / LENGTH_SCALE
    observations[i, 3] = min(remaining, limit)
    for number in range(LOOKAHEAD):
        k = min(int(place) + (number + 1) * STRIDE, last)
        px, py = job.paths[world, k, 0], job.paths[world, k, 1]
        ahead, left = relative(x, y, cos, sin, px, py)
        observations[i, 4 + 2 * number] = clipped(ahead, limit)
        observations[i, 5 + 2 * number] = clipped(left, limit)
    behind = 4 + 2 * LOOKAHEAD
    observations[i, behind] = clipped(state[LINEAR, i] / setup.max_linear, limit)
    observations[i, behind + 1] = clipped(state[ANGULAR, i] / setup.max_angular, limit)
    observations[i, behind + 2] = state[LAST_LINEAR, i]
    observations[i, behind + 3] = state[LAST_ANGULAR, i]
