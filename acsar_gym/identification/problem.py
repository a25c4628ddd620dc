"""The least squares problem: residuals of all wheels over the twin's answer, and derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.identification.response import (
    Clock,
    Heard,
    Wheel,
    blend_of,
    speeds_of,
    step_of,
    targets_at,
    windowed,
)
from acsar_gym.identification.tracks import Track

Floats = NDArray[np.float64]
Ints = NDArray[np.intp]

PER_WHEEL = 3
"""Lag, gain and slowness of the ramp; the deadband isn't smooth."""
STEPS = np.array([5e-3, 1e-3, 5e-4])
"""Steps of their derivatives: relative for the lag, then plain."""
CLOCK_STEPS = np.array([1e-3, 2e-3, 2e-3])
"""Steps of delay, window and time-out [s]."""
LOW = np.array([2e-3, 0.2, 0.0])
HIGH = np.array([3.0, 5.0, 1.0])
"""Bounds of lag [s], gain and slowness [s^2/rad]."""
SMOOTH = 0.5
"""Spread of set points in a loop, for `speeds_of`."""
KEPT = 32
"""Delays and time-outs for which each track's commands are kept."""
BLOCK = 0.5
"""Residuals within such a time and of one wheel may depend on each other [s]."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Tracks of one robot, and the wheels that they tell something about.

    Parameters are one vector: lag, gain and slowness of each wheel, then the clock's: delay to the
    middle of the window, window, time-out. A delay by itself would hang on the window.
    """

    tracks: Sequence[Track]
    wheels: tuple[int, ...]
    dt: float
    top: float
    held_out: bool = False
    """Whether residuals are those of the held-out lines, instead of the others."""
    kept: dict[tuple[int, float, float], tuple[Floats, Heard]] = field(default_factory=dict)
    """Commands in the loops, for the newest delays and time-outs."""

    @classmethod
    def of(cls, tracks: Sequence[Track], wheels: Sequence[int], config: RobotConfig) -> Problem:
        """Make the problem of a robot with this loop rate and top speed."""
        return cls(tracks, tuple(wheels), 1.0 / config.firmware.loop_rate, config.motor.max_speed)

    @property
    def size(self) -> int:
        """Number of parameters."""
        return PER_WHEEL * len(self.wheels) + len(CLOCK_STEPS)

    def split(self, x: Floats, deadbands: Sequence[float]) -> tuple[list[Wheel], Clock]:
        """Name the numbers of a parameter vector."""
        n = PER_WHEEL * len(self.wheels)
        rows = x[:n].reshape(-1, PER_WHEEL).tolist()
        motors = [
            Wheel(lag, gain, slowness, band)
            for (lag, gain, slowness), band in zip(rows, deadbands, strict=True)
        ]
        middle, window, timeout = x[n:].tolist()
        return motors, Clock(middle - window / 2.0, window, timeout)

    def joined(self, motors: Sequence[Wheel], clock: Clock) -> Floats:
        """Make a parameter vector."""
        rows = [motor[:PER_WHEEL] for motor in motors]
        return np.concatenate((*rows, (clock.delay + clock.window / 2.0, *clock[1:])))

    def chosen(self, track: Track) -> NDArray[np.bool_]:
        """Which lines of a track count."""
        return track.held_out if self.held_out else ~track.held_out

    def answer(self, track: Track, wheel: int, motor: Wheel, clock: Clock) -> Floats:
        """Speeds of one wheel at a track's stamps, as encoders without counts report them."""
        edges, (before, after, share) = self._heard(track, clock)
        heard = before[wheel], after[wheel], share
        step, blend = step_of(motor.slowness, self.dt), blend_of(motor.lag, self.dt)
        speeds = speeds_of(heard, step, blend, motor.gain, motor.deadband, self.top, SMOOTH)
        return windowed(edges, speeds, track.stamps, clock.window)

    def _heard(self, track: Track, clock: Clock) -> tuple[Floats, Heard]:
        """Loops of a track, and the commands of all wheels in them; the newest ones are kept."""
        key = (id(track), clock.delay, clock.timeout)
        if key not in self.kept:
            while len(self.kept) >= KEPT * len(self.tracks):
                del self.kept[next(iter(self.kept))]
            edges = track.grid(self.dt)
            stamps, commands = track.with_timeout(clock.timeout)
            self.kept[key] = edges, targets_at(edges, stamps + clock.delay, commands)
        return self.kept[key]

    def residuals_of(self, index: int, motor: Wheel, clock: Clock) -> Floats:
        """Residuals of one wheel over all tracks [rad/s]."""
        wheel = self.wheels[index]
        parts = [
            (self.answer(track, wheel, motor, clock) - track.speeds[:, wheel])[self.chosen(track)]
            for track in self.tracks
        ]
        return np.concatenate(parts)

    def measured(self, index: int) -> Floats:
        """Printed speeds of one wheel that count, over all tracks [rad/s]."""
        wheel = self.wheels[index]
        return np.concatenate([t.speeds[self.chosen(t), wheel] for t in self.tracks])

    def residuals(self, x: Floats, deadbands: Sequence[float]) -> Floats:
        """Residuals of all wheels, one after the other [rad/s]."""
        motors, clock = self.split(x, deadbands)
        parts = [self.residuals_of(k, motor, clock) for k, motor in enumerate(motors)]
        return np.concatenate(parts)

    def jacobian(self, x: Floats, deadbands: Sequence[float]) -> Floats:
        """Derivatives of the residuals; a wheel's own parameters concern its residuals only."""
        motors, clock = self.split(x, deadbands)
        columns = np.zeros((len(self.wheels), self.size, self.count))
        for k, motor in enumerate(motors):
            base = self.residuals_of(k, motor, clock)
            for p, step in enumerate(STEPS * [motor.lag, 1.0, 1.0]):
                moved = motor._replace(**{Wheel._fields[p]: motor[p] + step})
                columns[k, PER_WHEEL * k + p] = (self.residuals_of(k, moved, clock) - base) / step
            for p, step in enumerate(CLOCK_STEPS):
                other = _moved(clock, p, step)
                row = PER_WHEEL * len(motors) + p
                columns[k, row] = (self.residuals_of(k, motor, other) - base) / step
        return columns.transpose(0, 2, 1).reshape(-1, self.size)

    @property
    def count(self) -> int:
        """Residuals of one wheel."""
        return sum(int(self.chosen(track).sum()) for track in self.tracks)

    @property
    def blocks_of_wheel(self) -> int:
        """Number of blocks of one wheel."""
        return sum(1 + int((t.stamps[-1] - t.stamps[0]) / BLOCK) for t in self.tracks)

    def blocks(self) -> Ints:
        """Number of the block that each residual belongs to, wheel by wheel."""
        begin, numbers = 0, []
        for _ in self.wheels:
            for track in self.tracks:
                block = ((track.stamps - track.stamps[0]) / BLOCK).astype(np.intp)
                numbers.append(begin + block[self.chosen(track)])
                begin += int(block[-1]) + 1
        return np.concatenate(numbers)


def _moved(clock: Clock, p: int, step: float) -> Clock:
    """The clock after a step of its parameter p; the window grows around its middle."""
    moved = clock._replace(**{Clock._fields[p]: clock[p] + step})
    return moved._replace(delay=clock.delay - step / 2.0) if p == 1 else moved
