"""Statistics of tick lateness, feedback age and round trip time, in bounded memory."""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.config import RobotConfig

STANDSTILL = 0.1  # wheels slower than this count as standing still [rad/s]
VISIBLE_SPEED = 0.005  # wheels faster than this, and than twice before, show a command [rad/s]

KEPT_TRIPS = 1000  # round trips of an episode that are kept one by one
KEPT_DURATIONS = 1_000_000  # durations that percentiles are of, at least: those of 2.8 h at 100 Hz


@dataclass(frozen=True, slots=True)
class DurationSpread:
    """Percentiles and maximum of durations [s]; NaN if there were none."""

    count: int
    p50: float
    p99: float
    worst: float


@dataclass(frozen=True, slots=True)
class TickTiming:
    """Lateness of the ticks of an episode [s]; NaN if there were none."""

    ticks: int
    late_ticks: int
    """Ticks that ended more than the robot's `late_after` after their deadline."""
    missed_ticks: int
    """Control periods that passed without a tick."""
    p50: float
    p99: float
    worst: float

    @property
    def late_share(self) -> float:
        """Share of late ticks; 0 if there were no ticks."""
        return self.late_ticks / self.ticks if self.ticks else 0.0


@dataclass(frozen=True, slots=True)
class EpisodeTiming:
    """Timing of an episode, from the end of its first tick on."""

    lateness: TickTiming
    feedback_age: DurationSpread
    """Age of the newest valid line after every tick [s]; 0 if it arrived during the tick."""
    round_trip: DurationSpread
    """Time from the last byte of a command to wheels that stand, as it leaves the port, to the
    first byte of the first line that shows an effect [s]; up to a tick more where the link doesn't
    tell when bytes arrive."""
    round_trips: tuple[float, ...] = ()
    """Each of them [s], the newest `KEPT_TRIPS` at most."""


class DurationRecord:
    """Keeps durations [s], the newest `KEPT_DURATIONS` at least; negative ones count as zero.

    Attributes: `count`, of all; `worst`, the longest of all [s], NaN if there is none.
    """

    def __init__(self) -> None:
        self.count = 0
        self.worst = math.nan
        self._newest = array("d")

    def add(self, seconds: float) -> None:
        """Add a duration [s]."""
        seconds = max(seconds, 0.0)
        if not (self.count and seconds <= self.worst):
            self.worst = seconds
        self.count += 1
        self._newest.append(seconds)
        if len(self._newest) > 2 * KEPT_DURATIONS:
            del self._newest[:KEPT_DURATIONS]

    def percentile(self, q: float) -> float:
        """Return a percentile, 0 to 100, by nearest rank [s]; NaN if there are no durations."""
        if not self._newest:
            return math.nan
        return float(np.percentile(np.array(self._newest), q, method="inverted_cdf"))

    def spread(self) -> DurationSpread:
        """Return percentiles and maximum."""
        return DurationSpread(self.count, self.percentile(50.0), self.percentile(99.0), self.worst)


class LatenessRecord(DurationRecord):
    """Keeps the lateness of ticks.

    Attributes: `late`, ticks that ended more than `limit` [s] after their deadline; `missed`, whole
    periods without a tick.
    """

    def __init__(self, config: RobotConfig) -> None:
        super().__init__()
        self.period, self.limit = config.period, config.late_tick
        self.late = self.missed = 0

    def add(self, seconds: float) -> None:
        """Add a tick that ended `seconds` after its deadline."""
        super().add(seconds)
        if seconds > self.limit:
            self.late += 1
            if seconds > self.period:
                self.missed += int(seconds / self.period)

    def summary(self) -> TickTiming:
        """Return the statistics."""
        p50, p99 = self.percentile(50.0), self.percentile(99.0)
        return TickTiming(self.count, self.late, self.missed, p50, p99, self.worst)


class EpisodeStopwatch:
    """Measures the timing of one episode."""

    def __init__(self, config: RobotConfig) -> None:
        self._lateness = LatenessRecord(config)
        self._ages, self._trips = DurationRecord(), DurationRecord()
        self._newest_trips: deque[float] = deque(maxlen=KEPT_TRIPS)
        self._begun = False
        self._asked: float | None = None
        self._fastest = self._shows = 0.0

    def tick(self, lateness: float, age: float) -> float | None:
        """Add a tick; returns its lateness, None for the first: its deadline is the reset's."""
        if not self._begun:
            self._begun = True
            return None
        self._lateness.add(lateness)
        self._ages.add(age)
        return lateness

    def commanded(self, written: float, fastest: float, *, drives: bool) -> bool:
        """Add a command, and what the feedback of its period shows.

        Returns whether a command to wheels that stood waits to be seen: call `heard` then.
        """
        if not drives:
            self._asked = None
        elif self._asked is None and self._fastest < STANDSTILL:
            self._asked, self._shows = written, max(VISIBLE_SPEED, 2.0 * self._fastest)
        self._fastest = fastest
        return self._asked is not None

    def heard(self, arrivals: Sequence[tuple[float, bytes]], end: float) -> None:
        """End the round trip if the wheels turn by now."""
        if self._asked is not None and self._fastest > self._shows:
            trip = first_byte(arrivals, end) - self._asked
            self._trips.add(trip)
            self._newest_trips.append(trip)
            self._asked = None

    def summary(self) -> EpisodeTiming:
        """Return the timing of the episode."""
        lateness, ages, trips = self._lateness.summary(), self._ages.spread(), self._trips.spread()
        return EpisodeTiming(lateness, ages, trips, tuple(self._newest_trips))


def first_byte(arrivals: Sequence[tuple[float, bytes]], end: float) -> float:
    """Return when the first byte of the newest line of a period arrived [s]."""

    def after_line(data: bytes) -> int:
        return max(data.rfind(b"\n"), data.rfind(b"\r")) + 1

    data = b"".join(piece for _, piece in arrivals)
    begin, passed = after_line(data[: after_line(data)].rstrip(b"\r\n")), 0
    for stamp, piece in arrivals:
        passed += len(piece)
        if passed > begin:
            return stamp
    return end
