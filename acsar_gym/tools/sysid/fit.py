"""The fit of motors and board: robust least squares; deadbands and time-out by search.

`fit_motors` reads top to bottom: a coarse search, least squares from several averaging times, how
the board rounds, deadbands and the rest in turn, then the covariance. The model and its residuals
are those of `response.FitProblem`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.protocol import MOTORS
from acsar_gym.tools.sysid import board_log, response
from acsar_gym.tools.sysid.board_log import (
    TURNING_SPEED,
    BoardTrack,
    Estimate,
    Floats,
    Identifiability,
    add_cut_half,
)
from acsar_gym.tools.sysid.response import BoardTimes, FitProblem, WheelModel

with require_extra("identification", "scipy"):
    from scipy import optimize

Bools = NDArray[np.bool_]

SMOOTH_PARAMETERS = ("motor.time_constant", "motor.gain", "motor.acceleration")
"""Parameters of a wheel in the problem's order."""
WHEEL_LOW = np.array([2e-3, 0.01, 0.0])
WHEEL_HIGH = np.array([3.0, 100.0, 1.0])
"""Bounds of lag [s], gain and slowness [s^2/rad]."""
DELAY_BOUNDS = (-0.03, 0.5)
"""Bounds of the delay to the middle of the window [s]."""
LONGEST_WINDOW = 0.4
"""Longest averaging time [s]; the shortest is a loop."""
NO_TIMEOUT = 3600.0
"""Time-out of a board that has none [s]."""
SEARCHED_DELAYS = np.arange(-0.01, 0.2, 0.01)
SEARCHED_LAGS = (0.02, 0.05, 0.1, 0.2, 0.4)
SEARCHED_SLOWNESSES = (0.003, 0.02, 0.05)
"""Values of the coarse search."""
SEARCHED_WINDOWS = (0.005, 0.015, 0.025, 0.0375, 0.05, 0.0625, 0.075, 0.1, 0.14)
"""Averaging times from which a fit starts [s]."""
SOLVER_OPTIONS: dict[str, Any] = {
    "loss": "soft_l1",
    "x_scale": "jac",
    "ftol": 1e-6,
    "xtol": 1e-6,
    "tr_solver": "lsmr",  # the exact one decomposes the whole matrix, ten times as slowly
}
"""How `scipy.optimize.least_squares` solves."""
LEAST_LOSS_SCALE = 0.1
"""Least residual at which the loss becomes linear [rad/s]: an encoder count, so that a fit finds
the mean of two counts and not the more frequent one."""
COUNTED_SIGMAS = 2.0
"""A window that counts tell lies within so many standard errors of the fitted one."""
CUT_SPEED = 1.0
"""Wheels faster than this show whether a board cuts speeds, whatever its deadband [rad/s]."""
CUT_OFFSETS = (0.3, 0.7)
"""Boards that cut report speeds that are too slow by half a step: by such parts of one."""
LONGEST_COUNT_WINDOW = 60
"""Longest window that is compared with the printed counts [loops]."""
DEADBAND_GRID = 0.01
"""Distance of the candidates, and least half width of an interval [rad/s]."""
LARGEST_DEADBAND = 2.0
"""Largest candidate [rad/s]."""
CORRELATED_RESIDUALS = 2.0
"""Neighbouring residuals that count as one."""
DEADBAND_EVIDENCE = 60.0
"""Excess cost, in typical losses of a reading, from which a value clearly fits worse."""
DEADBAND_SIGMAS = 2.5
"""Standard deviations in half an interval."""
TIMEOUT_GRID = 0.01
"""Distance of the candidates [s]."""
STOPPING_SHARE = 0.6
"""Wheels below this share of their speed before the pause are stopping."""
TYPICAL_LAG = 0.15
"""Typical delay and lag, for a first guess of the time-out [s]."""


class FitSolution(NamedTuple):
    """Parameters of a `FitProblem`."""

    x: Floats
    """Parameters, as `FitProblem` orders them."""
    deadbands: tuple[float, ...]
    """Of the wheels [rad/s]."""
    free: Bools
    """Which parameters were fitted."""
    scale: float
    """Residual at which the loss becomes linear [rad/s]."""


class SpeedRounding(NamedTuple):
    """How a board rounds speeds: see `mean_printed_speeds`."""

    counts: float
    step: float
    cut: float = 0.0


@dataclass(frozen=True, eq=False)
class MotorFit:
    """What was fitted of wheels and board."""

    problem: FitProblem
    """With the tracks and the wheels that turned."""
    solution: FitSolution
    spread: Floats
    """Covariance of the parameters."""
    slack: Floats
    """By how much they may be off since lags that the log can't tell were held."""
    deadbands: tuple[Estimate | None, ...]
    """Of the wheels in the problem; None where the log can't tell."""
    quantum: Estimate | None
    """Step of the printed numbers; None where the log can't tell."""
    rounding: SpeedRounding
    counted: bool
    """Whether whole encoder counts tell the window, better than the fit."""
    bounded: bool
    """Whether the window is the longest with which the delay isn't negative."""

    @property
    def wheels(self) -> list[WheelModel]:
        """Parameters of the wheels."""
        return self.problem.split(self.solution.x, self.solution.deadbands)[0]

    @property
    def times(self) -> BoardTimes:
        """Times of the board."""
        return self.problem.split(self.solution.x, self.solution.deadbands)[1]


def configured_wheel(config: RobotConfig, wheel: int) -> WheelModel:
    """Make the model of one wheel from a robot's configuration."""
    own = config.motor.of_wheel(wheel)
    return WheelModel(own.time_constant, own.gain, 1.0 / own.acceleration, own.deadband)


def configured_times(config: RobotConfig) -> BoardTimes:
    """Make the board's times from a robot's configuration."""
    board = config.firmware
    timeout = board.command_timeout or NO_TIMEOUT
    return BoardTimes(board.command_delay, config.encoder.window, timeout)


def fit_motors(
    tracks: Sequence[BoardTrack], config: RobotConfig, known: Identifiability
) -> MotorFit | None:
    """Fit what a log can tell.

    Args:
        tracks: of one robot.
        config: of the robot; what the log can't tell stays as configured.
        known: what it can tell.

    Returns:
        The fit; None where the log tells nothing of any wheel.
    """
    wheels = [k for k, w in enumerate(MOTORS) if any(known.can(n, w) for n in SMOOTH_PARAMETERS)]
    if not wheels:
        return None
    problem = FitProblem.of(tracks, wheels, config)
    printed = np.concatenate([track.speeds for track in tracks])
    quantum = board_log.find_quantum(printed)
    # Ramp and delay are fitted with every lag, even where the log can't tell them apart.
    names = ("motor.time_constant", "motor.gain", "motor.time_constant")
    rows = [known.can(name, MOTORS[wheel]) for wheel in wheels for name in names]
    delay = any(known.can("motor.time_constant", MOTORS[wheel]) for wheel in wheels)
    free = np.array([*rows, delay, delay, known.can("firmware.command_timeout")])
    # A wheel of which the log can't tell a deadband stays at the configured one.
    usual = [
        None if known.can("motor.deadband", MOTORS[wheel]) else configured_wheel(config, wheel)[3]
        for wheel in wheels
    ]

    x, bands = _find_start(problem, config, free, usual)
    solution = search_window(problem, x, bands, free)
    rounding, window = find_rounding(problem, config, solution, quantum)
    x, free = solution.x.copy(), solution.free.copy()
    counted = window is not None and bool(free[-2])
    if counted:
        x[-2], free[-2] = window, False
    if rounding.cut:
        tracks = [replace(one, speeds=add_cut_half(one.speeds, rounding.cut)) for one in tracks]
        problem = FitProblem.of(tracks, wheels, config)
    solution = solve_problem(problem, x, solution.deadbands, free)
    bounded = bool(free[-2]) and problem.split(solution.x, solution.deadbands)[1].delay < 0.0
    if bounded:  # middle and window are hardly told apart: no board answers before its command
        x, free = solution.x.copy(), free.copy()
        x[-2], free[-2] = max(problem.dt, 2.0 * x[-3]), False
        solution = solve_problem(problem, x, solution.deadbands, free)
    found: list[Estimate] = []
    for _ in range(2):  # deadbands with the rest given, and the rest with the deadbands given
        models, times = problem.split(solution.x, solution.deadbands)
        found = [
            fit_deadband(problem, k, model, times, rounding, usual[k])
            for k, model in enumerate(models)
        ]
        solution = solve_problem(problem, solution.x, [one.value for one in found], solution.free)
    return MotorFit(
        problem,
        solution,
        estimate_covariance(problem, solution),
        estimate_slack(problem, solution),
        tuple(one if own is None else None for one, own in zip(found, usual, strict=True)),
        quantum,
        rounding,
        counted,
        bounded,
    )


def _find_start(
    problem: FitProblem, config: RobotConfig, free: Bools, usual: Sequence[float | None]
) -> tuple[Floats, list[float]]:
    """First parameters and deadbands; decides in `free` whether there is a time-out to fit."""
    times = configured_times(config)
    if free[-1]:
        guess = guess_timeout(problem.tracks)
        free[-1] = np.isfinite(guess)
        times = times._replace(timeout=min(guess, NO_TIMEOUT))
    bands = [own or 0.0 for own in usual]
    x = problem.join([configured_wheel(config, wheel) for wheel in problem.wheels], times)
    if not free[-3]:
        return x, bands
    for _ in range(2):
        models, found = search_start(problem, bands, times)
        bands = [
            fit_deadband(problem, k, model, found, SpeedRounding(0.0, 0.0), usual[k]).value
            for k, model in enumerate(models)
        ]
    rough = problem.join(models, found)
    if free[-1]:  # the time-out that explains the pauses best, within 0.4 s of the guess
        around = np.arange(-0.4, 0.4, TIMEOUT_GRID) + found.timeout
        candidates = around[around > TIMEOUT_GRID]
        costs = []
        for timeout in candidates.tolist():
            other = found._replace(timeout=timeout)
            rest = [problem.residuals_of(k, model, other) for k, model in enumerate(models)]
            costs.append(float(np.abs(np.concatenate(rest)).sum()))
        rough[-1] = candidates[int(np.argmin(costs))]
    return np.where(free, rough, x), bands


def guess_timeout(tracks: Sequence[BoardTrack]) -> float:
    """A first guess of the time-out [s]; inf where wheels kept turning in every pause."""
    found = math.inf
    for track in tracks:
        for k in track.pauses:
            active = np.abs(track.commands[k]) >= TURNING_SPEED
            begin, end = track.arrivals[k], track.arrivals[k + 1]
            inside = (track.stamps > begin + 0.02) & (track.stamps < end)
            if not active.any() or not inside.any():
                continue
            share = np.mean(track.speeds[inside][:, active] / track.commands[k][active], axis=1)
            slower = np.flatnonzero(share < STOPPING_SHARE * max(share[0], 0.5))
            if len(slower):
                after = float(track.stamps[inside][slower[0]] - begin)
                found = min(found, max(after - TYPICAL_LAG, TIMEOUT_GRID))
    return found


def search_start(
    problem: FitProblem, deadbands: Sequence[float], times: BoardTimes
) -> tuple[list[WheelModel], BoardTimes]:
    """Search the start of a fit on a grid of delays, lags and ramps; gains are linear."""
    best_cost, best = math.inf, ([WheelModel(0.0, 0.0, 0.0, 0.0)], times)
    for delay in SEARCHED_DELAYS.tolist():
        own, models, cost = times._replace(delay=delay), [], 0.0
        for k, band in enumerate(deadbands):
            measured, found = problem.measured(k), []
            for lag in SEARCHED_LAGS:
                for slowness in SEARCHED_SLOWNESSES:
                    model = WheelModel(lag, 1.0, slowness, band)
                    answer = problem.residuals_of(k, model, own) + measured
                    gain = float(answer @ measured) / max(float(answer @ answer), 1e-9)
                    loss = float(np.abs(gain * answer - measured).sum())
                    found.append((loss, model._replace(gain=gain)))
            loss, model = min(found)
            models.append(model)
            cost += loss
        if cost < best_cost:
            best_cost, best = cost, (models, own)
    return best


def solve_problem(
    problem: FitProblem,
    x: Floats,
    deadbands: Sequence[float],
    free: Bools,
    evaluations: int = 40,
) -> FitSolution:
    """Fit the free parameters by robust least squares.

    Args:
        problem: to solve.
        x: start.
        deadbands: of the wheels, which stay [rad/s].
        free: which parameters may move.
        evaluations: of the residuals, at most.
    """
    n = len(problem.wheels)
    low = np.concatenate((np.tile(WHEEL_LOW, n), [DELAY_BOUNDS[0], problem.dt, 0.02]))
    high = np.concatenate((np.tile(WHEEL_HIGH, n), [DELAY_BOUNDS[1], LONGEST_WINDOW, NO_TIMEOUT]))
    start = np.clip(x, low, high)
    rest = problem.residuals(start, deadbands)
    scale = max(LEAST_LOSS_SCALE, 1.5 * float(np.median(np.abs(rest))))

    def complete(part: Floats) -> Floats:
        moved = start.copy()
        moved[free] = part
        return moved

    def residuals(part: Floats) -> Floats:
        return problem.residuals(complete(part), deadbands)

    def jacobian(part: Floats) -> Floats:
        return np.asarray(problem.jacobian(complete(part), deadbands)[:, free])

    result = optimize.least_squares(
        residuals,
        np.clip(start[free], low[free] + 1e-9, high[free] - 1e-9),
        jac=jacobian,
        bounds=(low[free], high[free]),
        f_scale=scale,
        max_nfev=evaluations,
        **SOLVER_OPTIONS,
    )
    return FitSolution(complete(result.x), tuple(deadbands), free, scale)


def search_window(
    problem: FitProblem, x: Floats, deadbands: Sequence[float], free: Bools
) -> FitSolution:
    """Fit from several averaging times: cost is flat along it, and has several minima.

    Arguments as for `solve_problem`.
    """
    if not free[-2]:
        return solve_problem(problem, x, deadbands, free)
    fixed = free.copy()
    fixed[-2] = False
    nearby, best, least = x, x, math.inf
    for window in SEARCHED_WINDOWS:
        start = nearby.copy()
        start[-2] = window
        nearby = solve_problem(problem, start, deadbands, fixed, evaluations=8).x
        cost = float(np.abs(problem.residuals(nearby, deadbands)).sum())
        if cost < least:
            least, best = cost, nearby
    return solve_problem(problem, best, deadbands, free)


def find_rounding(
    problem: FitProblem, config: RobotConfig, solution: FitSolution, quantum: Estimate | None
) -> tuple[SpeedRounding, float | None]:
    """How a board rounds its speeds: by its encoder's counts, a step of its own, or both."""
    step = quantum.value if quantum else 0.0
    speeds = np.concatenate([track.speeds for track in problem.tracks])
    fitted, near = float(solution.x[-2]), math.inf
    if solution.free[-2]:
        near = COUNTED_SIGMAS * math.sqrt(estimate_covariance(problem, solution)[-2, -2])
        near += problem.dt
    explained = []
    for n in range(1, LONGEST_COUNT_WINDOW + 1):
        coarse = board_log.count_speed(config, n * problem.dt)
        own = 0.0 if abs(coarse - step) < board_log.SAME_QUANTUM * step else step
        if abs(n * problem.dt - fitted) <= near and board_log.is_explained_by_counts(
            speeds, config, n * problem.dt, own
        ):
            explained.append((n, coarse, own))
    counts, window = board_log.count_speed(config, fitted), None
    counts = counts if counts < step else 0.0
    # Finer counts explain multiples of coarse ones, too; where others do, a coarse step hides them.
    if explained and all(n % explained[0][0] == 0 for n, _, _ in explained):
        n, counts, step = explained[0]
        window = n * problem.dt
    measured = np.concatenate([problem.measured(k) for k in range(len(problem.wheels))])
    answer = problem.residuals(solution.x, solution.deadbands) + measured
    fast, coarse = np.abs(answer) > CUT_SPEED, max(counts, step)
    if coarse > board_log.FINEST_QUANTUM and fast.sum() > board_log.FEWEST_SPEEDS:
        offset = -float(np.polyfit(np.abs(answer[fast]), np.abs(measured[fast]), 1)[1])
        if CUT_OFFSETS[0] < offset / coarse < CUT_OFFSETS[1]:
            return SpeedRounding(counts, step, coarse), window
    return SpeedRounding(counts, step), window


def fit_deadband(
    problem: FitProblem,
    index: int,
    model: WheelModel,
    times: BoardTimes,
    rounding: SpeedRounding,
    usual: float | None,
) -> Estimate:
    """Find the deadband of one wheel: the answer jumps where a set point crosses one."""
    bands = np.arange(0.0, LARGEST_DEADBAND + DEADBAND_GRID, DEADBAND_GRID)
    if usual is not None:
        bands = np.append(bands, usual)
    measured, costs = problem.measured(index), []
    for band in bands.tolist():
        rest = problem.residuals_of(index, model._replace(deadband=band), times)
        expected = board_log.mean_printed_speeds(rest + measured, *rounding)
        rest = np.abs(expected - measured)
        costs.append(np.where(rest < 0.2, rest**2, 0.4 * rest - 0.04))  # linear for large ones
    total = np.array(costs).sum(1)
    excess = total - total.min()
    typical = max(float(total.min()) / len(measured), 1e-6)
    if usual is not None and excess[-1] < DEADBAND_EVIDENCE * typical:
        return Estimate(usual, 0.0, math.inf)
    weights = np.exp(-excess / (2.0 * CORRELATED_RESIDUALS * typical))
    weights /= weights.sum()
    value = float(weights @ bands)
    half = DEADBAND_SIGMAS * math.sqrt(float(weights @ (bands - value) ** 2)) + DEADBAND_GRID
    return Estimate(value, max(0.0, value - half), value + half)


def estimate_covariance(problem: FitProblem, solution: FitSolution) -> Floats:
    """Covariance of the parameters, with residuals that depend on each other in blocks.

    Residuals of quantized, averaged speeds are correlated, so it is that of blocks (the
    "sandwich"). Fixed parameters have zeros.
    """
    rest = problem.residuals(solution.x, solution.deadbands)
    jacobian = problem.jacobian(solution.x, solution.deadbands)[:, solution.free]
    spread = np.zeros((len(solution.x), len(solution.x)))
    spread[np.ix_(solution.free, solution.free)] = estimate_spread(
        rest, jacobian, solution.scale, problem.blocks()
    )
    return spread


def estimate_spread(
    rest: Floats, jacobian: Floats, scale: float, blocks: NDArray[np.intp]
) -> Floats:
    """Estimate the covariance of parameters from residuals, their derivatives and their blocks."""
    weights = 1.0 / np.sqrt(1.0 + (rest / scale) ** 2)  # of soft_l1
    scores = np.zeros((int(blocks.max()) + 1, jacobian.shape[1]))
    np.add.at(scores, blocks, jacobian * (weights * rest)[:, None])
    curvature = jacobian.T @ (jacobian * weights[:, None] ** 3)
    bread = np.linalg.pinv(curvature, hermitian=True)
    seen = len(np.unique(blocks))
    small = seen / max(1.0, seen - jacobian.shape[1])
    return np.asarray(bread @ (scores.T @ scores) @ bread * small)


def estimate_slack(problem: FitProblem, solution: FitSolution) -> Floats:
    """By how much fitted parameters move if lags that were held are any of those of robots.

    Zeros where all lags were fitted.
    """
    lags = response.PARAMETERS_PER_WHEEL * np.arange(len(problem.wheels))
    held = lags[~solution.free[lags]]
    moved = np.zeros(len(solution.x))
    if not len(held) or not solution.free.any():
        return moved
    for lag in (SEARCHED_LAGS[0], SEARCHED_LAGS[-1]):
        start = solution.x.copy()
        start[held] = lag
        other = solve_problem(problem, start, solution.deadbands, solution.free)
        moved = np.maximum(moved, np.abs(other.x - solution.x))
    moved[held] = 0.0
    return moved
