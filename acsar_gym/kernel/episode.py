"""Episodes of many robots: resets with physics of their own, and env steps."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym import tasks
from acsar_gym.compiled import jit, loop
from acsar_gym.kernel.driver import drive, newest_line
from acsar_gym.kernel.layout import (
    BLEND,
    BLOCK,
    COMMAND_LOOPS,
    DEADBAND,
    DELAY_LOOPS,
    DISTANCE,
    DROPPED,
    FEEDBACK_LOOPS,
    GAIN,
    GOAL_X,
    GOAL_Y,
    GRIP,
    INERTIA,
    LAST_LINE,
    LOOPS,
    MASS,
    RADIUS,
    ROWS,
    Floats,
    Setup,
)
from acsar_gym.kernel.outcome import judge, look, observe, report
from acsar_gym.kernel.physics import command
from acsar_gym.pcg import uniform
from acsar_gym.worlds.geometry import Surroundings

goal_at = jit(tasks.goal_at)


@jit
def settle_ticks(delay: float, every: float, loops: float) -> float:
    """Ticks that a reset takes until two fresh readings have come, as in `Robot.reset`."""
    one: float = np.ceil((np.ceil(every - 1e-9) + delay) / loops)
    two: float = np.ceil((np.ceil(2.0 * every - 1e-9) + delay) / loops)
    return max(one + 1.0, two)


@loop
def draw(  # noqa: C901 - nine keys, one condition each
    state: Floats,
    random: NDArray[np.uint64],
    i: int,
    nominal: Floats,
    ranges: Floats,
    setup: Setup,
) -> None:
    """Robot i's own physics: nominal values, varied within `ranges` (see `Randomization`)."""
    for row in range(MASS, ROWS):
        state[row, i] = nominal[row]
    if ranges[0, 0] <= ranges[0, 1]:
        factor = between(ranges, 0, random, i)
        state[MASS, i] *= factor
        state[INERTIA, i] *= factor
        state[GRIP, i] *= factor
    if ranges[1, 0] <= ranges[1, 1]:
        state[GRIP, i] *= between(ranges, 1, random, i)
    for k in range(4):
        if ranges[2, 0] <= ranges[2, 1]:
            state[GAIN + k, i] *= between(ranges, 2, random, i)
        if ranges[3, 0] <= ranges[3, 1] and nominal[BLEND + k] < 1.0:
            lag = -setup.dt / math.log(1.0 - nominal[BLEND + k])
            lag *= between(ranges, 3, random, i)
            state[BLEND + k, i] = 1.0 - math.exp(-setup.dt / lag)
    if ranges[4, 0] <= ranges[4, 1]:
        state[DEADBAND, i] = between(ranges, 4, random, i)
    if ranges[5, 0] <= ranges[5, 1]:
        state[RADIUS, i] *= between(ranges, 5, random, i)
    if ranges[6, 0] <= ranges[6, 1]:
        extra = np.rint(between(ranges, 6, random, i) / setup.dt)
        state[COMMAND_LOOPS, i] += extra
        state[DELAY_LOOPS, i] += extra
    if ranges[7, 0] <= ranges[7, 1]:
        rate = between(ranges, 7, random, i)
        state[FEEDBACK_LOOPS, i] = max(1.0, np.rint(1.0 / (rate * setup.dt)))
    if ranges[8, 0] <= ranges[8, 1]:
        state[DROPPED, i] = between(ranges, 8, random, i)


@jit
def between(ranges: Floats, key: int, random: NDArray[np.uint64], i: int) -> float:
    """A number from the range of one key."""
    low: float = ranges[key, 0]
    high: float = ranges[key, 1]
    return low + (high - low) * uniform(random, i)


@loop
def begin(
    state: Floats,
    counts: Floats,
    random: NDArray[np.uint64],
    i: int,
    nominal: Floats,
    ranges: Floats,
    setup: Setup,
) -> None:
    """A new episode of robot i: at rest at the origin, a goal of its own generator's making."""
    for row in range(MASS):
        state[row, i] = 0.0
    counts[:, :, i] = 0.0
    distance = setup.min_distance + (setup.max_distance - setup.min_distance) * uniform(random, i)
    bearing = -math.pi + (math.pi - -math.pi) * uniform(random, i)
    state[GOAL_X, i], state[GOAL_Y, i] = goal_at(distance, bearing)
    draw(state, random, i, nominal, ranges, setup)
    state[DISTANCE, i] = math.sqrt(state[GOAL_X, i] ** 2 + state[GOAL_Y, i] ** 2)
    settled = settle_ticks(state[DELAY_LOOPS, i], state[FEEDBACK_LOOPS, i], setup.loops)
    state[LOOPS, i] = settled * setup.loops
    every = state[FEEDBACK_LOOPS, i]
    state[LAST_LINE, i] = newest_line(state[LOOPS, i], state[DELAY_LOOPS, i], every)


@loop
def reset(
    state: Floats,
    counts: Floats,
    random: NDArray[np.uint64],
    nominal: Floats,
    ranges: Floats,
    observations: NDArray[np.float32],
    info: Floats,
    mask: NDArray[np.bool_],
    first: int,
    last: int,
    setup: Setup,
    around: Surroundings,
) -> None:
    """New episodes for the robots in the mask."""
    for i in range(first, last):
        if mask[i]:
            begin(state, counts, random, i, nominal, ranges, setup)
            observe(state, observations, i, i + 1, setup)
            look(state, observations, i, i + 1, around)
            report(state, info, i, i + 1)


@loop
def step(
    state: Floats,
    counts: Floats,
    random: NDArray[np.uint64],
    nominal: Floats,
    ranges: Floats,
    actions: Floats,
    over: NDArray[np.bool_],
    observations: NDArray[np.float32],
    info: Floats,
    rewards: Floats,
    ends: NDArray[np.bool_],
    first: int,
    last: int,
    slot: int,
    setup: Setup,
    around: Surroundings,
) -> None:
    """An env step of robots first to last; those that were over begin anew instead."""
    lossy = ranges[8, 0] <= ranges[8, 1]
    for low in range(first, last, BLOCK):
        high = min(low + BLOCK, last)
        command(state, actions, low, high, setup)
        drive(state, counts, random, low, high, slot, lossy, setup, around)
        judge(state, rewards, ends, low, high, setup)
        for i in range(low, high):
            if over[i]:
                begin(state, counts, random, i, nominal, ranges, setup)
                rewards[i] = 0.0
                ends[0, i] = ends[1, i] = False
        observe(state, observations, low, high, setup)
        look(state, observations, low, high, around)
        report(state, info, low, high)
