"""What feedback lines show by themselves: their rate and jitter, and the step of printed speeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.protocol import PRINTED_STEP
from acsar_gym.tools.sysid.board import measure_rate
from acsar_gym.tools.sysid.board_log import BoardTrack, Estimate, Floats

LEAST_RATE_SHARE = 0.002
"""Least half width of the rate's interval, as a share: clocks differ by that much."""
FINEST_QUANTUM = 0.025
"""Smallest step that two decimals show for sure [rad/s]."""
LARGEST_QUANTUM = 2.0
"""Largest step that is looked for [rad/s]."""
FEWEST_SPEEDS = 20
"""Different speeds that are needed, unless fewer can't be multiples of a step by chance."""
ROUNDING_SLACK = 0.001
"""Tolerance on top of the rounding to two decimals [rad/s]."""
SAME_QUANTUM = 0.01
"""Steps that differ by less than this share are one."""
CHANCE_LIMIT = 1e-6
"""Probability below which an explanation isn't luck."""
OUTLIER_SHARE = 0.01
"""Share of numbers that may be off the steps: damaged lines."""


class LineRate(NamedTuple):
    """Rate of feedback lines [Hz], half width of its interval, and their jitter [s]."""

    rate: float
    half: float
    jitter: float


def measure_line_rate(tracks: Sequence[BoardTrack]) -> LineRate:
    """Measure the lines, where a stalled host may have read some late and in bursts.

    The rate is measured as `doctor` measures it, see `measure_rate`.
    """
    slopes, spans = [], []
    for track in tracks:
        if len(track.stamps) > 1:
            slopes.append(measure_rate(track.stamps.tolist(), track.numbers.tolist()))
            spans.append(float(np.ptp(track.stamps)))
    rate = float(np.average(slopes, weights=spans))
    gaps = np.concatenate([np.diff(track.stamps) for track in tracks])
    steps = np.maximum(1.0, np.round(gaps * rate))
    jitter = float(np.std(gaps - steps / rate))
    half = rate * max(LEAST_RATE_SHARE, 2.0 * jitter * rate / max(1.0, len(gaps) - 1.0))
    return LineRate(rate, half, jitter)


def find_quantum(speeds: Floats) -> Estimate | None:
    """Find the largest step of which all speeds are multiples, rounded or cut to two decimals.

    Args:
        speeds: printed [rad/s], any shape.

    Returns:
        The step; None where too few different speeds were seen to tell.
    """
    printed: Floats = np.asarray(np.round(np.abs(speeds[np.isfinite(speeds)]), 2), np.float64)
    values, counts = np.unique(printed[printed > 0.0], return_counts=True)
    if len(values) < 2:
        return None
    shares = counts / counts.sum()
    largest = min(LARGEST_QUANTUM, values.max() / 5.0)
    ratio = 2.0 * ROUNDING_SLACK / values.max()  # so dense that no step is missed
    steps = np.exp(np.arange(math.log(2.0 * PRINTED_STEP), math.log(largest), ratio))
    few = values[np.linspace(0, len(values) - 1, 12).astype(int)]
    fits = np.zeros(len(steps), bool)
    for low, high in ((-PRINTED_STEP / 2.0, PRINTED_STEP / 2.0), (-PRINTED_STEP, 0.0)):
        hopeful = np.flatnonzero(_find_misfits(few, steps, low, high).sum(1) <= 2)
        misfits = _find_misfits(values, steps[hopeful], low, high)
        fits[hopeful] |= misfits @ shares <= OUTLIER_SHARE
    fitting = steps[fits]
    step = float(fitting[-1]) if len(fitting) else PRINTED_STEP
    if len(values) < FEWEST_SPEEDS:
        chance = (PRINTED_STEP + 2.0 * ROUNDING_SLACK) / step  # that a number is a multiple
        if 2.0 * len(steps) * chance ** len(values) > CHANCE_LIMIT:
            return None
    if step < FINEST_QUANTUM:
        return Estimate(PRINTED_STEP, 0.0, FINEST_QUANTUM)
    near = fitting[fitting > 0.98 * step]
    half = ROUNDING_SLACK / 2.0
    return Estimate(float(near.mean()), float(near[0]) - half, float(near[-1]) + half)


def _find_misfits(values: Floats, steps: Floats, low: float, high: float) -> NDArray[np.bool_]:
    """Which values (columns) lie further than low to high from a multiple of each step (rows)."""
    middle, half = (low + high) / 2.0, (high - low) / 2.0 + ROUNDING_SLACK
    shifted = values - middle
    away = shifted - steps[:, None] * np.round(shifted / steps[:, None])
    return np.asarray(np.abs(away) > half)


def count_speed(config: RobotConfig, window: float) -> float:
    """Speed of one encoder count in the averaging window [rad/s]."""
    return 2.0 * math.pi / (config.encoder.counts_per_revolution * window)


def is_explained_by_counts(speeds: Floats, config: RobotConfig, window: float, step: float) -> bool:
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
    counts = count_speed(config, window)
    near = np.round(values / counts) + np.array([[-1.0], [0.0], [1.0]])
    possible = _round_to_step(near * counts, step)
    hit = np.abs(possible - values).min(0) <= PRINTED_STEP / 2.0 + ROUNDING_SLACK
    chance = min(1.0, max(step, PRINTED_STEP) / counts)
    return bool(hit.mean() >= 1.0 - OUTLIER_SHARE and chance ** len(values) < CHANCE_LIMIT)


def mean_printed_speeds(speeds: Floats, counts: float, step: float, cut: float = 0.0) -> Floats:
    """Mean of what is printed for true speeds, given the encoder's counts and the step.

    Args:
        speeds: true mean speeds of windows [rad/s].
        counts: speed of one encoder count [rad/s]; 0 for an encoder without counts.
        step: of the printed numbers [rad/s]; 0 for none.
        cut: step to which speeds are cut towards zero, which `add_cut_half` mends [rad/s]; 0 for
            none.
    """
    if cut > 0.0:
        return add_cut_half(np.trunc(speeds / cut) * cut, cut)
    if counts <= 0.0:
        return _round_to_step(speeds, step)
    whole = np.floor(speeds / counts)
    share = speeds / counts - whole
    low, high = _round_to_step(whole * counts, step), _round_to_step((whole + 1.0) * counts, step)
    return (1.0 - share) * low + share * high


def add_cut_half(speeds: Floats, cut: float) -> Floats:
    """Add the half step that a board which cuts speeds to whole steps loses on average [rad/s]."""
    return speeds + np.sign(speeds) * cut / 2.0


def _round_to_step(speeds: Floats, step: float) -> Floats:
    return step * np.round(speeds / step) if step > 0.0 else speeds
