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
FINEST = 0.025
"""Smallest step that two decimals show for sure [rad/s]."""
LARGEST = 2.0
"""Largest step that is looked for [rad/s]."""
FEWEST = 20
"""Different speeds that are needed."""
SLACK = 0.001
"""Tolerance on top of the rounding to two decimals [rad/s]."""
ALIKE = 0.01
"""Steps that differ by less than this share are one."""
BY_CHANCE = 1e-6
"""Probability below which an explanation isn't luck."""
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
    printed: Floats = np.round(np.abs(speeds[np.isfinite(speeds)]), 2).astype(np.float64)
    values, counts = np.unique(printed, return_counts=True)
    shares = np.asarray(counts[values > 0.0] / counts[values > 0.0].sum(), np.float64)
    values = np.asarray(values[values > 0.0], np.float64)
    if len(values) < FEWEST:
        return None
    steps = _candidates(values)
    fitting = steps[_fitting(values, shares, steps)]
    if not len(fitting) or fitting[-1] < FINEST:
        return Quantum(PRINTED, 0.0, FINEST)
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


def explained_by_counts(speeds: Floats, config: RobotConfig, window: float, step: float) -> bool:
    """Whether only whole encoder counts, as configured, explain which numbers were printed.

    Args:
        speeds: printed [rad/s], any shape.
        config: of the robot; tells counts_per_revolution.
        window: averaging time of the encoders [s].
        step: to which the board rounds [rad/s].

    Returns:
        False also where any numbers would be explained, as where counts are finer than the step.
    """
    values = np.unique(np.round(np.abs(speeds[np.isfinite(speeds)]), 2))
    counts = of_counts(config, window)
    near = np.round(values / counts) + np.array([[-1.0], [0.0], [1.0]])
    possible = _rounded(near * counts, step)
    hit = np.abs(possible - values).min(0) <= PRINTED / 2.0 + SLACK
    chance = min(1.0, max(step, PRINTED) / counts)
    return bool(hit.mean() >= 1.0 - OUTLIERS and chance ** len(values) < BY_CHANCE)


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
