"""Measured numbers, and how they are measured.

The machine's speed drifts, so whatever is compared runs in alternating blocks and the figures are
medians over the blocks; ratios are medians of the ratios of neighbouring blocks.
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
    """Mean seconds of a call."""
    begin = time.perf_counter()
    for _ in range(times):
        call()
    return (time.perf_counter() - begin) / times


def alternating(
    one: Callable[[], float], other: Callable[[], float], blocks: int, *, of_first: bool = False
) -> tuple[float, float, float]:
    """Medians of two measurements taken in turn, and of the ratio of the second to the first.

    `of_first` turns the ratio round.
    """
    one()
    other()
    pairs = [(one(), other()) for _ in range(blocks)]
    first, second = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratios = [a / b if of_first else b / a for a, b in pairs]
    return first, second, statistics.median(ratios)
