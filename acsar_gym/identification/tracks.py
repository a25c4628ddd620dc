"""What a log's wire carried, as commands and readings with their times at the board."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import BITS_PER_BYTE, LINE_BYTES, RobotConfig
from acsar_gym.recording.jitter import steady
from acsar_gym.recording.wire_log import WireLog

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

GAP = 0.15
"""Time without a command that counts as a pause [s]."""
BLOCK = 1.0
"""Length of the blocks of which some are held out [s]."""
EVERY = 5
"""One block of so many is held out."""
LATE = 0.006
"""Lines that this computer saw later than this after their time don't count [s]."""
LEAD = 0.5
"""Time at rest before the first command and reading; longer than encoders average [s]."""
MARGIN = 0.3
"""Held-out blocks are this far from a pause [s]."""


@dataclass(frozen=True, eq=False)
class Track:
    """One episode of a log, on the host's clock.

    Attributes:
        arrivals: when each command had arrived at the board and was processed, (n,) [s].
        commands: of the four wheels, (n, 4) [rad/s].
        stamps: when the board made each line, (m,) [s].
        speeds: of the four wheels, (m, 4) [rad/s].
        held_out: which lines a fit may not see, (m,).
        numbers: of these lines among all that came, (m,); late ones are left out.
    """

    arrivals: Floats
    commands: Floats
    stamps: Floats
    speeds: Floats
    held_out: Bools
    numbers: NDArray[np.intp]

    @property
    def duration(self) -> float:
        """Time that both commands and readings cover [s]."""
        if len(self.stamps) < 2 or len(self.arrivals) < 2:
            return 0.0
        end = min(self.stamps[-1], self.arrivals[-1])
        return max(0.0, float(end - max(self.stamps[0], self.arrivals[0])))

    @property
    def pauses(self) -> NDArray[np.intp]:
        """Indices of the last command before each pause."""
        return np.flatnonzero(np.diff(self.arrivals) > GAP)

    def grid(self, dt: float) -> Floats:
        """Begin of each firmware loop [s], for loops of `dt` [s]."""
        begin = min(self.arrivals[0], self.stamps[0]) - LEAD
        return np.asarray(begin + dt * np.arange(int((self.stamps[-1] - begin) / dt) + 2))

    def with_timeout(self, timeout: float) -> tuple[Floats, Floats]:
        """Commands and their times, with zeros where the board's time-out [s] acts."""
        pauses = self.pauses
        pauses = pauses[np.diff(self.arrivals)[pauses] > timeout]
        if not len(pauses):
            return self.arrivals, self.commands
        arrivals = np.insert(self.arrivals, pauses + 1, self.arrivals[pauses] + timeout)
        return arrivals, np.insert(self.commands, pauses + 1, 0.0, axis=0)


def track(log: WireLog, config: RobotConfig) -> Track | None:
    """Decode one episode; None where it holds no commands or no readings."""
    line = (LINE_BYTES + config.trailing_comma) * BITS_PER_BYTE / config.baud_rate
    took = line + config.firmware.processing_time
    sent, commands = log.commands(config)
    got, speeds = log.feedback(config)
    if len(sent) < 2 or len(got) < 2:
        return None
    last = np.append(np.diff(got) > 0.0, True)  # of lines that came at once, the newest
    last &= got - steady(got, float(np.median(np.diff(got)))) < LATE
    stamps, speeds, numbers = got[last] - took, speeds[last], np.flatnonzero(last)
    arrivals = np.maximum.accumulate(sent) + took
    seen = (stamps >= arrivals[0]) & (stamps <= arrivals[-1] + GAP)
    if not seen.any():
        return None
    stamps, speeds = stamps[seen], speeds[seen]
    held_out = _held_out(stamps, arrivals)
    return Track(arrivals, commands, stamps, speeds, held_out, numbers[seen])


def _held_out(stamps: Floats, arrivals: Floats) -> Bools:
    """Choose every fifth block, but for pauses."""
    block = ((stamps - stamps[0]) / BLOCK).astype(int)
    chosen = block % EVERY == EVERY - 1
    for k in np.flatnonzero(np.diff(arrivals) > GAP):
        chosen &= (stamps < arrivals[k] - MARGIN) | (stamps > arrivals[k + 1] + MARGIN)
    return np.asarray(chosen)
