"""What the driver of each robot knows: feedback lines and dead reckoning, tick by tick."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acsar_gym import kinematics, odometry
from acsar_gym.jit import jit, loop
from acsar_gym.vector.kernel.dynamics import motors, on_the_wire, ramp, sincos, tyres
from acsar_gym.vector.kernel.layout import (
    AGE,
    ANGULAR,
    COMMAND_LOOPS,
    DELAY_LOOPS,
    DROPPED,
    FEEDBACK_LOOPS,
    HEARD,
    LAST_LINE,
    LINEAR,
    LOOPS,
    ODOM_THETA,
    ODOM_X,
    ODOM_Y,
    READ,
    TURN,
    Floats,
    Setup,
    Tables,
    row,
)
from acsar_gym.vector.kernel.lidars import look, touch
from acsar_gym.vector.kernel.safety import explain, follow, guard, lose
from acsar_gym.vector.pcg import uniform
from acsar_gym.worlds.geometry import Surroundings

forward = jit(kinematics.twist)
integrate = jit(odometry.integrate)


@jit
def newest_line(loops: float, delay: float, every: float) -> float:
    """Number of the newest line that has arrived by loop `loops`; line n is made n * `every` on."""
    line: float = np.floor((loops - delay) / every + 1e-9)
    return line


@loop
def feedback(state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """The newest line that has arrived by the end of a tick, if it hasn't been read before."""
    slots = counts.shape[0]
    loops, ages = row(state, LOOPS, first, last), row(state, AGE, first, last)
    lines, every = row(state, LAST_LINE, first, last), row(state, FEEDBACK_LOOPS, first, last)
    delays = row(state, DELAY_LOOPS, first, last)
    for i in range(last - first):
        now = loops[i] + setup.loops
        loops[i] = now
        line = newest_line(now, delays[i], every[i])
        if line > lines[i]:
            lines[i] = line
            ages[i] = 0.0
            new = slot - int(now - np.ceil(line * every[i] - 1e-9))
            new += slots if new < 0 else 0
            old = new - setup.window
            old += slots if old < 0 else 0
            for k in range(4):
                turned = counts[new, k, first + i] - counts[old, k, first + i]
                state[READ + k, first + i] = on_the_wire(turned * setup.speed_per_count)
        else:
            ages[i] += setup.period


@loop
def dead_reckoning(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Equations (1)-(10) on the newest readings."""
    a, b = row(state, READ, first, last), row(state, READ + 1, first, last)
    c, d = row(state, READ + 2, first, last), row(state, READ + 3, first, last)
    xs, ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    thetas = row(state, ODOM_THETA, first, last)
    linears, angulars = row(state, LINEAR, first, last), row(state, ANGULAR, first, last)
    radius, separation, dt = setup.radius, setup.separation, setup.period
    for i in range(last - first):
        linear, angular = forward(a[i], b[i], c[i], d[i], radius, separation)
        sin, cos = sincos(thetas[i])
        x, y, theta = integrate(xs[i], ys[i], thetas[i], cos, sin, linear, angular, dt)
        xs[i] = x
        ys[i] = y
        thetas[i] = theta - TURN * np.floor(theta / TURN + 0.5)
        linears[i] = linear
        angulars[i] = angular


@loop
def drop_lines(
    state: Floats, random: NDArray[np.uint64], first: int, last: int, tick: int, setup: Setup
) -> None:
    """Lose this tick's command line, its feedback line, or both, on robots with a bad cable."""
    for i in range(first, last):
        share = state[DROPPED, i]
        if share > 0.0:
            heard = tick * setup.loops + state[COMMAND_LOOPS, i]
            if state[HEARD, i] == heard and uniform(random, i) < share:
                state[HEARD, i] = heard + setup.loops
            every = state[FEEDBACK_LOOPS, i]
            loops = state[LOOPS, i] + setup.loops
            line = newest_line(loops, state[DELAY_LOOPS, i], every)
            if line > state[LAST_LINE, i] and uniform(random, i) < share:
                state[LAST_LINE, i] = line


@loop
def drive(
    tables: Tables, first: int, last: int, lossy: bool, setup: Setup, around: Surroundings
) -> None:
    """The ticks of an env step that the ring says."""
    state, counts, commands, random = tables.state, tables.counts, tables.commands, tables.random
    slots, line, begin, end = counts.shape[0], tables.ring[1], tables.ring[2], tables.ring[3]
    slot = (tables.ring[0] + begin * setup.loops) % slots
    line = (line + begin) % max(commands.shape[0], 1)
    crowded = around.circles.shape[1] + around.segments.shape[1] > 0
    for tick in range(begin, end):
        if setup.guarded:
            line = (line + 1) % commands.shape[0]
            guard(state, commands, first, last, line, setup)
            if lossy:
                lose(state, commands, random, first, last, line)
        if lossy:
            drop_lines(state, random, first, last, tick, setup)
        for turn in range(tick * setup.loops, (tick + 1) * setup.loops):
            slot = (slot + 1) % slots
            if setup.guarded:
                follow(state, commands, first, last, line, turn - tick * setup.loops, setup)
            else:
                ramp(state, first, last, turn, setup)
            motors(state, counts, first, last, slot, setup)
            tyres(state, first, last, setup)
        if crowded:
            touch(state, first, last, around)
        feedback(state, counts, first, last, slot, setup)
        dead_reckoning(state, first, last, setup)
        if setup.lidar_rate > 0.0:
            look(tables, tables.over, False, first, last, tick, setup, around)
    if setup.guarded:
        explain(state, first, last, setup)
