"""The drivers of many robots, tick by tick: feedback lines and dead reckoning."""

from __future__ import annotations

import numpy as np

from acsar_gym import kinematics, odometry
from acsar_gym.dynamics.board import printed
from acsar_gym.dynamics.trigonometry import sincos
from acsar_gym.jit import jit, subroutine
from acsar_gym.vector.kernel.dynamics import motors, on_the_wire, ramp, tyres
from acsar_gym.vector.kernel.fault_injection import dispatch, listen, obey, watch
from acsar_gym.vector.kernel.layout import (
    AGE,
    ANGULAR,
    DELAY_LOOPS,
    FEEDBACK_LOOPS,
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
from acsar_gym.vector.kernel.safety import explain, follow, guard, lines
from acsar_gym.worlds.geometry import Surroundings

forward = jit(kinematics.twist)
integrate = jit(odometry.integrate)


@jit
def newest_line(loops: float, delay: float, every: float) -> float:
    """Number of the newest feedback line that has arrived by a firmware loop.

    Args:
        loops: firmware loops since the reset.
        delay: from making a line to its use [firmware loops].
        every: line n is made n * `every` firmware loops after the reset.
    """
    line: float = np.floor((loops - delay) / every + 1e-9)
    return line


@jit
def read(state: Floats, counts: Floats, i: int, slot: int, ago: int, setup: Setup) -> None:
    """Set robot i's wheel speeds from what its encoders had counted `ago` firmware loops ago."""
    slots = counts.shape[0]
    new = slot - ago
    new += slots if new < 0 else 0
    old = new - setup.window
    old += slots if old < 0 else 0
    for k in range(4):
        speed = (counts[new, k, i] - counts[old, k, i]) * setup.speed_per_count
        if setup.quantum > 0.0:
            speed = printed(speed, setup.quantum)
        state[READ + k, i] = on_the_wire(speed)


@jit
def feedback(state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """Read the newest feedback line that has arrived by the end of a tick, if it is new."""
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
            made = np.ceil(line * every[i] - 1e-9)
            read(state, counts, first + i, slot, int(now - made), setup)
        else:
            ages[i] += setup.period


@jit
def dead_reckoning(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Update odometry with equations (1)-(10) on the newest wheel speeds."""
    a, b = row(state, READ, first, last), row(state, READ + 1, first, last)
    c, d = row(state, READ + 2, first, last), row(state, READ + 3, first, last)
    xs, ys = row(state, ODOM_X, first, last), row(state, ODOM_Y, first, last)
    thetas = row(state, ODOM_THETA, first, last)
    linears, angulars = row(state, LINEAR, first, last), row(state, ANGULAR, first, last)
    left, right, dt = setup.left_radius, setup.right_radius, setup.period
    for i in range(last - first):
        linear, angular = forward(a[i], b[i], c[i], d[i], left, right, setup.separation)
        sin, cos = sincos(thetas[i])
        x, y, theta = integrate(xs[i], ys[i], thetas[i], cos, sin, linear, angular, dt)
        xs[i] = x
        ys[i] = y
        thetas[i] = theta - TURN * np.floor(theta / TURN + 0.5)
        linears[i] = linear
        angulars[i] = angular


@jit
def receive(state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """Read feedback lines as `feedback` does, where lines can be lost or late."""
    for i in range(first, last):
        state[LOOPS, i] += setup.loops
        line = listen(state, i, setup)
        state[AGE, i] = 0.0 if line > 0.0 else state[AGE, i] + setup.period
        if line > 0.0:
            made = np.ceil(line * state[FEEDBACK_LOOPS, i] - 1e-9)
            read(state, counts, i, slot, int(state[LOOPS, i] - made), setup)


@jit
def command_tick(tables: Tables, first: int, last: int, line: int, setup: Setup) -> None:
    """Make the command lines of one tick, and pass them on to the boards."""
    guard(tables.state, first, last, setup)
    lines(tables.state, tables.commands, first, last, line, setup)
    if setup.faults.possible:
        dispatch(tables, first, last, line, setup)


@jit
def turn_wheels(
    tables: Tables, first: int, last: int, tick: int, slot: int, line: int, setup: Setup
) -> None:
    """Run the firmware loops of one tick; encoder counts go to slots from `slot` on."""
    state, counts = tables.state, tables.counts
    for turn in range(setup.loops):
        if setup.faults.possible:
            obey(tables, first, last, line, turn, setup)
        elif setup.guarded:
            follow(state, tables.commands, first, last, line, turn, setup)
        else:
            ramp(state, first, last, tick * setup.loops + turn, setup)
        motors(state, counts, first, last, (slot + turn) % counts.shape[0], setup)
        tyres(state, first, last, setup)


@subroutine
def drive(tables: Tables, first: int, last: int, setup: Setup, around: Surroundings) -> None:
    """Run the ticks of an env step that `tables.ring` says, with all that happens in them."""
    state, counts, slots = tables.state, tables.counts, tables.counts.shape[0]
    begin, lines_kept = tables.ring[2], max(tables.commands.shape[0], 1)
    slot = (tables.ring[0] + begin * setup.loops) % slots
    line = (tables.ring[1] + begin) % lines_kept
    crowded = around.circles.shape[1] + around.segments.shape[1] > 0
    for tick in range(begin, tables.ring[3]):
        line = (line + 1) % lines_kept
        if setup.guarded:
            command_tick(tables, first, last, line, setup)
        turn_wheels(tables, first, last, tick, slot + 1, line, setup)
        slot = (slot + setup.loops) % slots
        if crowded:
            touch(state, first, last, around)
        if setup.faults.possible:
            receive(state, counts, first, last, slot, setup)
            watch(tables, first, last, setup)
        else:
            feedback(state, counts, first, last, slot, setup)
        dead_reckoning(state, first, last, setup)
        if setup.lidar_rate > 0.0:
            look(tables, tables.idle, False, first, last, tick, setup, around)
    if setup.guarded:
        explain(state, first, last, setup)
