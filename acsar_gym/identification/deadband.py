"""Deadbands: the cost of each candidate, since the answer jumps where a set point crosses one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.identification.problem import Problem
from acsar_gym.identification.quantum import printed_mean
from acsar_gym.identification.response import Clock, Wheel

Floats = NDArray[np.float64]

GRID = 0.01
"""Distance of the candidates, and least half width of an interval [rad/s]."""
CORRELATED = 2.0
"""Neighbouring residuals that count as one."""
MOST = 2.0
"""Largest candidate [rad/s]."""
EVIDENCE = 60.0
"""Excess cost, in typical losses of a reading, from which a value clearly fits worse."""
SPREAD = 2.5
"""Standard deviations in half an interval."""


@dataclass(frozen=True)
class Printed:
    """How a board rounds speeds: see `quantum.printed_mean`."""

    counts: float
    step: float


@dataclass(frozen=True)
class Deadband:
    """A deadband and its 95 % interval [rad/s]."""

    value: float
    low: float
    high: float


def found(
    problem: Problem,
    index: int,
    motor: Wheel,
    clock: Clock,
    printed: Printed,
    usual: float | None = None,
) -> Deadband:
    """Find the deadband of one wheel, with its other parameters given.

    Args:
        problem: the tracks.
        index: of the wheel in the problem.
        motor: the wheel's parameters; its deadband isn't used.
        clock: the board's times.
        printed: how speeds are rounded.
        usual: for a log that can't tell: the value to stay at, unless it clearly fits worse.
    """
    bands = np.append(np.arange(0.0, MOST + GRID, GRID), usual or 0.0)
    measured = problem.measured(index)
    costs = np.array(
        [_losses(problem, index, motor, clock, printed, measured, band) for band in bands]
    )
    total = costs.sum(1)
    excess = total - total.min()
    typical = max(float(total.min()) / len(measured), 1e-6)
    if usual is not None and excess[-1] < EVIDENCE * typical:
        return Deadband(usual, 0.0, math.inf)
    weights = np.exp(-excess / (2.0 * CORRELATED * typical))
    weights /= weights.sum()
    value = float(weights @ bands)
    half = SPREAD * math.sqrt(float(weights @ (bands - value) ** 2)) + GRID
    return Deadband(value, max(0.0, value - half), value + half)


def _losses(
    problem: Problem,
    index: int,
    motor: Wheel,
    clock: Clock,
    printed: Printed,
    measured: Floats,
    band: float,
) -> Floats:
    """Losses of all readings for one candidate, linear for large residuals."""
    rest = problem.residuals_of(index, motor._replace(deadband=float(band)), clock)
    expected = printed_mean(rest + measured, printed.counts, printed.step)
    rest = np.abs(expected - measured)
    return np.where(rest < 0.2, rest**2, 0.4 * rest - 0.04)
