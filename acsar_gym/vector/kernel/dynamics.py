"""Commands, motors and tyres of many planar robots, one firmware loop at a time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from acsar_gym.dynamics.board import towards
from acsar_gym.dynamics.model import tyre_step, wheel_speed
from acsar_gym.dynamics.trigonometry import sincos
from acsar_gym.jit import jit
from acsar_gym.protocol import MAX_SPEED
from acsar_gym.safety.rules import told, wheels
from acsar_gym.vector.kernel.layout import (
    ANGLE,
    BLEND,
    COMMAND_LOOPS,
    DEADBAND,
    GAIN,
    GRIP,
    HALF_TRACK,
    HALF_WHEELBASE,
    HEARD,
    KAPPA,
    LAST_ANGULAR,
    LAST_LINEAR,
    LEFT_RADIUS,
    MASS,
    NEW_LEFT,
    NEW_RIGHT,
    OLD_LEFT,
    OLD_RIGHT,
    POINT,
    RATE,
    REASON,
    RIGHT_RADIUS,
    SENT_ANGULAR,
    SENT_LINEAR,
    SLIP_SPEED,
    THETA,
    VX,
    VY,
    WHEEL,
    YAW_INERTIA,
    Floats,
    Setup,
    X,
    Y,
    row,
)


class Chassis(NamedTuple):
    """The numbers of a `Physics` that `tyre_step` needs."""

    left_radius: float
    right_radius: float
    half_wheelbase: float
    half_track: float
    mass: float
    yaw_inertia: float
    grip: float
    slip_speed: float


@jit
def on_the_wire(speed: float) -> float:
    """A wheel speed [rad/s] after encoding and decoding: two decimals, saturated."""
    rounded: float = np.rint(speed * 100.0) / 100.0
    return min(max(rounded, -MAX_SPEED), MAX_SPEED)


@jit
def ask(state: Floats, actions: Floats, first: int, last: int) -> None:
    """Store the actions of this step, clipped to [-1, 1]."""
    for i in range(first, last):
        state[LAST_LINEAR, i] = min(max(actions[i, 0], -1.0), 1.0)
        state[LAST_ANGULAR, i] = min(max(actions[i, 1], -1.0), 1.0)


@jit
def command(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Compute the wheel targets of this step's command line. Only without limits or faults."""
    old_right, old_left = row(state, OLD_RIGHT, first, last), row(state, OLD_LEFT, first, last)
    new_right, new_left = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    heard, delay = row(state, HEARD, first, last), row(state, COMMAND_LOOPS, first, last)
    asks, turns = row(state, LAST_LINEAR, first, last), row(state, LAST_ANGULAR, first, last)
    sent, bent = row(state, SENT_LINEAR, first, last), row(state, SENT_ANGULAR, first, last)
    reasons = row(state, REASON, first, last)
    for i in range(last - first):
        linear, angular = asks[i] * setup.max_linear, turns[i] * setup.max_angular
        right, left = wheels(linear, angular, setup.rules)
        sent[i], bent[i], reasons[i] = told(linear, angular, right, left, 0.0, setup.rules)
        old_right[i] = new_right[i]
        old_left[i] = new_left[i]
        new_right[i] = min(max(on_the_wire(right), -setup.top), setup.top)
        new_left[i] = min(max(on_the_wire(left), -setup.top), setup.top)
        heard[i] = delay[i]


@jit
def ramp(state: Floats, first: int, last: int, now: float, setup: Setup) -> None:
    """Move set points towards the newest targets that the board knows by loop `now`."""
    a, b = row(state, POINT, first, last), row(state, POINT + 1, first, last)
    c, d = row(state, POINT + 2, first, last), row(state, POINT + 3, first, last)
    old_right, old_left = row(state, OLD_RIGHT, first, last), row(state, OLD_LEFT, first, last)
    new_right, new_left = row(state, NEW_RIGHT, first, last), row(state, NEW_LEFT, first, last)
    heard, steps = row(state, HEARD, first, last), setup.ramps
    for i in range(last - first):
        new = now >= heard[i]
        right = new_right[i] if new else old_right[i]
        left = new_left[i] if new else old_left[i]
        a[i] = towards(a[i], right, steps[0])
        b[i] = towards(b[i], left, steps[1])
        c[i] = towards(c[i], left, steps[2])
        d[i] = towards(d[i], right, steps[3])


@jit
def motors(state: Floats, counts: Floats, first: int, last: int, slot: int, setup: Setup) -> None:
    """Advance wheel speeds and angles by one loop, and store the encoder counts."""
    for k in range(4):
        speeds, angles = row(state, WHEEL + k, first, last), row(state, ANGLE + k, first, last)
        points, gains = row(state, POINT + k, first, last), row(state, GAIN + k, first, last)
        blends, deadbands = (
            row(state, BLEND + k, first, last),
            row(state, DEADBAND + k, first, last),
        )
        seen = counts[slot, k, first:last]
        for i in range(last - first):
            speed = wheel_speed(speeds[i], points[i], gains[i], blends[i], deadbands[i], setup.top)
            angle = angles[i] + speed * setup.dt
            speeds[i] = speed
            angles[i] = angle
            seen[i] = np.floor(angle * setup.counts_per_radian)


@jit
def tyres(state: Floats, first: int, last: int, setup: Setup) -> None:
    """Advance velocity and pose by one loop: tyre forces, then semi-implicit Euler."""
    if setup.isotropic:  # compiled twice, because the constant saves a tenth of the time
        slide(state, first, last, True, setup.dt)
    else:
        slide(state, first, last, False, setup.dt)


@jit
def slide(state: Floats, first: int, last: int, isotropic: bool, dt: float) -> None:
    """Advance velocity and pose by one loop, with tyres that are isotropic or not."""
    xs, ys, thetas = (
        row(state, X, first, last),
        row(state, Y, first, last),
        row(state, THETA, first, last),
    )
    vxs, vys, rates = (
        row(state, VX, first, last),
        row(state, VY, first, last),
        row(state, RATE, first, last),
    )
    a, b = row(state, WHEEL, first, last), row(state, WHEEL + 1, first, last)
    c, d = row(state, WHEEL + 2, first, last), row(state, WHEEL + 3, first, last)
    left_radii, right_radii = (
        row(state, LEFT_RADIUS, first, last),
        row(state, RIGHT_RADIUS, first, last),
    )
    lengths, widths = row(state, HALF_WHEELBASE, first, last), row(state, HALF_TRACK, first, last)
    masses, inertias = row(state, MASS, first, last), row(state, YAW_INERTIA, first, last)
    grips, slips = row(state, GRIP, first, last), row(state, SLIP_SPEED, first, last)
    kappas = row(state, KAPPA, first, last)
    for i in range(last - first):
        sin, cos = sincos(thetas[i])
        vx, vy = vxs[i], vys[i]
        own = Chassis(
            left_radii[i],
            right_radii[i],
            lengths[i],
            widths[i],
            masses[i],
            inertias[i],
            grips[i],
            slips[i],
        )
        kappa, speeds = 1.0 if isotropic else kappas[i], (a[i], b[i], c[i], d[i])
        ahead, left, rate = tyre_step(
            cos * vx + sin * vy, cos * vy - sin * vx, rates[i], speeds, own, kappa, dt
        )
        vx, vy = cos * ahead - sin * left, sin * ahead + cos * left
        vxs[i] = vx
        vys[i] = vy
        rates[i] = rate
        xs[i] += vx * dt
        ys[i] += vy * dt
        thetas[i] += rate * dt
