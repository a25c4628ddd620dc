"""One episode of a recording, played period by period."""

from __future__ import annotations

import itertools
import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.recording.types import Episode


class Tape:
    """Plays the control periods of an episode.

    Args:
        episode: of a recording.

    Attributes: `now`, the time at the end of the newest period [s].
    """

    def __init__(self, episode: Episode) -> None:
        self._episode = episode
        self._periods = episode.exchanges
        self._writes = _edges(self._periods.writes)
        self._pieces = _edges(self._periods.pieces)
        self._next = 0
        self._written = 0
        self._scan = -1
        self.now = episode.start

    @property
    def place(self) -> str:
        """Where the tape is, for messages."""
        periods, ticks = self._periods.stamps, self._episode.stamps
        before = np.searchsorted(periods, ticks[0]) if len(ticks) else len(periods)
        tick = self._next - int(before)
        return f"tick {tick}" if tick > 0 else f"period {self._next} of the reset"

    @property
    def is_over(self) -> bool:
        """Whether all periods have been played."""
        return self._next >= len(self._periods.stamps)

    @property
    def has_gap(self) -> bool:
        """Whether the recording lacks the next period, or bytes of it."""
        wire, number = self._episode.wire, self._next
        short = self._writes[number + 1] > len(wire.sent) or self._pieces[number + 1] > len(
            wire.got
        )
        return short or self._periods.numbers[number] != number

    def wrote(self) -> None:
        """Move on to the time at which the next write was done, where time was real."""
        number = self._writes[self._next] + self._written
        self._written += 1
        stamps = self._episode.wire.sent_stamps
        if self.lateness is not None and number < len(stamps):
            self.now = max(self.now, float(stamps[number]))

    def next(self) -> tuple[bytes, bytes]:
        """Play a period; returns what was sent and what arrived in it."""
        number, wire = self._next, self._episode.wire
        self._next += 1
        self._written = 0
        self.now = float(self._periods.stamps[number])
        sent = wire.sent[self._writes[number] : self._writes[number + 1]]
        got = wire.got[self._pieces[number] : self._pieces[number + 1]]
        return b"".join(sent), b"".join(got)

    @property
    def rest(self) -> bytes:
        """What was sent after the last period, such as the stop at the end."""
        return b"".join(self._episode.wire.sent[self._writes[-1] :])

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth at the end of the newest period; None where it wasn't recorded."""
        if not len(self._periods.truth):
            return None
        x, y, theta, linear, angular, contact = self._periods.truth[max(self._next - 1, 0)].tolist()
        if math.isnan(x):
            return None
        return GroundTruth((x, y, theta), (linear, angular), bool(contact))

    @property
    def lateness(self) -> float | None:
        """Lateness of the newest period [s]; None where time was simulated."""
        if not len(self._periods.lateness):
            return None
        late = float(self._periods.lateness[max(self._next - 1, 0)])
        return None if math.isnan(late) else late

    @property
    def arrivals(self) -> list[tuple[float, bytes]]:
        """When the bytes of the newest period arrived [s]."""
        wire, number = self._episode.wire, self._next
        span = slice(self._pieces[max(number - 1, 0)], self._pieces[number])
        return list(zip(wire.got_stamps[span].tolist(), wire.got[span], strict=True))

    def scan(self) -> tuple[float, NDArray[np.float64]] | None:
        """Stamp [s] and ranges [m] of the newest scan; None where there is none."""
        scans = self._episode.scans
        while self._scan + 1 < len(scans.stamps) and (scans.exchanges[self._scan + 1] < self._next):
            self._scan += 1
        if self._scan < 0:
            return None
        return float(scans.stamps[self._scan]), scans.ranges[self._scan]


def _edges(counts: NDArray[np.int64]) -> list[int]:
    """Where the bytes of each period begin and end, from their counts."""
    return [0, *itertools.accumulate(np.maximum(counts, 0).tolist())]
