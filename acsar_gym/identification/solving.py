"""Robust least squares: a coarse search for the start, then scipy, and intervals from blocks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import optional
from acsar_gym.identification.problem import HIGH, LOW, PER_WHEEL, Problem
from acsar_gym.identification.response import Clock, Wheel

with optional("identification", "scipy"):
    from scipy import optimize

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

DELAYS = np.arange(-0.01, 0.2, 0.01)
LAGS = (0.02, 0.05, 0.1, 0.2, 0.4)
SLOWNESSES = (0.003, 0.02, 0.05)
"""Values of the coarse search."""
DELAY_BOUNDS = (-0.03, 0.5)
"""Bounds of the delay to the middle of the window [s]."""
LONGEST_WINDOW = 0.4
"""Longest averaging time [s]; the shortest is a loop."""
WINDOWS = (0.005, 0.015, 0.025, 0.0375, 0.05, 0.0625, 0.075, 0.1, 0.14)
"""Averaging times from which a fit starts [s]."""
METHOD: dict[str, Any] = {
    "loss": "soft_l1",
    "x_scale": "jac",
    "ftol": 1e-6,
    "xtol": 1e-6,
    "tr_solver": "lsmr",  # the exact one decomposes the whole matrix, ten times as slowly
}
"""How `scipy.optimize.least_squares` solves."""
NEVER = 3600.0
"""Time-out of a board that has none [s]."""
LEAST_SCALE = 0.1
"""Least residual at which the loss becomes linear [rad/s]: an encoder count, so that a fit finds
the mean of two counts and not the more frequent one."""


@dataclass(frozen=True, eq=False)
class Solution:
    """A fit.

    Attributes:
        x: parameters, as `Problem` orders them.
        deadbands: of the wheels [rad/s].
        free: which parameters were fitted.
        scale: residual at which the loss becomes linear [rad/s].
        cost: sum of the losses.
    """

    x: Floats
    deadbands: tuple[float, ...]
    free: Bools
    scale: float
    cost: float


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
            gain = float(answer @ measured) / max(float(answer @ answer), 1e-9)
            cost = float(np.abs(gain * answer - measured).sum())
            found = min(found, (cost, motor._replace(gain=gain)))
    return found


def solve(
    problem: Problem, x: Floats, deadbands: Sequence[float], free: Bools, evaluations: int = 40
) -> Solution:
    """Fit the free parameters.

    Args:
        problem: to solve.
        x: start.
        deadbands: of the wheels, which stay [rad/s].
        free: which parameters may move.
        evaluations: of the residuals, at most.
    """
    low, high = bounds(problem)
    start = np.clip(x, low, high)
    rest = problem.residuals(start, deadbands)
    scale = max(LEAST_SCALE, 1.5 * float(np.median(np.abs(rest))))

    def full(part: Floats) -> Floats:
        moved = start.copy()
        moved[free] = part
        return moved

    result = optimize.least_squares(
        partial(_rest, problem, full, deadbands),
        np.clip(start[free], low[free] + 1e-9, high[free] - 1e-9),
        jac=partial(_slopes, problem, full, deadbands, free),
        bounds=(low[free], high[free]),
        f_scale=scale,
        max_nfev=evaluations,
        **METHOD,
    )
    return Solution(full(result.x), tuple(deadbands), free, scale, float(result.cost))


def _rest(
    problem: Problem, full: Callable[[Floats], Floats], deadbands: Sequence[float], part: Floats
) -> Floats:
    """Residuals for the free parameters."""
    return problem.residuals(full(part), deadbands)


def _slopes(
    problem: Problem,
    full: Callable[[Floats], Floats],
    deadbands: Sequence[float],
    free: Bools,
    part: Floats,
) -> Floats:
    """Derivatives by the free parameters."""
    return np.asarray(problem.jacobian(full(part), deadbands)[:, free])


def bounds(problem: Problem) -> tuple[Floats, Floats]:
    """Lower and upper bounds of the parameters."""
    n = len(problem.wheels)
    low = np.concatenate((np.tile(LOW, n), [DELAY_BOUNDS[0], problem.dt, 0.02]))
    high = np.concatenate((np.tile(HIGH, n), [DELAY_BOUNDS[1], LONGEST_WINDOW, NEVER]))
    return low, high


def searched(problem: Problem, x: Floats, deadbands: Sequence[float], free: Bools) -> Solution:
    """Fit from several averaging times: cost is flat along it, and has several minima.

    Args:
        problem: to solve.
        x: start.
        deadbands: of the wheels [rad/s].
        free: which parameters may move.
    """
    window = problem.size - 2
    if not free[window]:
        return solve(problem, x, deadbands, free)
    fixed = free.copy()
    fixed[window] = False
    nearby, tried = x, []
    for value in WINDOWS:
        start = nearby.copy()
        start[window] = value
        tried.append(solve(problem, start, deadbands, fixed, evaluations=8))
        nearby = tried[-1].x
    best = min(tried, key=lambda one: _absolute(problem, one))
    return solve(problem, best.x, deadbands, free)


def _absolute(problem: Problem, solution: Solution) -> float:
    """Sum of the absolute residuals, which doesn't depend on a fit's scale."""
    return float(np.abs(problem.residuals(solution.x, solution.deadbands)).sum())


def covariance(problem: Problem, solution: Solution) -> Floats:
    """Covariance of the parameters, with residuals that depend on each other in blocks.

    Residuals of quantized, averaged speeds are correlated, so it is that of blocks (the
    "sandwich"). Fixed parameters have zeros.
    """
    rest = problem.residuals(solution.x, solution.deadbands)
    jacobian = problem.jacobian(solution.x, solution.deadbands)[:, solution.free]
    weights = 1.0 / np.sqrt(1.0 + (rest / solution.scale) ** 2)  # of soft_l1
    blocks = problem.blocks()
    count = int(blocks.max()) + 1
    scores = np.zeros((count, jacobian.shape[1]))
    np.add.at(scores, blocks, jacobian * (weights * rest)[:, None])
    curvature = jacobian.T @ (jacobian * weights[:, None] ** 3)
    bread = np.linalg.pinv(curvature, hermitian=True)
    seen = len(np.unique(blocks))
    small = seen / max(1.0, seen - jacobian.shape[1])
    spread = np.zeros((len(solution.x), len(solution.x)))
    spread[np.ix_(solution.free, solution.free)] = bread @ (scores.T @ scores) @ bread * small
    return spread


def slack(problem: Problem, solution: Solution) -> Floats:
    """By how much fitted parameters move if lags that were held are any of those of robots.

    Zeros where all lags were fitted.
    """
    lags = PER_WHEEL * np.arange(len(problem.wheels))
    held = lags[~solution.free[lags]]
    moved = np.zeros(len(solution.x))
    if not len(held) or not solution.free.any():
        return moved
    for lag in (LAGS[0], LAGS[-1]):
        start = solution.x.copy()
        start[held] = lag
        other = solve(problem, start, solution.deadbands, solution.free)
        moved = np.maximum(moved, np.abs(other.x - solution.x))
    moved[held] = 0.0
    return moved
