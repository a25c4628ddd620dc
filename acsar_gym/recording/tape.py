"""Plays the control periods of a recorded episode."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.recording.types import Episode, Floats
from acsar_gym.truth import GroundTruth


class Tape:
    """Plays the control periods of an episode.

    Attributes: `now`, the time at the end of the newest period [s]; `first_period`, how long the
    first one lasts [s]; `echoes`, whether what arrived has echoes.
    """

    def __init__(self, episode: Episode) -> None:
        self._first_tick = float(episode.stamps[0]) if len(episode.stamps) else math.inf
        self._periods = periods = episode.exchanges
        self._wire, self._turns = episode.wire, episode.revolutions
        self.echoes = self._wire.echoes
        self._writes, self._pieces = (
            np.concatenate([[0], np.cumsum(np.maximum(counts, 0))])
            for counts in (periods.writes, periods.pieces)
        )
        self._next = 0
        self._written = 0
        self._revolution = -1
        self.now = episode.start
        self.first_period = float(periods.stamps[0]) - self.now if len(periods.stamps) else 0.0

    @property
    def place(self) -> str:
        """Where the tape is, for messages."""
        tick = self._next - int(np.searchsorted(self._periods.stamps, self._first_tick))
        return f"tick {tick}" if tick > 0 else f"period {self._next} of the reset"

    @property
    def is_over(self) -> bool:
        """Whether all periods have been played."""
        return self._next >= len(self._periods.stamps)

    @property
    def has_gap(self) -> bool:
        """Whether the recording lacks the next period, or bytes of it."""
        wire, number = self._wire, self._next
        lacks_sent = bool(self._writes[number + 1] > len(wire.sent))
        lacks_got = bool(self._pieces[number + 1] > len(wire.got))
        return lacks_sent or lacks_got or int(self._periods.numbers[number]) != number

    def wrote(self) -> None:
        """Move on to the time at which the next write was done, where time was real."""
        number = int(self._writes[self._next]) + self._written
        self._written += 1
        stamps = self._wire.sent_stamps
        if self.lateness is not None and number < len(stamps):
            self.now = max(self.now, float(stamps[number]))

    def next(self) -> tuple[bytes, bytes]:
        """Play a period; returns what was sent and what arrived in it."""
        number, wire = self._next, self._wire
        self._next += 1
        self._written = 0
        self.now = float(self._periods.stamps[number])
        sent = wire.sent[self._writes[number] : self._writes[number + 1]]
        got = wire.got[self._pieces[number] : self._pieces[number + 1]]
        return b"".join(sent), b"".join(got)

    @property
    def rest(self) -> bytes:
        """What was sent after the last period, such as the stop at the end."""
        return b"".join(self._wire.sent[self._writes[-1] :])

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
        wire, number = self._wire, self._next
        span = slice(self._pieces[max(number - 1, 0)], self._pieces[number])
        return list(zip(wire.got_stamps[span].tolist(), wire.got[span], strict=True))

    def revolution(self) -> tuple[float, Floats] | None:
        """End [s] of the newest revolution of the LiDAR, and its bearings, distances and times.

        They are (3, n), as in `Revolutions.measured`; None where there is no revolution.
        """
        turns, place = self._turns, self._revolution
        while place + 1 < len(turns.stamps) and turns.exchanges[place + 1] < self._next:
            place += 1
        self._revolution = place
        return (float(turns.stamps[place]), turns.measured[place]) if place >= 0 else None

    def oldest_measurement(self) -> float:
        """Age that a measurement reaches while its revolution is the LiDAR's newest one [s]."""
        turns, ends = self._turns, self._periods.stamps
        if not (len(turns.stamps) and len(ends)):
            return 0.0
        followed = np.append(turns.exchanges[1:], len(ends) - 1)  # then the next one is read
        until: list[float] = ends[np.clip(followed, 0, len(ends) - 1)].tolist()
        ages = zip(until, turns.measured, strict=True)
        return max(end - float(measured[2].min(initial=end)) for end, measured in ages)
