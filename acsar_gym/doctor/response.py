"""Measures when a board obeys: from a command to its first effect, and its command time-out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean, median_low

from acsar_gym.doctor.listening import Ear, Line
from acsar_gym.doctor.spinning import STANDS, stand
from acsar_gym.protocol import ZERO, Speeds

TRIALS = 5
"""Commands whose first effect is timed, at different phases of the board's clock."""
NOISE = 0.05
"""Smallest speed that shows an effect, as a share of the commanded one."""
QUIET = 0.3
"""How long encoders must report zero before a command is timed [s]."""
EPSILON = 0.005
"""Mean speeds below this are zero [rad/s]; lines have two decimals."""
CALM = 1.2
"""Longest wait for that [s]; some encoders never do."""
JITTER = 0.005
"""How much delays differ apart from the phase of the feedback [s]."""
EFFECT = 1.0
"""Longest wait for an effect [s]."""
LEVEL = 0.75
"""Falling speeds are compared at this share of the steady speed."""
STEADY = 0.02
"""A speed is steady where it changes by less than this share from one window to the next."""
WINDOW = 0.2
"""Length of those windows [s]."""
PATIENCE = 3.0
"""Longest wait for a steady speed, or for a time-out [s]."""


@dataclass(frozen=True)
class Delays:
    """Times from a command's last byte to the first byte of the line that shows its effect [s].

    Attributes:
        shortest: without the wait for the next line.
        longest: with all of it.
    """

    shortest: float
    longest: float


@dataclass(frozen=True)
class TimeOut:
    """How the wheels stop when commands stop.

    Attributes:
        after: the board's command time-out [s].
        standing: when the wheels stand, counted from the newest command [s]; None if unseen.
    """

    after: float
    standing: float | None


class Together:
    """Commands all letters that answer, and reads their mean speed.

    Args:
        ear: hears the board.
        motors: indices of the letters to command.
        encoders: indices of the letters that answer.
        speed: to command [rad/s].
    """

    def __init__(
        self, ear: Ear, motors: Iterable[int], encoders: Iterable[int], speed: float
    ) -> None:
        letters = set(motors)
        a, b, c, d = (speed if number in letters else 0.0 for number in range(4))
        self._command: Speeds = (a, b, c, d)
        self._encoders = tuple(encoders)
        self._ear, self._speed = ear, speed

    def _mean(self, line: Line) -> float:
        return fmean(abs(line.speeds[k]) for k in self._encoders)

    def delays(self, rate: float) -> Delays | None:
        """Time a few commands, the first one only to warm up.

        Args:
            rate: lines that the board sends per second [Hz].

        Returns:
            The delays; None where a command had no effect.
        """
        ear, found = self._ear, []
        for trial in range(TRIALS + 1):
            noise = self._quiet()
            ear.hear(None, lambda _: True, EFFECT)
            ear.pause(trial / (TRIALS * rate))
            delay = self._effect(max(EPSILON, 2.0 * noise))
            if delay is None:
                return None
            found.append(delay)
        stand(ear, self._speed)
        return _delays(found[1:], 1.0 / rate)

    def _quiet(self) -> float:
        """Wait until the encoders report nothing; returns the mean speed that remains [rad/s]."""
        stand(self._ear, self._speed)
        lines: list[Line] = []

        def quiet(line: Line) -> bool:
            lines.append(line)
            newest = self._since(lines, line.stamp - QUIET)
            return lines[0].stamp < line.stamp - QUIET and max(newest) < EPSILON

        self._ear.hear(ZERO, quiet, CALM)
        return max(self._since(lines, lines[-1].stamp - QUIET)) if lines else 0.0

    def _effect(self, level: float) -> float | None:
        """Send one command; return the time until the mean speed exceeds a level [s]."""
        ear = self._ear
        ear.command(self._command)
        sent = ear.sent
        lines = ear.hear(None, lambda line: self._mean(line) > level, EFFECT)
        if not lines or self._mean(lines[-1]) <= level:
            return None
        return max(lines[-1].begin - sent, 0.0)

    def time_out(self) -> TimeOut | None:
        """Let the wheels turn steadily, stop commanding, and compare with a commanded stop.

        Both falls have the same delay and the same shape, so their difference is the time-out.

        Returns:
            The time-out; None where the wheels keep turning.
        """
        ear = self._ear
        steady, newest = self._steady()
        ear.command(ZERO)
        stop = ear.sent
        lines = ear.hear(ZERO, self._below(0.5 * steady), PATIENCE)
        commanded = self._crossing([*newest, *lines], LEVEL * steady)
        stand(ear, self._speed)
        steady, newest = self._steady()
        last = ear.sent
        lines = ear.hear(None, self._below(STANDS * self._speed), PATIENCE)
        by_itself = self._crossing([*newest, *lines], LEVEL * steady)
        stand(ear, self._speed)
        if commanded is None or by_itself is None:
            return None
        stood = self._mean(lines[-1]) < STANDS * self._speed
        after = (by_itself - last) - (commanded - stop)
        return TimeOut(max(after, 0.0), lines[-1].stamp - last if stood else None)

    def _below(self, level: float) -> Callable[[Line], bool]:
        """Return a condition on lines [rad/s]."""
        return lambda line: self._mean(line) < level

    def _steady(self) -> tuple[float, list[Line]]:
        """Turn the wheels until their speed is steady; returns it [rad/s], and the newest line."""
        lines: list[Line] = []

        def steady(line: Line) -> bool:
            lines.append(line)
            newest = self._window(lines, line.stamp)
            before = self._window(lines, line.stamp - WINDOW)
            if not newest or not before or lines[0].stamp > line.stamp - 2.0 * WINDOW:
                return False
            change = fmean(newest) - fmean(before)
            return fmean(newest) > NOISE * self._speed and abs(change) < STEADY * self._speed

        self._ear.hear(self._command, steady, PATIENCE)
        speed = fmean(self._window(lines, lines[-1].stamp)) if lines else 0.0
        return speed, lines[-1:]

    def _since(self, lines: Sequence[Line], begin: float) -> list[float]:
        """Return the mean speeds of the lines since then [rad/s]."""
        return [self._mean(line) for line in lines if line.stamp > begin]

    def _window(self, lines: Sequence[Line], end: float) -> list[float]:
        """Return the mean speeds of the lines in a window that ends then [rad/s]."""
        return [self._mean(one) for one in lines if end - WINDOW < one.stamp <= end]

    def _crossing(self, lines: Sequence[Line], level: float) -> float | None:
        """Return when the mean speed fell below a level, between two lines [s]."""
        for before, after in pairwise(lines):
            high, low = self._mean(before), self._mean(after)
            if low < level <= high:
                share = (high - level) / (high - low)
                return before.stamp + share * (after.stamp - before.stamp)
        return None


def _delays(found: Sequence[float], period: float) -> Delays:
    """Leave out wheels that still crept from an earlier command: all others lie in one period."""
    usual = median_low(found)  # one of them, so that it is near itself
    near = [delay for delay in found if abs(delay - usual) <= period + JITTER]
    return Delays(min(near), max(near))
