"""Statistics of an episode's timing: late ticks, age of feedback, round trips."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.config import RobotConfig

STANDSTILL = 0.1  # wheels slower than this count as being at rest [rad/s]
VISIBLE_SPEED = 0.005  # a faster wheel, which was at rest before, shows the command [rad/s]
MAX_TICKS = 1_000_000  # ticks that percentiles refer to, the newest: 2.8 h at 100 Hz
MAX_TRIPS = 1000  # round trips of an episode that are kept


@dataclass(frozen=True, slots=True)
class TickTiming:
    """Lateness of the ticks of an episode [s]. NaN if there were none."""

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
        """Share of late ticks. 0 if there were no ticks."""
        return self.late_ticks / self.ticks if self.ticks else 0.0


@dataclass(frozen=True, slots=True)
class EpisodeTiming:
    """Timing of an episode, from the end of its first tick on."""

    lateness: TickTiming
    worst_feedback_age: float
    """Largest age of the newest valid line at the end of a tick [s]. NaN if there were none."""
    round_trips: tuple[float, ...] = ()
    """Times from the last byte of a command to wheels at rest until the first byte of the first
    line that shows an effect [s], the newest `MAX_TRIPS`. Up to a tick longer if the link doesn't
    report when bytes arrive."""


class EpisodeStopwatch:
    """Measures the timing of one episode."""

    def __init__(self, config: RobotConfig) -> None:
        self._period = config.period
        self._late_limit = config.late_tick
        self._ticks = self._late_ticks = self._missed_ticks = 0
        self._lateness: deque[float] = deque(maxlen=MAX_TICKS)
        self._worst_lateness = self._worst_age = 0.0
        self._trips: deque[float] = deque(maxlen=MAX_TRIPS)
        self._has_started = False
        self._trip_start: float | None = None
        self._fastest = 0.0
        self._visible_speed = VISIBLE_SPEED

    def tick(self, lateness: float, age: float) -> float | None:
        """Add a tick: its lateness and its feedback's age [s].

        Returns:
            The lateness. None for the first tick, whose deadline is the reset's.
        """
        # The first deadline is that of the reset, which may take long.
        if not self._has_started:
            self._has_started = True
            return None

        self._ticks += 1
        self._lateness.append(max(lateness, 0.0))
        self._worst_lateness = max(lateness, self._worst_lateness)
        self._worst_age = max(age, self._worst_age)
        if lateness > self._late_limit:
            self._late_ticks += 1
            # Deadlines that have passed meanwhile had no tick.
            if lateness > self._period:
                self._missed_ticks += int(lateness / self._period)
        return lateness

    def commanded(self, written: float, fastest: float, *, drives: bool) -> bool:
        """Add a command, and the fastest wheel in the feedback of its period.

        Args:
            written: When the command's last byte was written [s].
            fastest: Highest absolute wheel speed [rad/s].
            drives: Whether the command turns wheels.

        Returns:
            Whether a command to wheels at rest has no visible effect yet: then call `heard`.
        """
        # Only wheels at rest show when a command has an effect.
        if not drives:
            self._trip_start = None
        elif self._trip_start is None and self._fastest < STANDSTILL:
            self._trip_start = written
            # Noise of wheels at rest isn't an effect.
            self._visible_speed = max(VISIBLE_SPEED, 2.0 * self._fastest)
        self._fastest = fastest
        return self._trip_start is not None

    def heard(self, arrivals: Sequence[tuple[float, bytes]], end: float) -> None:
        """End the round trip if the wheels turn by now. `end` is that of the period [s]."""
        if self._trip_start is not None and self._fastest > self._visible_speed:
            self._trips.append(first_byte(arrivals, end) - self._trip_start)
            self._trip_start = None

    def summary(self) -> EpisodeTiming:
        """Return the timing of the episode."""
        p50 = p99 = worst = age = math.nan
        if self._ticks:
            p50, p99 = np.percentile(self._lateness, [50.0, 99.0], method="inverted_cdf").tolist()
            worst = self._worst_lateness
            age = self._worst_age

        lateness = TickTiming(
            ticks=self._ticks,
            late_ticks=self._late_ticks,
            missed_ticks=self._missed_ticks,
            p50=p50,
            p99=p99,
            worst=worst,
        )
        return EpisodeTiming(lateness, age, tuple(self._trips))


def first_byte(arrivals: Sequence[tuple[float, bytes]], end: float) -> float:
    """Return when the first byte of the newest line of a period arrived [s]."""
    # The newest whole line, which may have come in several pieces.
    data = b"".join(piece for _, piece in arrivals)
    newest = _after_last_line(data[: _after_last_line(data)].rstrip(b"\r\n"))

    length = 0
    for stamp, piece in arrivals:
        length += len(piece)
        if length > newest:
            return stamp
    return end


def _after_last_line(data: bytes) -> int:
    """Index of the byte after the last line end. 0 if there is no line end."""
    return max(data.rfind(b"\n"), data.rfind(b"\r")) + 1
