"""Statistics over few training seeds and many scenes, after Agarwal et al. 2021.

"Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021. Scores are
matrices (seeds, scenes): a row for each trained policy of an agent, a column for each scene. An
agent without training has one row.

The bootstrap is stratified: every matrix of a list, one for each id, is resampled on its own. In
each, seeds are resampled, and scenes too (their `task_bootstrap`), because the scenes are a sample
of what a generator makes. A drawn seed keeps its scores in all drawn scenes: one trained policy
drove them all, so its scores aren't independent of each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Interval = tuple[float, float]
Statistic = Callable[[Sequence[Floats]], float]
"""Computes a figure from matrices of scores."""

CONFIDENCE = 0.95
RESAMPLES = 2000
"""Bootstrap samples of an interval; their seed is fixed, so equal scores give equal intervals."""
TAUS = tuple(np.linspace(0.0, 1.0, 21).round(2).tolist())
"""Thresholds of performance profiles."""


def interquartile_mean(scores: ArrayLike | Sequence[Floats]) -> float:
    """Return the mean of the middle half of all scores, a 25 % trimmed mean; NaN without any.

    Args:
        scores: one matrix of any shape, or a list of matrices, whose scores are put together.
    """
    flat = np.sort(_flat(scores))
    cut = len(flat) // 4
    return float(flat[cut : len(flat) - cut].mean()) if len(flat) else float("nan")


def mean(scores: ArrayLike | Sequence[Floats]) -> float:
    """Return the mean of all scores; NaN without any."""
    flat = _flat(scores)
    return float(flat.mean()) if len(flat) else float("nan")


def _flat(scores: Any) -> Floats:
    """All scores of a matrix, or of a list of matrices, as one row."""
    if isinstance(scores, list | tuple) and scores and isinstance(scores[0], np.ndarray):
        return np.concatenate([np.ravel(each) for each in scores])
    return np.ravel(np.asarray(scores, np.float64))


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Return the probability that a run of X scores more than a run of Y in the same scene.

    The mean over scenes of the Mann-Whitney U statistic divided by the number of pairs; equal
    scores count half.

    Args:
        x: (seeds of X, scenes).
        y: (seeds of Y, scenes), of the same scenes.
    """
    ours, others = np.asarray(x, np.float64)[:, None], np.asarray(y, np.float64)[None]
    return float(((ours > others) + 0.5 * (ours == others)).mean())


def performance_profile(scores: ArrayLike, taus: Sequence[float] = TAUS) -> list[float]:
    """Return the share of runs, over seeds and scenes, whose score is above each threshold."""
    flat = np.asarray(scores, np.float64).ravel()
    return [float((flat > tau).mean()) for tau in taus]


def interval(
    scores: Sequence[Floats],
    statistic: Statistic = interquartile_mean,
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Return the 95 % percentile interval of a statistic, by the stratified bootstrap.

    Args:
        scores: a matrix (seeds, scenes) for each id.
        statistic: of such a list.
        resamples: bootstrap samples.
        seed: of the resampling.

    Returns:
        Low and high end.
    """
    rng = np.random.default_rng(seed)
    found = [statistic([resampled(each, rng) for each in scores]) for _ in range(resamples)]
    return _percentiles(found)


def improvement_interval(
    x: Floats, y: Floats, *, resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Return the 95 % interval of `probability_of_improvement`.

    Seeds of X and Y are resampled apart, the scenes together, as both drove the same ones.
    """
    rng = np.random.default_rng(seed)
    ours, others = np.asarray(x)[:, None], np.asarray(y)[None]
    better = (ours > others) + 0.5 * (ours == others)  # (seeds of X, seeds of Y, scenes)
    found = [
        float(better[np.ix_(*(_drawn(count, rng) for count in better.shape))].mean())
        for _ in range(resamples)
    ]
    return _percentiles(found)


def resampled(scores: Floats, rng: np.random.Generator) -> Floats:
    """Draw as many seeds and scenes as there are, with replacement."""
    drawn: Floats = scores[np.ix_(*(_drawn(count, rng) for count in scores.shape))]
    return drawn


def _drawn(count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw `count` indices with replacement."""
    return rng.integers(count, size=count)


def _percentiles(values: Sequence[float]) -> Interval:
    """The middle 95 % of some values."""
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)


def apart(one: Interval, other: Interval) -> bool:
    """Whether two intervals have no point in common."""
    return one[1] < other[0] or other[1] < one[0]
