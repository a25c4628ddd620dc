"""The twin's answer of each wheel to commands, and its residuals over recorded tracks.

Ramp and motor are the functions of `physics.model` that the firmware's twin and its bodies use, at
the same loop rate. The phase of the twin's loops to the host's stamps isn't known, so commands and
encoder readings are interpolated between loops. That is the mean over all phases of the twin's
clock, and it is smooth in delay and window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from acsar_gym.jit import jit, loop
from acsar_gym.physics.model import move_towards, wheel_speed
from acsar_gym.recording.types import Floats
from acsar_gym.tools.sysid.board_log import BoardTrack

LoopCommands = tuple[Floats, Floats, Floats]
"""For each loop: the command one loop earlier and that of the loop [rad/s], and the probability
that the loop already has the latter."""
PHASE_SPREAD = 0.5
"""Spread of set points in a loop, for `simulate_speeds`."""
KEPT_COMMANDS = 64
"""Most delays and time-outs for which each track's commands are kept. Any small number will do."""
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
    """Time in which the set point's ramp rises by 1 rad/s [s^2/rad]. 0 without a ramp."""
    deadband: float
    """Set points below this don't turn the wheel [rad/s]."""


class BoardModel(NamedTuple):
    """The times of a board, the same for all wheels."""

    delay: float
    """From a command's arrival to its effect, on top of the wire and the wait for a loop [s]."""
    window: float
    """Averaging time of the encoders [s]."""
    timeout: float
    """Time after the newest command at which the targets become zero [s]."""


class Rounding(NamedTuple):
    """How a board prints speeds: to whole steps [rad/s], rounded, or cut towards zero as C does."""

    step: float = 0.0
    is_cut: bool = False

    def apply(self, speeds: Floats) -> Floats:
        """Return the mean number that is printed for speeds that are known to a blur only."""
        sizes = np.abs(speeds)

        # Integers are cut towards zero, half a step below the rounded number on average.
        if self.is_cut:
            sizes = np.maximum(sizes - self.step / 2.0, 0.0)
        if self.step > ROUNDING_BLUR:
            # A coarse step stays visible. Its edges are as soft as the blur.
            places = sizes / self.step
            cell = np.floor(places)
            beyond_half = (places - cell - 0.5) * self.step / ROUNDING_BLUR
            sizes = self.step * (cell + np.clip(beyond_half + 0.5, 0.0, 1.0))
        return np.asarray(np.copysign(sizes, speeds))


@jit
def pass_deadband(aim: float, spread: float, deadband: float) -> float:
    """Return the mean aim that a deadband passes, over aims up to `spread` away [rad/s]."""
    if abs(aim) - spread >= deadband:
        return aim
    if abs(aim) + spread < deadband or spread <= 0.0:
        return 0.0

    # Part of the aims is below the deadband. The mean of the others is a difference of squares.
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
        heard: Commands of each loop.
        step: Largest change of the set point in a loop [rad/s].
        blend: Share of the difference by which the speed changes in a loop.
        gain: Factor from set point to speed.
        deadband: Set points below this count as zero [rad/s].
        top: Largest speed [rad/s].
        spread: 0 for the twin's own loops. 0.5 for the mean over the phases of its clock when a
            set point crosses the deadband, which is smooth.

    Returns:
        Speeds [rad/s], one per loop.
    """
    older, newer, share = heard
    speeds = np.empty(len(newer))
    set_point = speed = 0.0

    for k in range(len(newer)):
        old = set_point
        set_point = move_towards(old, newer[k], step)

        # In some phases of its clock, the loop still has the older command.
        if share[k] < 1.0:
            set_point += (1.0 - share[k]) * (move_towards(old, older[k], step) - set_point)
        aim = pass_deadband(set_point * gain, spread * gain * abs(set_point - old), deadband)
        speed = wheel_speed(speed, aim, gain=1.0, blend=blend, deadband=0.0, top=top)
        speeds[k] = speed
    return speeds


@dataclass(eq=False)
class Responder:
    """Computes how the wheels of a model answer to the commands of tracks."""

    tracks: Sequence[BoardTrack]
    dt: float
    """Period of the firmware's loop [s]."""
    top: float
    """Largest speed of a wheel [rad/s]."""
    rounding: Rounding

    def __post_init__(self) -> None:
        """Keep the newest commands: derivatives use the same delays and time-outs repeatedly."""
        self._commands = lru_cache(KEPT_COMMANDS)(self._find_commands)

    def answers(self, wheel: int, model: WheelModel, times: BoardModel) -> Floats:
        """Return the speeds of one wheel that all lines of all tracks should show [rad/s]."""
        return np.concatenate(
            [self._answer(place, wheel, model, times) for place in range(len(self.tracks))]
        )

    def _answer(self, place: int, wheel: int, model: WheelModel, times: BoardModel) -> Floats:
        # The twin's own loop, with the parameters that are tried.
        edges, (older, newer, share) = self._commands(place, times.delay, times.timeout)
        speeds = simulate_speeds(
            (older[wheel], newer[wheel], share),
            step=self.dt / model.slowness if model.slowness > 0.0 else np.inf,
            blend=float(1.0 - np.exp(-self.dt / model.lag)),
            gain=model.gain,
            deadband=model.deadband,
            top=self.top,
            spread=PHASE_SPREAD,
        )

        # The encoder's mean speed over its window is the angle that the wheel turned in it.
        stamps = self.tracks[place].stamps
        ends = np.append(edges, edges[-1] + self.dt)
        angles = np.append(0.0, np.cumsum(speeds) * self.dt)
        turned = np.interp(stamps, ends, angles) - np.interp(stamps - times.window, ends, angles)
        return self.rounding.apply(turned / times.window)

    def _find_commands(
        self, place: int, delay: float, timeout: float
    ) -> tuple[Floats, LoopCommands]:
        """Return the edges of a track's loops, and the commands of the wheels in them."""
        track = self.tracks[place]
        edges = track.loop_edges(self.dt)
        # A time-out acts as a command of zero.
        arrivals, commands = track.apply_timeout(timeout)
        stamps = arrivals + delay

        # A loop starts anywhere within half a period around its edge.
        dt = edges[1] - edges[0]
        latest = edges + dt / 2.0
        newest = np.searchsorted(stamps, latest, side="right") - 1
        newer = np.ascontiguousarray(np.clip(commands, -self.top, self.top)[newest].T)
        newer[:, newest < 0] = 0.0
        older = np.zeros_like(newer)
        older[:, 1:] = newer[:, :-1]
        share = np.clip((latest - stamps[np.maximum(newest, 0)]) / dt, 0.0, 1.0)
        return edges, (older, newer, share)
