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

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Interval = tuple[float, float]
Statistic = Callable[[Floats], Floats]
"""Maps rows of scores (..., n) to one figure a row (...)."""

CONFIDENCE = 0.95
RESAMPLES = 2000
"""Bootstrap samples of an interval; their seed is fixed, so equal scores give equal intervals."""
AT_ONCE = 4_000_000
"""Scores that are resampled at once, at most; limits the memory."""
TAUS = tuple(np.linspace(0.0, 1.0, 21).round(2).tolist())
"""Thresholds of performance profiles."""


def iqm(rows: Floats) -> Floats:
    """Return the mean of the middle half of each row, a 25 % trimmed mean.

    Args:
        rows: (..., n), with n of at least one.
    """
    count = rows.shape[-1]
    cut = count // 4
    trimmed: Floats = np.sort(rows, axis=-1)[..., cut : count - cut].mean(axis=-1)
    return trimmed


def mean(rows: Floats) -> Floats:
    """Return the mean of each row (..., n)."""
    means: Floats = rows.mean(axis=-1)
    return means


def overall(scores: Sequence[Floats], statistic: Statistic = iqm) -> float:
    """Return a statistic of all scores of some matrices, put together.

    Args:
        scores: a matrix (seeds, scenes) for each id.
        statistic: `iqm` or `mean`.
    """
    return float(statistic(np.concatenate([np.ravel(each) for each in scores])))


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Return the probability that a run of X scores more than a run of Y in the same scene.

    The mean over scenes of the Mann-Whitney U statistic divided by the number of pairs; equal
    scores count half.

    Args:
        x: (seeds of X, scenes).
        y: (seeds of Y, scenes), of the same scenes.
    """
    return float(_better(x, y).mean())


def _better(x: ArrayLike, y: ArrayLike) -> Floats:
    """(seeds of X, seeds of Y, scenes): 1 where X scores more, 0.5 where both are equal."""
    ours, others = np.asarray(x, np.float64)[:, None], np.asarray(y, np.float64)[None]
    better: Floats = (ours > others) + 0.5 * (ours == others)
    return better


def performance_profile(scores: ArrayLike, taus: Sequence[float] = TAUS) -> list[float]:
    """Return the share of runs, over seeds and scenes, whose score is above each threshold."""
    flat = np.asarray(scores, np.float64).ravel()
    return [float((flat > tau).mean()) for tau in taus]


def interval(
    scores: Sequence[Floats],
    statistic: Statistic = iqm,
    *,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Return the 95 % percentile interval of a statistic, by the stratified bootstrap.

    Args:
        scores: a matrix (seeds, scenes) for each id.
        statistic: of rows with all scores.
        resamples: bootstrap samples.
        seed: of the resampling.

    Returns:
        Low and high end.
    """
    rng = np.random.default_rng(seed)
    chunk = max(1, AT_ONCE // sum(each.size for each in scores))
    found = [
        statistic(np.concatenate([_resampled(each, count, rng) for each in scores], axis=1))
        for count in _chunks(resamples, chunk)
    ]
    return _percentiles(np.concatenate(found))


def _chunks(total: int, most: int) -> list[int]:
    """Cut a number into parts of at most `most`."""
    whole, rest = divmod(total, most)
    return [most] * whole + ([rest] if rest else [])


def _resampled(scores: Floats, count: int, rng: np.random.Generator) -> Floats:
    """(count, seeds * scenes): draw as many seeds and scenes as there are, with replacement."""
    seeds, scenes = (rng.integers(size, size=(count, size)) for size in scores.shape)
    return scores[seeds[:, :, None], scenes[:, None, :]].reshape(count, -1)


def improvement_interval(
    x: Floats, y: Floats, *, resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Return the 95 % interval of `probability_of_improvement`.

    Seeds of X and Y are resampled apart, the scenes together, as both drove the same ones.
    """
    rng = np.random.default_rng(seed)
    better = _better(x, y)
    ours, others, scenes = (
        rng.multinomial(size, np.full(size, 1.0 / size), resamples) / size for size in better.shape
    )  # how often each was drawn, as shares
    return _percentiles(np.einsum("ri,rj,rk,ijk->r", ours, others, scenes, better, optimize=True))


def _percentiles(values: Floats) -> Interval:
    """The middle 95 % of some values."""
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)


def apart(one: Interval, other: Interval) -> bool:
    """Whether two intervals have no point in common."""
    return one[1] < other[0] or other[1] < one[0]
