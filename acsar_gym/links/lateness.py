"""How late ticks are, how old feedback is, and how long it takes to answer a command.

All in bounded memory, however long it goes on.

Durations are counted in buckets that are linear within each octave, so a percentile is at most 3 %
too large, and adding one costs less than a microsecond. Extremes and counts are exact.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass
from itertools import accumulate

LATE = 0.001
"""A tick that ends this long after its deadline is late [s]."""

PER_OCTAVE = 32
SHORTEST = 2.0**-20
"""What is shorter, less than a microsecond, counts as zero [s]."""
LONGEST = 64.0
"""What takes this long or longer falls into the last bucket [s]; `worst` still tells how long."""
_FIRST = math.frexp(SHORTEST)[1]
_BUCKETS = (math.frexp(LONGEST)[1] - _FIRST) * PER_OCTAVE + 2


@dataclass(frozen=True, slots=True)
class Spread:
    """Percentiles and the largest of some durations [s]; NaN where there were none."""

    count: int
    p50: float
    p99: float
    worst: float


@dataclass(frozen=True, slots=True)
class Timing:
    """How late the ticks of an episode ended [s]; NaN where there were none."""

    ticks: int
    late_ticks: int
    """Ticks that ended more than a millisecond after their deadline."""
    missed_ticks: int
    """Whole periods that passed without a tick."""
    p50: float
    p99: float
    worst: float

    @property
    def late_share(self) -> float:
        """Late ticks among all; 0 where there were none."""
        return self.late_ticks / self.ticks if self.ticks else 0.0


@dataclass(frozen=True, slots=True)
class EpisodeTiming:
    """How good the timing of an episode was, from the end of its first tick on."""

    lateness: Timing
    feedback_age: Spread
    """Time since the newest valid line, after every tick; 0 where one came in it [s]."""
    round_trip: Spread
    """From a command that sets standing wheels in motion to feedback that says so [s]."""


class Durations:
    """Any number of durations [s]; negative ones count as zero."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget them all."""
        self.count = 0
        self._worst = 0.0
        self._buckets = [0] * _BUCKETS

    def add(self, seconds: float) -> None:
        """Count one."""
        self.count += 1
        self._worst = max(self._worst, seconds)
        if seconds < SHORTEST:
            bucket = 0
        elif seconds < LONGEST:
            fraction, octave = math.frexp(seconds)
            bucket = (octave - _FIRST - 1) * PER_OCTAVE + int(2 * PER_OCTAVE * fraction) + 1
        else:
            bucket = -1
        self._buckets[bucket] += 1

    @property
    def worst(self) -> float:
        """The longest one [s], exactly; NaN where there is none."""
        return self._worst if self.count else math.nan

    def percentile(self, q: float) -> float:
        """The duration [s] that `q` percent don't exceed; NaN where there is none.

        At most 3 % too large, and never too small, but for what counts as zero.
        """
        if not self.count:
            return math.nan
        wanted = max(1, math.ceil(q / 100.0 * self.count))
        bucket = bisect_left(list(accumulate(self._buckets)), wanted)
        return min(_upper_edge(bucket), self._worst)

    def spread(self) -> Spread:
        """What an episode keeps of them."""
        return Spread(self.count, self.percentile(50.0), self.percentile(99.0), self.worst)


class Lateness(Durations):
    """How late each tick ended; `add` is called once a tick.

    `late` counts those over a millisecond, `missed` the whole periods [s] that went by without a
    tick: one that ends 3.5 periods late has missed three.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        super().__init__()

    def reset(self) -> None:
        """Begin anew."""
        super().reset()
        self.late = 0
        self.missed = 0

    def add(self, seconds: float) -> None:
        """A tick ended so long after its deadline."""
        super().add(seconds)
        if seconds > LATE:
            self.late += 1
            if seconds > self._period:
                self.missed += int(seconds / self._period)

    def summary(self) -> Timing:
        """What an episode keeps of them."""
        p50, p99 = self.percentile(50.0), self.percentile(99.0)
        return Timing(self.count, self.late, self.missed, p50, p99, self.worst)


class Stopwatch:
    """Measures one episode."""

    def __init__(self, period: float) -> None:
        self._lateness = Lateness(period)
        self._ages, self._trips = Durations(), Durations()
        self._begun = False
        self._asked: float | None = None

    def tick(self, lateness: float, age: float) -> None:
        """A tick ended so late, with feedback of that age [s]."""
        if self._begun:  # before the first one somebody may have thought for long
            self._lateness.add(lateness)
            self._ages.add(age)
        self._begun = True

    def asked(self, stamp: float, *, drives: bool, turns: bool) -> None:
        """A command goes out at `stamp`; whether it drives, and whether the wheels turn by now."""
        if turns or not drives:
            if turns and self._asked is not None:
                self._trips.add(stamp - self._asked)
            self._asked = None
        elif self._asked is None:
            self._asked = stamp

    def summary(self) -> EpisodeTiming:
        """What an episode keeps of it."""
        return EpisodeTiming(self._lateness.summary(), self._ages.spread(), self._trips.spread())


def _upper_edge(bucket: int) -> float:
    """What no duration in this bucket reaches [s]; infinite for the last one, 0 for the first."""
    if bucket == 0:
        return 0.0
    if bucket == _BUCKETS - 1:
        return math.inf
    octave, part = divmod(bucket - 1, PER_OCTAVE)
    return math.ldexp((PER_OCTAVE + part + 1) / (2 * PER_OCTAVE), _FIRST + octave)
