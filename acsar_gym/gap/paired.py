"""Differences between two sides whose episodes are paired, with 95 % intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.evaluation.metrics import Interval, bootstrap, wilson

NOTHING = (math.nan, math.nan)
FEWEST_PAIRS = 2
"""Fewest pairs that have an interval."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """One metric of two sides. NaN where a side has no value, as for the time of a failure."""

    values: tuple[float, float]
    """Mean or rate of each side."""
    intervals: tuple[Interval, Interval]
    """95 % intervals: Wilson for rates, bootstrap for means."""
    counts: tuple[int, int]
    """Episodes with a value."""
    difference: float
    """Mean difference of the pairs, second minus first."""
    interval: Interval
    """Its 95 % interval."""
    pairs: int
    """Pairs in which both have a value."""

    @property
    def enough(self) -> bool:
        """Whether there are enough pairs to tell a difference."""
        return self.pairs >= FEWEST_PAIRS

    @property
    def differs(self) -> bool:
        """Whether the interval of the difference leaves out zero."""
        return self.interval[0] > 0.0 or self.interval[1] < 0.0


def of_means(
    first: Sequence[float], second: Sequence[float], pairs: Sequence[tuple[float, float]]
) -> Comparison:
    """Compare means of values; those that are NaN are left out.

    Args:
        first: values of the first side.
        second: values of the second side.
        pairs: values of the paired episodes, (first, second).
    """
    known = [(a, b) for a, b in pairs if math.isfinite(a) and math.isfinite(b)]
    differences = [b - a for a, b in known]
    sides = [[value for value in side if math.isfinite(value)] for side in (first, second)]
    means = [_mean(side) for side in sides]
    return Comparison(
        (means[0], means[1]),
        (bootstrap(sides[0]), bootstrap(sides[1])),
        (len(sides[0]), len(sides[1])),
        _mean(differences),
        bootstrap(differences),
        len(known),
    )


def of_rates(
    first: Sequence[float], second: Sequence[float], pairs: Sequence[tuple[float, float]]
) -> Comparison:
    """Compare rates of values that are 0 or 1; arguments as for `of_means`."""
    known = [(a, b) for a, b in pairs if math.isfinite(a) and math.isfinite(b)]
    sides = [[value for value in side if math.isfinite(value)] for side in (first, second)]
    ends = [wilson(round(sum(side)), len(side)) if side else NOTHING for side in sides]
    both = sum(a > 0.5 and b > 0.5 for a, b in known)
    only_first = sum(a > 0.5 > b for a, b in known)
    only_second = sum(b > 0.5 > a for a, b in known)
    neither = len(known) - both - only_first - only_second
    return Comparison(
        (_mean(sides[0]), _mean(sides[1])),
        (ends[0], ends[1]),
        (len(sides[0]), len(sides[1])),
        (only_second - only_first) / len(known) if known else math.nan,
        paired_rates(both, only_first, only_second, neither),
        len(known),
    )


def paired_rates(both: int, only_first: int, only_second: int, neither: int) -> Interval:
    """Return the 95 % interval of the difference of two paired rates, second minus first.

    Newcombe's square-and-add interval of Wilson's (Statistics in Medicine 17, 1998, method 10).
    NaN without pairs.

    Args:
        both: pairs in which both succeed.
        only_first: pairs in which only the first one does.
        only_second: pairs in which only the second one does.
        neither: pairs in which none does.
    """
    count = both + only_first + only_second + neither
    if count == 0:
        return NOTHING
    hits = both + only_second, both + only_first
    (low2, high2), (low1, high1) = (wilson(hit, count) for hit in hits)
    p2, p1 = (hit / count for hit in hits)
    phi = _correlation(both, only_first, only_second, neither)
    down, up = p2 - low2, high2 - p2
    own_down, own_up = p1 - low1, high1 - p1
    below = math.sqrt(max(0.0, down**2 - 2.0 * phi * down * own_up + own_up**2))
    above = math.sqrt(max(0.0, up**2 - 2.0 * phi * up * own_down + own_down**2))
    return p2 - p1 - below, p2 - p1 + above


def _correlation(both: int, only_first: int, only_second: int, neither: int) -> float:
    """Return the correlation of paired outcomes, corrected for continuity as Newcombe does."""
    margins = (both + only_first) * (only_second + neither)
    margins *= (both + only_second) * (only_first + neither)
    if margins == 0:
        return 0.0
    cross = both * neither - only_first * only_second
    count = both + only_first + only_second + neither
    corrected = max(cross - count / 2.0, 0.0) if cross > 0 else float(cross)
    return corrected / math.sqrt(margins)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
