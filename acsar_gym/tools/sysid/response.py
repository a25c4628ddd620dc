"""The twin's answer of each wheel to commands, and its residuals over recorded tracks.

Ramp and motor are the functions of `physics.model` that the firmware's twin and its bodies use, at
the same loop rate. Where the twin's loops lie between the host's stamps isn't known, so commands
and encoder readings are interpolated between loops: that is the mean over all phases of the twin's
clock, and it is smooth in delay and window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from acsar_gym.jit import jit, loop
from acsar_gym.physics.model import move_towards, wheel_speed
from acsar_gym.tools.sysid.board_log import BoardTrack, Floats

LoopCommands = tuple[Floats, Floats, Floats]
"""For each loop: the command one loop earlier and that of the loop [rad/s], and the probability
that the loop already has the latter."""
PHASE_SPREAD = 0.5
"""Spread of set points in a loop, for `simulate_speeds`."""
KEPT_COMMANDS = 64
"""Delays and time-outs for which each track's commands are kept; any small number will do."""
ROUNDING_BLUR = 0.2
"""Finer steps of printed numbers average out: speeds differ by half of this if a drive is repeated
[rad/s]."""


class WheelModel(NamedTuple):
    """The motor of one wheel."""

    lag: float
    """Time constant of the speed loop [s]."""
    gain: float
    """Factor from set point to speed."""
    slowness: float
    """Time that the set point's ramp needs for 1 rad/s [s^2/rad]; 0 without a ramp."""
    deadband: float
    """Set points below this don't turn the wheel [rad/s]."""


class BoardModel(NamedTuple):
    """The times of a board, the same for all wheels."""

    delay: float
    """From a command's arrival to its effect, on top of the wire and the wait for a loop [s]."""
    window: float
    """Averaging time of the encoders [s]."""
    timeout: float
    """Time after the newest command at which the targets become zero [s]; inf: never."""


class Rounding(NamedTuple):
    """How a board prints speeds: to whole steps [rad/s], rounded, or cut towards zero as C does."""

    step: float = 0.0
    is_cut: bool = False

    def apply(self, speeds: Floats) -> Floats:
        """Return the mean of what is printed for these speeds, which are known to a blur only."""
        sizes = np.abs(speeds)
        if self.is_cut:
            sizes = np.maximum(sizes - self.step / 2.0, 0.0)
        if self.step > ROUNDING_BLUR:
            places = sizes / self.step
            cell = np.floor(places)
            beyond_half = (places - cell - 0.5) * self.step / ROUNDING_BLUR
            sizes = self.step * (cell + np.clip(beyond_half + 0.5, 0.0, 1.0))
        return np.asarray(np.copysign(sizes, speeds))


@jit
def pass_deadband(aim: float, spread: float, deadband: float) -> float:
    """Mean of what a deadband passes, over aims from aim - spread to aim + spread [rad/s]."""
    if abs(aim) - spread >= deadband:
        return aim
    if abs(aim) + spread < deadband or spread <= 0.0:
        return 0.0
    low = max(abs(aim - spread), deadband)
    high = max(abs(aim + spread), deadband)
    return (high * high - low * low) / (4.0 * spread)


@loop
def simulate_speeds(
    heard: LoopCommands,
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
        old = set_point
        set_point = move_towards(old, after[k], step)
        if share[k] < 1.0:
            set_point += (1.0 - share[k]) * (move_towards(old, before[k], step) - set_point)
        aim = pass_deadband(set_point * gain, spread * gain * abs(set_point - old), deadband)
        speed = wheel_speed(speed, aim, 1.0, blend, 0.0, top)
        speeds[k] = speed
    return speeds


def ramp_step(slowness: float, dt: float) -> float:
    """Largest change of a set point in a loop [rad/s]; inf without a ramp."""
    return dt / slowness if slowness > 0.0 else np.inf


def lag_blend(lag: float, dt: float) -> float:
    """Share of the difference by which a speed changes in a loop of `dt` [s]."""
    return float(1.0 - np.exp(-dt / lag)) if lag > 0.0 else 1.0


def sample_commands(edges: Floats, stamps: Floats, commands: Floats) -> LoopCommands:
    """Commands of each loop, where loops lie anywhere within half a period around the edges.

    Args:
        edges: begin of each loop [s], equally spaced.
        stamps: when each command counts [s], ascending.
        commands: (n, wheels) [rad/s]; zero before the first.

    Returns:
        What `simulate_speeds` takes, with the wheels' columns as rows.
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


@dataclass(frozen=True, eq=False)
class Responder:
    """Computes what the wheels of a model answer to the commands of tracks.

    Attributes:
        dt: Period of the firmware's loop [s].
        top: Largest speed of a wheel [rad/s].
        rounding: How speeds are printed.
    """

    dt: float
    top: float
    rounding: Rounding
    kept: dict[tuple[int, float, float], tuple[Floats, LoopCommands]] = field(default_factory=dict)
    """Commands in the loops, for the newest tracks, delays and time-outs."""

    def answer(self, track: BoardTrack, wheel: int, model: WheelModel, times: BoardModel) -> Floats:
        """Return the speeds of one wheel that are printed at a track's stamps [rad/s]."""
        edges, (before, after, share) = self._commands(track, times)
        speeds = simulate_speeds(
            (before[wheel], after[wheel], share),
            step=ramp_step(model.slowness, self.dt),
            blend=lag_blend(model.lag, self.dt),
            gain=model.gain,
            deadband=model.deadband,
            top=self.top,
            spread=PHASE_SPREAD,
        )

        # The encoder's mean speed over its window is the angle that the wheel turned in it.
        ends = np.append(edges, edges[-1] + self.dt)
        angles = np.append(0.0, np.cumsum(speeds) * self.dt)
        turned = np.interp(track.stamps, ends, angles)
        turned -= np.interp(track.stamps - times.window, ends, angles)
        return self.rounding.apply(turned / times.window)

    def residuals(
        self, tracks: Sequence[BoardTrack], wheel: int, model: WheelModel, times: BoardModel
    ) -> Floats:
        """Return by how much one wheel's answer is off on all lines of all tracks [rad/s]."""
        return np.concatenate(
            [self.answer(track, wheel, model, times) - track.speeds[:, wheel] for track in tracks]
        )

    def _commands(self, track: BoardTrack, times: BoardModel) -> tuple[Floats, LoopCommands]:
        """Return the edges of a track's loops, and the commands in them."""
        key = (id(track), times.delay, times.timeout)
        if key not in self.kept:
            if len(self.kept) >= KEPT_COMMANDS:
                del self.kept[next(iter(self.kept))]
            edges = track.loop_edges(self.dt)
            stamps, commands = track.apply_timeout(times.timeout)
            commands = np.clip(commands, -self.top, self.top)
            self.kept[key] = edges, sample_commands(edges, stamps + times.delay, commands)
        return self.kept[key]
