"""Rate and jitter of the feedback lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import optional
from acsar_gym.identification.tracks import Track

with optional("identification", "scipy"):
    from scipy import stats

Floats = NDArray[np.float64]

LEAST_SHARE = 0.002
"""Least half width of the rate's interval, as a share: clocks differ by that much."""

MOST_LINES = 400
"""Lines of a log between which slopes are computed."""


@dataclass(frozen=True)
class Lines:
    """Rate of feedback lines [Hz], half width of its interval, and their jitter [s]."""

    rate: float
    half: float
    jitter: float


def measured(tracks: Sequence[Track]) -> Lines:
    """Measure the lines, where a stalled host may have read some late and in bursts.

    The rate is the Theil-Sen slope of the lines' numbers over their times, whatever a few pauses,
    bursts or lost lines do to the intervals between them.

    Args:
        tracks: at least one with two lines.
    """
    slopes = [_slope(track) for track in tracks if len(track.stamps) > 1]
    spans = [float(np.ptp(track.stamps)) for track in tracks if len(track.stamps) > 1]
    rate = float(np.average(slopes, weights=spans))
    gaps = np.concatenate([np.diff(track.stamps) for track in tracks])
    steps = np.maximum(1.0, np.round(gaps * rate))
    jitter = float(np.std(gaps - steps / rate))
    half = rate * max(LEAST_SHARE, 2.0 * jitter * rate / max(1.0, len(gaps) - 1.0))
    return Lines(rate, half, jitter)


def _slope(track: Track) -> float:
    """Lines per second, of evenly chosen lines."""
    chosen = np.unique(np.linspace(0, len(track.stamps) - 1, MOST_LINES).astype(np.intp))
    return float(stats.theilslopes(track.numbers[chosen], track.stamps[chosen]).slope)
