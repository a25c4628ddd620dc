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
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.jit import jit, loop
from acsar_gym.physics.model import move_towards, wheel_speed
from acsar_gym.tools.sysid.board_log import BoardTrack, Floats

LoopCommands = tuple[Floats, Floats, Floats]
"""For each loop: the command one loop earlier and that of the loop [rad/s], and the probability
that the loop already has the latter."""
PARAMETERS_PER_WHEEL = 3
"""Lag, gain and slowness of the ramp; the deadband isn't smooth."""
WHEEL_STEPS = np.array([5e-3, 1e-3, 5e-4])
"""Steps of their derivatives: relative for the lag, then plain."""
CLOCK_STEPS = np.array([1e-3, 2e-3, 2e-3])
"""Steps of delay, window and time-out [s]."""
ABOVE_TOP = 1.05
"""Lines that are faster than this share of the configured top speed show that it isn't the top."""
PHASE_SPREAD = 0.5
"""Spread of set points in a loop, for `simulate_speeds`."""
KEPT_COMMANDS = 32
"""Delays and time-outs for which each track's commands are kept."""
RESIDUAL_BLOCK = 0.5
"""Residuals within such a time and of one wheel may depend on each other [s]."""


class WheelModel(NamedTuple):
    """The motor of one wheel, as a fit varies it."""

    lag: float
    """Time constant of the speed loop [s]."""
    gain: float
    """Factor from set point to speed."""
    slowness: float
    """Time that the set point's ramp needs for 1 rad/s [s^2/rad]; 0 without a ramp."""
    deadband: float
    """Set points below this don't turn the wheel [rad/s]."""


class BoardTimes(NamedTuple):
    """The times of a board, the same for all wheels."""

    delay: float
    """From a command's arrival to its effect, on top of the wire and the wait for a loop [s]."""
    window: float
    """Averaging time of the encoders [s]."""
    timeout: float
    """Time after the newest command at which the targets become zero [s]; inf: never."""


@jit
def pass_deadband(aim: float, spread: float, deadband: float) -> float:
    """Mean of what a deadband passes, over aims from aim - spread to aim + spread [rad/s]."""
    if abs(aim) - spread >= deadband:
        return aim
    if abs(aim) + spread < deadband or spread <= 0.0:
        return 0.0
    low, high = max(abs(aim - spread), deadband), max(abs(aim + spread), deadband)
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
        commands: (n,) or (n, wheels) [rad/s]; zero before the first.

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
class FitProblem:
    """Tracks of one robot, the wheels that they tell something about, and the model's residuals.

    Parameters are one vector: lag, gain and slowness of each wheel, then the clock's: delay to the
    middle of the window, window, time-out. A delay by itself would hang on the window.
    """

    tracks: Sequence[BoardTrack]
    wheels: tuple[int, ...]
    dt: float
    """Period of the firmware's loop [s]."""
    top: float
    """Largest speed of a wheel [rad/s]."""
    held_out: bool = False
    """Whether residuals are those of the held-out lines, instead of the others."""
    kept: dict[tuple[int, float, float], tuple[Floats, LoopCommands]] = field(default_factory=dict)
    """Commands in the loops, for the newest delays and time-outs."""

    @classmethod
    def of(
        cls, tracks: Sequence[BoardTrack], wheels: Sequence[int], config: RobotConfig
    ) -> FitProblem:
        """Make the problem of a robot with this loop rate and top speed.

        Feedback in another unit exceeds the top speed, and then nothing is known of that.
        """
        fastest = max(float(np.abs(track.speeds).max()) for track in tracks)
        top = config.motor.max_speed
        if fastest > ABOVE_TOP * top:
            top = 1.1 * fastest
        return cls(tracks, tuple(wheels), 1.0 / config.firmware.loop_rate, top)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return PARAMETERS_PER_WHEEL * len(self.wheels) + len(CLOCK_STEPS)

    @property
    def count(self) -> int:
        """Residuals of one wheel."""
        return sum(int(self.chosen(track).sum()) for track in self.tracks)

    def split(self, x: Floats, deadbands: Sequence[float]) -> tuple[list[WheelModel], BoardTimes]:
        """Name the numbers of a parameter vector."""
        n = PARAMETERS_PER_WHEEL * len(self.wheels)
        rows = x[:n].reshape(-1, PARAMETERS_PER_WHEEL).tolist()
        wheels = [
            WheelModel(lag, gain, slowness, band)
            for (lag, gain, slowness), band in zip(rows, deadbands, strict=True)
        ]
        middle, window, timeout = x[n:].tolist()
        return wheels, BoardTimes(middle - window / 2.0, window, timeout)

    def join(self, wheels: Sequence[WheelModel], times: BoardTimes) -> Floats:
        """Make a parameter vector."""
        rows = [wheel[:PARAMETERS_PER_WHEEL] for wheel in wheels]
        return np.concatenate((*rows, (times.delay + times.window / 2.0, *times[1:])))

    def chosen(self, track: BoardTrack) -> NDArray[np.bool_]:
        """Which lines of a track count."""
        return track.held_out if self.held_out else ~track.held_out

    def answer(self, track: BoardTrack, wheel: int, model: WheelModel, times: BoardTimes) -> Floats:
        """Speeds of one wheel at a track's stamps, as encoders without counts report them."""
        key = (id(track), times.delay, times.timeout)
        if key not in self.kept:
            while len(self.kept) >= KEPT_COMMANDS * len(self.tracks):
                del self.kept[next(iter(self.kept))]
            edges = track.loop_edges(self.dt)
            stamps, commands = track.apply_timeout(times.timeout)
            commands = np.clip(commands, -self.top, self.top)
            self.kept[key] = edges, sample_commands(edges, stamps + times.delay, commands)
        edges, (before, after, share) = self.kept[key]
        heard = before[wheel], after[wheel], share
        step, blend = ramp_step(model.slowness, self.dt), lag_blend(model.lag, self.dt)
        speeds = simulate_speeds(
            heard, step, blend, model.gain, model.deadband, self.top, PHASE_SPREAD
        )
        dt = edges[1] - edges[0]
        ends = np.concatenate((edges, [edges[-1] + dt]))
        angles = np.concatenate(([0.0], np.cumsum(speeds) * dt))
        turned = np.interp(track.stamps, ends, angles)
        return (turned - np.interp(track.stamps - times.window, ends, angles)) / times.window

    def measured(self, index: int) -> Floats:
        """Printed speeds of one wheel that count, over all tracks [rad/s]."""
        wheel = self.wheels[index]
        return np.concatenate([t.speeds[self.chosen(t), wheel] for t in self.tracks])

    def residuals_of(self, index: int, model: WheelModel, times: BoardTimes) -> Floats:
        """Residuals of one wheel over all tracks, in the order of `measured` [rad/s]."""
        wheel = self.wheels[index]
        parts = [
            (self.answer(track, wheel, model, times) - track.speeds[:, wheel])[self.chosen(track)]
            for track in self.tracks
        ]
        return np.concatenate(parts)

    def residuals(self, x: Floats, deadbands: Sequence[float]) -> Floats:
        """Residuals of all wheels, one after the other [rad/s]."""
        wheels, times = self.split(x, deadbands)
        return np.concatenate([self.residuals_of(k, one, times) for k, one in enumerate(wheels)])

    def jacobian(self, x: Floats, deadbands: Sequence[float]) -> Floats:
        """Derivatives of the residuals; a wheel's own parameters concern its residuals only."""
        wheels, times = self.split(x, deadbands)
        columns = np.zeros((len(self.wheels), self.size, self.count))
        for k, model in enumerate(wheels):
            base = self.residuals_of(k, model, times)
            for p, step in enumerate(WHEEL_STEPS * [model.lag, 1.0, 1.0]):
                moved = model._replace(**{WheelModel._fields[p]: model[p] + step})
                row = PARAMETERS_PER_WHEEL * k + p
                columns[k, row] = (self.residuals_of(k, moved, times) - base) / step
            for p, step in enumerate(CLOCK_STEPS):
                other = times._replace(**{BoardTimes._fields[p]: times[p] + step})
                if p == 1:  # the window grows around its middle
                    other = other._replace(delay=times.delay - step / 2.0)
                row = PARAMETERS_PER_WHEEL * len(wheels) + p
                columns[k, row] = (self.residuals_of(k, model, other) - base) / step
        return columns.transpose(0, 2, 1).reshape(-1, self.size)

    def blocks(self) -> NDArray[np.intp]:
        """Number of the block that each residual belongs to, wheel by wheel."""
        begin, numbers = 0, []
        for _ in self.wheels:
            for track in self.tracks:
                block = ((track.stamps - track.stamps[0]) / RESIDUAL_BLOCK).astype(np.intp)
                numbers.append(begin + block[self.chosen(track)])
                begin += int(block[-1]) + 1
        return np.concatenate(numbers)

    @property
    def blocks_of_wheel(self) -> int:
        """Number of blocks of one wheel."""
        return sum(1 + int((t.stamps[-1] - t.stamps[0]) / RESIDUAL_BLOCK) for t in self.tracks)
