"""Robust least squares: a coarse search for the start, then scipy, and intervals from blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

from acsar_gym.identification.problem import HIGH, LOW, Problem
from acsar_gym.identification.response import Clock, Wheel

Floats = NDArray[np.float64]

DELAYS = np.arange(-0.01, 0.2, 0.01)
LAGS = (0.02, 0.05, 0.1, 0.2, 0.4)
SLOWNESSES = (0.003, 0.02, 0.05)
"""Values of the coarse search."""
DELAY_BOUNDS = (-0.03, 0.5)
WINDOW_BOUNDS = (0.0, 0.4)
"""Bounds of delay and averaging time [s]; the shortest window is a loop."""
LEAST_SCALE = 0.02
"""Least residual at which the loss becomes linear [rad/s]."""
LEVEL = 0.95
ROUNDS = 3
"""How often smooth parameters and deadbands are fitted in turn, at most."""


@dataclass(frozen=True, eq=False)
class Solution:
    """A fit.

    Attributes:
        x: parameters, as `Problem` orders them.
        deadbands: of the wheels [rad/s].
        free: which parameters were fitted.
        scale: residual at which the loss becomes linear [rad/s].
        half: half widths of the 95 % intervals.
    """

    x: Floats
    deadbands: tuple[float, ...]
    free: NDArray[np.bool_]
    scale: float
    half: Floats


def coarse(problem: Problem, deadbands: Sequence[float], window: float, timeout: float) -> Floats:
    """Search the start of a fit on a grid.

    Args:
        problem: to solve.
        deadbands: of the wheels [rad/s].
        window: averaging time to begin with [s].
        timeout: time-out to begin with [s].
    """
    clocks = [Clock(float(delay), window, timeout) for delay in DELAYS]
    best: list[list[tuple[float, Wheel]]] = []
    for k, band in enumerate(deadbands):
        best.append([_best_wheel(problem, k, band, clock) for clock in clocks])
    costs = [sum(rows[d][0] for rows in best) for d in range(len(clocks))]
    d = int(np.argmin(costs))
    return problem.joined([rows[d][1] for rows in best], clocks[d])


def _best_wheel(problem: Problem, k: int, band: float, clock: Clock) -> tuple[float, Wheel]:
    """Cost and motor of the best lag and ramp for one wheel and clock; its gain is linear."""
    found = (math.inf, Wheel(LAGS[2], 1.0, 0.0, band))
    for lag in LAGS:
        for slowness in SLOWNESSES:
            motor = Wheel(lag, 1.0, slowness, band)
            measured = problem.measured(k)
            answer = problem.residuals_of(k, motor, clock) + measured
            gain = float(answer @ measured / max(answer @ answer, 1e-9))
            cost = float(np.abs(gain * answer - measured).sum())
            found = min(found, (cost, motor._replace(gain=gain)))
    return found


def solve(problem: Problem, x: Floats, deadbands: Sequence[float], free: list[bool]) -> Solution:
    """Fit the free parameters, beginning at `x`.

    Args:
        problem: to solve.
        x: start.
        deadbands: of the wheels, which stay [rad/s].
        free: which parameters may move.
    """
    bands, mask = tuple(deadbands), np.array(free)
    low, high = _bounds(problem)
    x = np.clip(x, low, high)
    for _ in range(2):
        rest = problem.residuals(x, bands)
        scale = max(LEAST_SCALE, 1.5 * float(np.median(np.abs(rest))))

        def full(part: Floats, whole: Floats = x) -> Floats:
            moved = whole.copy()
            moved[mask] = part
            return moved

        result = optimize.least_squares(
            lambda part: problem.residuals(full(part), bands),
            np.clip(x[mask], low[mask] + 1e-9, high[mask] - 1e-9),
            jac=lambda part: problem.jacobian(full(part), bands)[:, mask],
            bounds=(low[mask], high[mask]),
            loss="soft_l1",
            f_scale=scale,
            x_scale="jac",
            max_nfev=30,
        )
        x = full(result.x)
    solution = Solution(x, bands, mask, scale, np.zeros(len(x)))
    return replace(solution, half=half_widths(problem, solution))


def _bounds(problem: Problem) -> tuple[Floats, Floats]:
    """Lower and upper bounds of the parameters."""
    n = len(problem.wheels)
    window = max(problem.dt, WINDOW_BOUNDS[0])
    low = np.concatenate((np.tile(LOW, n), [DELAY_BOUNDS[0], window, 0.02]))
    high = np.concatenate((np.tile(HIGH, n), [DELAY_BOUNDS[1], WINDOW_BOUNDS[1], 3600.0]))
    return low, high


def half_widths(problem: Problem, solution: Solution) -> Floats:
    """Half widths of the 95 % intervals, with residuals that depend on each other in blocks.

    Residuals of quantized, averaged speeds are correlated, so the covariance is that of blocks
    (the "sandwich"), with Student's factor for their number.
    """
    rest = problem.residuals(solution.x, solution.deadbands)
    jacobian = problem.jacobian(solution.x, solution.deadbands)[:, solution.free]
    weights = 1.0 / np.sqrt(1.0 + (rest / solution.scale) ** 2)
    blocks = problem.blocks()
    count = int(blocks.max()) + 1
    scores = np.zeros((count, jacobian.shape[1]))
    np.add.at(scores, blocks, jacobian * (weights * rest)[:, None])
    bread = np.linalg.pinv(jacobian.T @ (jacobian * weights[:, None]))
    spread = bread @ (scores.T @ scores) @ bread
    freedom = max(1, count - jacobian.shape[1])
    factor = float(stats.t.ppf(0.5 + LEVEL / 2.0, freedom)) * math.sqrt(count / freedom)
    half = np.zeros(len(solution.x))
    half[solution.free] = factor * np.sqrt(np.maximum(np.diag(spread), 0.0))
    return half
