"""How benchmarks measure.

The speed of a machine drifts. So things that are compared run in alternating blocks, figures are
medians over the blocks, and ratios are medians of the ratios of neighbouring blocks.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured number."""

    name: str
    value: float
    unit: str


def each(call: Callable[[], object], times: int) -> float:
    """Return the mean duration of `times` calls [s]."""
    begin = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - begin) / times


def alternating(
    one: Callable[[], float], other: Callable[[], float], blocks: int, *, of_first: bool = False
) -> tuple[float, float, float]:
    """Run two measurements alternately.

    Args:
        one: the first measurement, returns seconds.
        other: the second one.
        blocks: number of pairs, after a warm-up.
        of_first: return the ratio first / second instead of second / first.

    Returns:
        Medians of both, and the median of the ratios.
    """
    one()
    other()
    pairs = [(one(), other()) for _ in range(blocks)]
    first, second = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratios = [a / b if of_first else b / a for a, b in pairs]
    return first, second, statistics.median(ratios)
