"""The resolution of the printed speeds: the step of which all of them are multiples."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig

Floats = NDArray[np.float64]

PRINTED = 0.01
"""Resolution of the protocol's numbers [rad/s]."""
LARGEST = 2.0
"""Largest step that is looked for [rad/s]."""
FEWEST = 20
"""Different speeds that are needed."""
SLACK = 0.001
"""Tolerance on top of the rounding to two decimals [rad/s]."""
OUTLIERS = 0.01
"""Share of numbers that may be off the steps: damaged lines."""


@dataclass(frozen=True)
class Quantum:
    """The step of the printed speeds.

    Attributes:
        step: [rad/s].
        low: end of the interval in which it lies [rad/s].
        high: other end [rad/s].
    """

    step: float
    low: float
    high: float


def found(speeds: Floats) -> Quantum | None:
    """Find the largest step of which all speeds are multiples, rounded to two decimals.

    Args:
        speeds: printed [rad/s], any shape.

    Returns:
        The step; None where too few different speeds were seen.
    """
    values, counts = np.unique(np.round(np.abs(speeds[np.isfinite(speeds)]), 2), return_counts=True)
    values, shares = values[values > 0.0], counts[values > 0.0] / counts[values > 0.0].sum()
    if len(values) < FEWEST:
        return None
    steps = _candidates(values)
    fitting = steps[_fitting(values, shares, steps)]
    if not len(fitting) or fitting[-1] < 2.1 * PRINTED:
        return Quantum(PRINTED, 0.0, 2.1 * PRINTED)
    near = fitting[fitting > 0.98 * fitting[-1]]
    return Quantum(float(near.mean()), float(near[0]) - SLACK / 2.0, float(near[-1]) + SLACK / 2.0)


def _candidates(values: Floats) -> Floats:
    """Steps from twice the printed resolution on, so dense that none is missed."""
    ratio = 2.0 * SLACK / values.max()
    largest = min(LARGEST, values.max() / 5.0)
    return np.exp(np.arange(math.log(2.0 * PRINTED), math.log(largest), ratio))


def _fitting(values: Floats, shares: Floats, steps: Floats) -> NDArray[np.bool_]:
    """Whether the values are multiples of each step, rounded, or cut to two decimals."""
    few = np.linspace(0, len(values) - 1, 12).astype(int)
    fitting = np.zeros(len(steps), bool)
    for low, high in ((-PRINTED / 2.0, PRINTED / 2.0), (-PRINTED, 0.0)):
        hopeful = np.flatnonzero(_off(values[few], steps, low, high).sum(1) <= 2)
        off = _off(values, steps[hopeful], low, high)
        fitting[hopeful] |= off @ shares <= OUTLIERS
    return fitting


def _off(values: Floats, steps: Floats, low: float, high: float) -> NDArray[np.bool_]:
    """Which values (columns) lie further than low to high from a multiple of each step (rows)."""
    middle, half = (low + high) / 2.0, (high - low) / 2.0 + SLACK
    shifted = values - middle
    away = shifted - steps[:, None] * np.round(shifted / steps[:, None])
    return np.asarray(np.abs(away) > half)


def of_counts(config: RobotConfig, window: float) -> float:
    """Speed of one encoder count in the averaging window [rad/s]."""
    return 2.0 * math.pi / (config.encoder.counts_per_revolution * window)


def explained_by_counts(speeds: Floats, config: RobotConfig, window: float) -> bool:
    """Whether the printed speeds are those of whole encoder counts, as configured."""
    values = np.unique(np.round(np.abs(speeds[np.isfinite(speeds)]), 2))
    step = of_counts(config, window)
    off = np.abs(values - step * np.round(values / step))
    return bool(np.mean(off > PRINTED / 2.0 + SLACK) <= OUTLIERS)


def printed_mean(speeds: Floats, counts: float, step: float) -> Floats:
    """Mean of what is printed for true speeds, given the encoder's counts and the step.

    Args:
        speeds: true mean speeds of windows [rad/s].
        counts: speed of one encoder count [rad/s]; 0 for an encoder without counts.
        step: of the printed numbers [rad/s]; 0 for none.
    """
    if counts <= 0.0:
        return _rounded(speeds, step)
    whole = np.floor(speeds / counts)
    share = speeds / counts - whole
    low, high = _rounded(whole * counts, step), _rounded((whole + 1.0) * counts, step)
    return (1.0 - share) * low + share * high


def _rounded(speeds: Floats, step: float) -> Floats:
    return step * np.round(speeds / step) if step > 0.0 else speeds
