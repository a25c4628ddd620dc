"""Delays from a command to the feedback line that shows it, and how two samples of them differ."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import require_extra

Floats = NDArray[np.float64]

STEP_HELD = 0.15
"""A command counts as a step if the one before was held at least this long [s]."""
HELD_CHANGE = 0.05
"""Smaller changes of a commanded wheel speed count as held [rad/s]."""
STEP_SHOWN = 0.4
"""Change of a wheel's speed whose time is taken, in the commands and in the lines [rad/s]."""
STEADY_SPREAD = 0.3
"""Steps are left out if the measured speeds varied by more than this before them [rad/s]."""
LONGEST_DELAY = 1.0
"""Steps that no line shows within this time are left out [s]."""
FEWEST_DELAYS = 5
"""Fewest delays on each side for a test."""
DELAY_CONFIDENCE = 0.95
DELAY_RESOLUTION = 0.001
"""Distributions that are nowhere further apart than this count as equal [s]: stamps have jitter."""


def measure_delays(
    command_stamps: Floats, commands: Floats, feedback_stamps: Floats, feedback: Floats
) -> Floats:
    """Measure how long after a step of the command the feedback shows it.

    A step begins after a wheel's speed was held for `HELD`, whatever the other wheels did, and may
    be a ramp; wheels that begin with the same command are one step. Its delay is the time from the
    command in which the first of its wheels has changed by `SHOWN` to the line in which it has, so
    it includes the wire, the board, the motor's start and the wait for the next line.

    Args:
        command_stamps: (n,) times at which command lines were written [s].
        commands: (n, 4) commanded wheel speeds [rad/s].
        feedback_stamps: (k,) times at which feedback lines arrived [s], on the same clock.
        feedback: (k, 4) measured wheel speeds [rad/s].

    Returns:
        (m,) delays [s], one for each row of `steps` with a step; NaN where its wheels weren't
        steady before it, their command changes by less, or no line shows it.
    """
    begun = find_steps(command_stamps, commands)
    found = []
    for begin in np.flatnonzero(begun.any(axis=1)).tolist():
        wheels = begun[begin]
        later = np.flatnonzero(begun[begin + 1 :, wheels].any(axis=1))
        end = begin + 1 + int(later[0]) if len(later) else len(commands)
        asked = np.where(wheels, commands[begin:end] - commands[begin - 1], 0.0)
        passed = np.flatnonzero(np.abs(asked).max(axis=1) >= STEP_SHOWN)
        if not len(passed):
            found.append(math.nan)
            continue
        first = int(passed[0])
        times = command_stamps[begin], command_stamps[begin + first]
        found.append(_delay(times, asked[first], feedback_stamps, feedback))
    return np.array(found, np.float64)


def find_steps(stamps: Floats, commands: Floats) -> NDArray[np.bool_]:
    """Return in which commands each wheel's differs from one held for `HELD` before, (n, 4).

    A log that begins with zeros begins at rest, so these count as held.
    """
    begun = np.zeros(commands.shape, np.bool_)
    if len(stamps) < 2:
        return begun
    for wheel, speeds in enumerate(commands.T):
        changes = np.flatnonzero(np.abs(np.diff(speeds)) > HELD_CHANGE) + 1
        begin = stamps[0] if np.any(commands[0]) else -math.inf
        held = np.diff(stamps[changes], prepend=begin)
        begun[changes[held >= STEP_HELD - 1e-9], wheel] = True
    return begun


def _delay(times: tuple[float, float], asked: Floats, stamps: Floats, speeds: Floats) -> float:
    """Return the delay of one step [s]; NaN if its wheels weren't steady, or never show it.

    Args:
        times: when the command began to change, and when it had changed by `SHOWN` [s].
        asked: (4,) its change at the second time [rad/s]; zero for the other wheels.
        stamps: times of the lines [s].
        speeds: of the lines [rad/s].
    """
    first = int(np.searchsorted(stamps, times[0], side="right"))
    before = speeds[int(np.searchsorted(stamps, times[0] - STEP_HELD)) : first]
    wheels = np.abs(asked) >= STEP_SHOWN
    if not len(before) or np.ptp(before[:, wheels], axis=0).max() > STEADY_SPREAD:
        return math.nan
    last = int(np.searchsorted(stamps, times[1] + LONGEST_DELAY, side="right"))
    moved = ((speeds[first:last] - before[-1]) * np.sign(asked))[:, wheels]
    shown = np.flatnonzero(moved.max(axis=1, initial=0.0) >= STEP_SHOWN)
    return float(stamps[first + shown[0]] - times[1]) if len(shown) else math.nan


@dataclass(frozen=True, slots=True)
class DelayComparison:
    """Two samples of delays, and a test of whether they differ by more than `RESOLUTION`.

    Two one-sided Kolmogorov-Smirnov tests: whether the second sample is later than the first one
    moved by `RESOLUTION`, or earlier than the first one moved the other way.
    """

    counts: tuple[int, int]
    means: tuple[float, float]
    """[s]; NaN for an empty sample."""
    difference: float
    """Mean of the second sample minus that of the first [s]."""
    interval: tuple[float, float]
    """95 % interval of the difference, percentile bootstrap [s]."""
    statistic: float
    """Largest distance of the distribution functions in either test, 0 to 1."""
    p_value: float
    """Of both tests together (Bonferroni); NaN if a sample has under `FEWEST`."""

    @property
    def differs(self) -> bool:
        """Whether the test tells the samples apart at 5 %."""
        return self.p_value < 1.0 - DELAY_CONFIDENCE


def compare_delays(first: Floats, second: Floats) -> DelayComparison:
    """Compare two samples of delays [s]; NaN is left out."""
    first, second = first[np.isfinite(first)], second[np.isfinite(second)]
    counts = (len(first), len(second))
    means = tuple(float(sample.mean()) if len(sample) else math.nan for sample in (first, second))
    difference = means[1] - means[0]
    if min(counts) < FEWEST_DELAYS:
        nothing = (math.nan, math.nan)
        return DelayComparison(
            counts, (means[0], means[1]), difference, nothing, math.nan, math.nan
        )
    with require_extra("a gap report", "scipy"):
        from scipy.stats import ks_2samp  # noqa: PLC0415 - slow to import

    tests = (
        ks_2samp(first + DELAY_RESOLUTION, second, alternative="greater"),
        ks_2samp(first - DELAY_RESOLUTION, second, alternative="less"),
    )
    return DelayComparison(
        counts,
        (means[0], means[1]),
        difference,
        _interval(first, second),
        max(float(test.statistic) for test in tests),
        min(1.0, 2.0 * min(float(test.pvalue) for test in tests)),
    )


def format_lag(difference: float) -> str:
    """Format by how much the second side is later or earlier than the first [s]."""
    return f"{abs(difference) * 1000.0:.1f} ms {'later' if difference > 0.0 else 'earlier'}"


def explain_few_steps(test: DelayComparison) -> str:
    """Say that a test wasn't possible, and what to drive for one."""
    return (
        f"delays: only {min(test.counts)} steps of the command, too few to compare: record speeds "
        "that are held for 0.5 s, then jump by 2 rad/s or more"
    )


def _interval(first: Floats, second: Floats) -> tuple[float, float]:
    """Return the bootstrap interval of the difference of the means [s]."""
    rng = np.random.default_rng(0)
    means = [rng.choice(sample, (2000, len(sample))).mean(axis=1) for sample in (first, second)]
    low, high = np.quantile(
        means[1] - means[0], [(1 - DELAY_CONFIDENCE) / 2, (1 + DELAY_CONFIDENCE) / 2]
    )
    return float(low), float(high)
