"""Rate and jitter of the feedback lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.identification.tracks import Track

LEAST_SHARE = 0.002
"""Least half width of the rate's interval, as a share: clocks differ by that much."""


@dataclass(frozen=True)
class Lines:
    """Rate of feedback lines [Hz], half width of its interval, and their jitter [s]."""

    rate: float
    half: float
    jitter: float


def measured(tracks: Sequence[Track]) -> Lines:
    """Measure the lines; one that was lost counts as sent.

    Args:
        tracks: at least one with two lines.
    """
    gaps = np.concatenate([np.diff(track.stamps) for track in tracks])
    period = float(np.median(gaps))
    for _ in range(5):  # a board whose loops don't divide the period sends at two intervals
        steps = np.maximum(1.0, np.round(gaps / period))
        period = float(gaps.sum() / steps.sum())
    jitter = float(np.std(gaps - steps * period))
    rate = 1.0 / period
    half = rate * max(LEAST_SHARE, 2.0 * jitter * rate / max(1.0, len(gaps) - 1.0))
    return Lines(rate, half, jitter)
