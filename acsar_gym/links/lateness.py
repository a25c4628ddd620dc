"""Statistics of tick lateness, feedback age and round trip time, in bounded memory.

Durations are counted in buckets that are linear within each octave, so a percentile is at most 3 %
too large, and adding one costs less than a microsecond. Extremes and counts are exact.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from acsar_gym.config import RobotConfig

STANDSTILL = 0.1
"""Wheels slower than this count as standing still [rad/s]."""
VISIBLE_SPEED = 0.005
"""Wheels faster than this, and than twice what they showed before, show a command [rad/s]."""

KEPT_TRIPS = 1000
"""Round trips of an episode that are kept one by one."""
BUCKETS_PER_OCTAVE = 32
SHORTEST_DURATION = 2.0**-20
"""Shorter durations count as zero [s]."""
LONGEST_DURATION = 64.0
"""Durations from here on are in the last bucket [s]; `worst` stays exact."""
_FIRST = math.frexp(SHORTEST_DURATION)[1]
_BUCKETS = (math.frexp(LONGEST_DURATION)[1] - _FIRST) * BUCKETS_PER_OCTAVE + 2


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


class DurationHistogram:
    """Counts any number of durations [s]; negative ones count as zero."""

    def __init__(self) -> None:
        self.count = 0
        self._worst = 0.0
        self._buckets = [0] * _BUCKETS

    def add(self, seconds: float) -> None:
        """Add a duration [s]."""
        self.count += 1
        self._worst = max(self._worst, seconds)
        if seconds < SHORTEST_DURATION:
            bucket = 0
        elif seconds < LONGEST_DURATION:
            fraction, octave = math.frexp(seconds)
            place = int(2 * BUCKETS_PER_OCTAVE * fraction)
            bucket = (octave - _FIRST - 1) * BUCKETS_PER_OCTAVE + place + 1
        else:
            bucket = -1
        self._buckets[bucket] += 1

    @property
    def worst(self) -> float:
        """The longest duration [s], exact; NaN if there is none."""
        return self._worst if self.count else math.nan

    def percentile(self, q: float) -> float:
        """Return a percentile [s]; NaN if there are no durations.

        At most 3 % too large; never too small, except durations that count as zero.

        Args:
            q: 0 to 100.
        """
        if not self.count:
            return math.nan
        wanted = max(1, math.ceil(q / 100.0 * self.count))
        bucket = bisect_left(list(accumulate(self._buckets)), wanted)
        if bucket == 0:
            return 0.0
        if bucket == _BUCKETS - 1:
            return self._worst
        octave, part = divmod(bucket - 1, BUCKETS_PER_OCTAVE)
        fraction = (BUCKETS_PER_OCTAVE + part + 1) / (2 * BUCKETS_PER_OCTAVE)
        return min(math.ldexp(fraction, _FIRST + octave), self._worst)

    def spread(self) -> DurationSpread:
        """Return percentiles and maximum."""
        return DurationSpread(self.count, self.percentile(50.0), self.percentile(99.0), self.worst)


class LatenessHistogram(DurationHistogram):
    """Counts the lateness of ticks.

    Args:
        config: of the robot, for its control period and what it calls late.

    Attributes:
        late: ticks that ended more than `limit` after their deadline.
        limit: `config.late_tick` [s].
        missed: whole periods without a tick; a tick that ends 3.5 periods late has missed
            three.
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
    """Measures the timing of one episode.

    Args:
        config: of the robot.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._lateness = LatenessHistogram(config)
        self._ages, self._trips = DurationHistogram(), DurationHistogram()
        self._newest_trips: deque[float] = deque(maxlen=KEPT_TRIPS)
        self._begun = False
        self._asked: float | None = None
        self._fastest = self._shows = 0.0

    def tick(self, lateness: float, age: float) -> float | None:
        """Add a tick.

        Args:
            lateness: time from its deadline to its end [s].
            age: age of the newest feedback [s].

        Returns:
            The lateness; None for the first tick, whose deadline is the reset's: nothing drove
            since, so that the time until the first command doesn't count.
        """
        if not self._begun:
            self._begun = True
            return None
        self._lateness.add(lateness)
        self._ages.add(age)
        return lateness

    def commanded(self, written: float, fastest: float, *, drives: bool) -> bool:
        """Add a command, and what the feedback of its period shows.

        Args:
            written: time at which its last byte has left the port [s].
            fastest: highest absolute wheel speed of the newest feedback [rad/s].
            drives: whether the command isn't zero.

        Returns:
            Whether a command to wheels that stood waits for a line that shows it, or this period
            brought it: call `heard` then.
        """
        if not drives:
            self._asked = None
        elif self._asked is None and self._fastest < STANDSTILL:
            self._asked, self._shows = written, max(VISIBLE_SPEED, 2.0 * self._fastest)
        self._fastest = fastest
        return self._asked is not None

    def heard(self, arrivals: Sequence[tuple[float, bytes]], end: float) -> None:
        """End the round trip if the wheels turn by now.

        Args:
            arrivals: what arrived in the period, as for `first_byte`.
            end: end of the period [s].
        """
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
    """Return when the first byte of the newest line of a period arrived [s].

    Args:
        arrivals: pieces of what arrived in the period, with the time of each [s]; a line that began
            earlier counts from the first piece on. Empty where the link doesn't tell.
        end: end of the period [s], which is the answer then.
    """

    def after_line(data: bytes) -> int:
        return max(data.rfind(b"\n"), data.rfind(b"\r")) + 1

    data = b"".join(piece for _, piece in arrivals)
    begin, passed = after_line(data[: after_line(data)].rstrip(b"\r\n")), 0
    for stamp, piece in arrivals:
        passed += len(piece)
        if passed > begin:
            return stamp
    return end
