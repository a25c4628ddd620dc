"""The twin's answer of one wheel to commands: ramp, gain, deadband, saturation, lag, encoder.

The same recursion as `Firmware` over a `Body`, at the same loop rate. Where the twin's loops lie
between the host's stamps isn't known, so commands and encoder readings are interpolated between
loops: that is the mean over all phases of the twin's clock, and it is smooth in delay and window.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, loop

Floats = NDArray[np.float64]

Heard = tuple[Floats, Floats, Floats]
"""For each loop: the command one loop earlier and that of the loop [rad/s], and the probability
that the loop already has the latter."""
CREEP = 1e-3
"""A wheel slower than this stands, once its set point is zero [rad/s]; as in `dynamics.model`."""


class Wheel(NamedTuple):
    """The motor of one wheel, as a fit varies it."""

    lag: float
    """Time constant of the speed loop [s]."""
    gain: float
    """Factor from set point to speed."""
    slowness: float
    """Time that the set point's ramp needs for 1 rad/s [s^2/rad]; 0 without a ramp."""
    deadband: float
    """Set points below this don't turn the wheel [rad/s]."""


class Clock(NamedTuple):
    """The times of a board, the same for all wheels."""

    delay: float
    """From a command's arrival to its effect, on top of the wire and the wait for a loop [s]."""
    window: float
    """Averaging time of the encoders [s]."""
    timeout: float
    """Time after the newest command at which the targets become zero [s]; inf: never."""


@jit
def passed(aim: float, spread: float, deadband: float) -> float:
    """Mean of what a deadband passes, over aims from aim - spread to aim + spread [rad/s]."""
    if abs(aim) - spread >= deadband:
        return aim
    if abs(aim) + spread < deadband or spread <= 0.0:
        return 0.0
    low, high = max(abs(aim - spread), deadband), max(abs(aim + spread), deadband)
    return (high * high - low * low) / (4.0 * spread)


@loop
def speeds_of(
    heard: Heard,
    step: float,
    blend: float,
    gain: float,
    deadband: float,
    top: float,
    spread: float,
) -> Floats:
    """Compute a wheel's speed after each loop of the firmware.

    Args:
        heard: the commands of each loop.
        step: largest change of the set point in a loop [rad/s].
        blend: share of the difference by which the speed changes in a loop.
        gain: factor from set point to speed.
        deadband: set points below this count as zero [rad/s].
        top: largest speed [rad/s].
        spread: 0 for the twin's own loops; 0.5 for the mean over the phases of its clock where a
            set point crosses the deadband, which is smooth.

    Returns:
        Speeds [rad/s], one per loop.
    """
    before, after, share = heard
    speeds = np.empty(len(after))
    set_point = speed = 0.0
    for k in range(len(after)):
        low, high, old = set_point - step, set_point + step, set_point
        set_point = min(max(after[k], low), high)
        if share[k] < 1.0:
            set_point += (1.0 - share[k]) * (min(max(before[k], low), high) - set_point)
        aim = passed(set_point * gain, spread * gain * abs(set_point - old), deadband)
        aim = min(max(aim, -top), top)
        speed += blend * (aim - speed)
        if aim == 0.0 and abs(speed) < CREEP:
            speed = 0.0
        speeds[k] = speed
    return speeds


def step_of(slowness: float, dt: float) -> float:
    """Largest change of a set point in a loop [rad/s]; inf without a ramp."""
    return dt / slowness if slowness > 0.0 else np.inf


def blend_of(lag: float, dt: float) -> float:
    """Share of the difference by which a speed changes in a loop of `dt` [s]."""
    return float(1.0 - np.exp(-dt / lag)) if lag > 0.0 else 1.0


def targets_at(edges: Floats, stamps: Floats, commands: Floats) -> Heard:
    """Commands of each loop, where loops lie anywhere within half a period around the edges.

    Args:
        edges: begin of each loop [s], equally spaced.
        stamps: when each command counts [s], ascending.
        commands: (n,) or (n, wheels) [rad/s]; zero before the first.

    Returns:
        What `speeds_of` takes, with the wheels' columns as rows.
    """
    dt = edges[1] - edges[0]
    latest = edges + dt / 2.0
    newest = np.searchsorted(stamps, latest, side="right") - 1
    after = np.ascontiguousarray(commands[newest].T)
    after[..., newest < 0] = 0.0
    before = np.zeros_like(after)
    before[..., 1:] = after[..., :-1]
    since = latest - stamps[np.maximum(newest, 0)]
    return before, after, np.clip(since / dt, 0.0, 1.0)


def windowed(edges: Floats, speeds: Floats, stamps: Floats, window: float) -> Floats:
    """Mean speed that encoders report at each stamp, over the window before it [rad/s].

    Args:
        edges: begin of each loop [s].
        speeds: after each loop [rad/s].
        stamps: when lines are made [s].
        window: averaging time [s].
    """
    dt = edges[1] - edges[0]
    times = np.concatenate((edges, [edges[-1] + dt]))
    angles = np.concatenate(([0.0], np.cumsum(speeds) * dt))
    turned = np.interp(stamps, times, angles) - np.interp(stamps - window, times, angles)
    return turned / window
