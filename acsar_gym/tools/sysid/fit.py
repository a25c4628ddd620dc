"""The fit: wheels and the board's times by robust least squares.

Deadbands and time-out by search, in turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.protocol import MOTORS
from acsar_gym.tools.sysid import feedback_lines
from acsar_gym.tools.sysid.feedback_lines import mean_printed_speeds
from acsar_gym.tools.sysid.identifiability import TURNING_SPEED, Identifiability
from acsar_gym.tools.sysid.response import (
    PARAMETERS_PER_WHEEL,
    WHEEL_HIGH,
    WHEEL_LOW,
    BoardTimes,
    FitProblem,
    WheelModel,
)
from acsar_gym.tools.sysid.tracks import BoardTrack

DEADBAND_GRID = 0.01
"""Distance of the candidates, and least half width of an interval [rad/s]."""
CORRELATED_RESIDUALS = 2.0
"""Neighbouring residuals that count as one."""
LARGEST_DEADBAND = 2.0
"""Largest candidate [rad/s]."""
DEADBAND_EVIDENCE = 60.0
"""Excess cost, in typical losses of a reading, from which a value clearly fits worse."""
DEADBAND_SIGMAS = 2.5
"""Standard deviations in half an interval."""


@dataclass(frozen=True)
class SpeedRounding:
    """How a board rounds speeds: see `quantum.printed_mean`."""

    counts: float
    step: float


@dataclass(frozen=True)
class DeadbandEstimate:
    """A deadband and its 95 % interval [rad/s]."""

    value: float
    low: float
    high: float


def fit_deadband(
    problem: FitProblem,
    index: int,
    motor: WheelModel,
    clock: BoardTimes,
    printed: SpeedRounding,
    usual: float | None = None,
) -> DeadbandEstimate:
    """Find the deadband of one wheel, with its other parameters given.

    Args:
        problem: the tracks.
        index: of the wheel in the problem.
        motor: the wheel's parameters; its deadband isn't used.
        clock: the board's times.
        printed: how speeds are rounded.
        usual: for a log that can't tell: the value to stay at, unless it clearly fits worse.
    """
    bands = np.append(np.arange(0.0, LARGEST_DEADBAND + DEADBAND_GRID, DEADBAND_GRID), usual or 0.0)
    measured = problem.measured(index)
    costs = np.array(
        [_losses(problem, index, motor, clock, printed, measured, band) for band in bands]
    )
    total = costs.sum(1)
    excess = total - total.min()
    typical = max(float(total.min()) / len(measured), 1e-6)
    if usual is not None and excess[-1] < DEADBAND_EVIDENCE * typical:
        return DeadbandEstimate(usual, 0.0, math.inf)
    weights = np.exp(-excess / (2.0 * CORRELATED_RESIDUALS * typical))
    weights /= weights.sum()
    value = float(weights @ bands)
    half = DEADBAND_SIGMAS * math.sqrt(float(weights @ (bands - value) ** 2)) + DEADBAND_GRID
    return DeadbandEstimate(value, max(0.0, value - half), value + half)


def _losses(
    problem: FitProblem,
    index: int,
    motor: WheelModel,
    clock: BoardTimes,
    printed: SpeedRounding,
    measured: Floats,
    band: float,
) -> Floats:
    """Losses of all readings for one candidate, linear for large residuals."""
    rest = problem.residuals_of(index, motor._replace(deadband=float(band)), clock)
    expected = mean_printed_speeds(rest + measured, printed.counts, printed.step)
    rest = np.abs(expected - measured)
    return np.where(rest < 0.2, rest**2, 0.4 * rest - 0.04)


TIMEOUT_GRID = 0.01
"""Distance of the candidates [s]."""
STOPPING_SHARE = 0.6
"""Wheels below this share of their speed before the pause are stopping."""
TYPICAL_LAG = 0.15
"""Typical delay and lag, for a first guess [s]."""


def guess_timeout(tracks: Sequence[BoardTrack]) -> float:
    """A first guess of the time-out [s]; inf where wheels kept turning in every pause."""
    found = math.inf
    for track in tracks:
        for k in track.pauses:
            active = np.abs(track.commands[k]) >= TURNING_SPEED
            inside = _inside(track, int(k))
            if not active.any() or not inside.any():
                continue
            share = np.mean(track.speeds[inside][:, active] / track.commands[k][active], axis=1)
            slower = np.flatnonzero(share < STOPPING_SHARE * max(share[0], 0.5))
            if len(slower):
                after = track.stamps[inside][slower[0]] - track.arrivals[k]
                found = min(found, max(float(after) - TYPICAL_LAG, TIMEOUT_GRID))
    return found


def find_longest_pause(tracks: Sequence[BoardTrack]) -> float:
    """The longest pause while wheels turned [s]."""
    gaps = [
        float(track.arrivals[k + 1] - track.arrivals[k])
        for track in tracks
        for k in track.pauses
        if np.abs(track.commands[k]).max() >= TURNING_SPEED
    ]
    return max(gaps, default=0.0)


def refine_timeout(problem: FitProblem, motors: Sequence[WheelModel], clock: BoardTimes) -> float:
    """The time-out that explains the pauses best, within 0.4 s of the clock's [s]."""
    around = np.arange(-0.4, 0.4, TIMEOUT_GRID) + clock.timeout
    candidates = around[around > TIMEOUT_GRID]
    costs = []
    for timeout in candidates.tolist():
        other = clock._replace(timeout=timeout)
        rest = [problem.residuals_of(k, motor, other) for k, motor in enumerate(motors)]
        costs.append(float(np.abs(np.concatenate(rest)).sum()))
    return float(candidates[int(np.argmin(costs))])


def _inside(track: BoardTrack, k: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which readings were made in the pause after command k."""
    begin, end = track.arrivals[k], track.arrivals[k + 1]
    return np.asarray((track.stamps > begin + 0.02) & (track.stamps < end))


with require_extra("identification", "scipy"):
    from scipy import optimize

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SEARCHED_DELAYS = np.arange(-0.01, 0.2, 0.01)
SEARCHED_LAGS = (0.02, 0.05, 0.1, 0.2, 0.4)
SEARCHED_SLOWNESSES = (0.003, 0.02, 0.05)
"""Values of the coarse search."""
DELAY_BOUNDS = (-0.03, 0.5)
"""Bounds of the delay to the middle of the window [s]."""
LONGEST_WINDOW = 0.4
"""Longest averaging time [s]; the shortest is a loop."""
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
NO_TIMEOUT = 3600.0
"""Time-out of a board that has none [s]."""
LEAST_LOSS_SCALE = 0.1
"""Least residual at which the loss becomes linear [rad/s]: an encoder count, so that a fit finds
the mean of two counts and not the more frequent one."""


@dataclass(frozen=True, eq=False)
class FitSolution:
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


def search_start(
    problem: FitProblem, deadbands: Sequence[float], window: float, timeout: float
) -> Floats:
    """Search the start of a fit on a grid.

    Args:
        problem: to solve.
        deadbands: of the wheels [rad/s].
        window: averaging time to begin with [s].
        timeout: time-out to begin with [s].
    """
    clocks = [BoardTimes(float(delay), window, timeout) for delay in SEARCHED_DELAYS]
    best: list[list[tuple[float, WheelModel]]] = []
    for k, band in enumerate(deadbands):
        best.append([_best_wheel(problem, k, band, clock) for clock in clocks])
    costs = [sum(rows[d][0] for rows in best) for d in range(len(clocks))]
    d = int(np.argmin(costs))
    return problem.joined([rows[d][1] for rows in best], clocks[d])


def _best_wheel(
    problem: FitProblem, k: int, band: float, clock: BoardTimes
) -> tuple[float, WheelModel]:
    """Cost and motor of the best lag and ramp for one wheel and clock; its gain is linear."""
    found = (math.inf, WheelModel(SEARCHED_LAGS[2], 1.0, 0.0, band))
    for lag in SEARCHED_LAGS:
        for slowness in SEARCHED_SLOWNESSES:
            motor = WheelModel(lag, 1.0, slowness, band)
            measured = problem.measured(k)
            answer = problem.residuals_of(k, motor, clock) + measured
            gain = float(answer @ measured) / max(float(answer @ answer), 1e-9)
            cost = float(np.abs(gain * answer - measured).sum())
            found = min(found, (cost, motor._replace(gain=gain)))
    return found


def solve_problem(
    problem: FitProblem, x: Floats, deadbands: Sequence[float], free: Bools, evaluations: int = 40
) -> FitSolution:
    """Fit the free parameters.

    Args:
        problem: to solve.
        x: start.
        deadbands: of the wheels, which stay [rad/s].
        free: which parameters may move.
        evaluations: of the residuals, at most.
    """
    low, high = parameter_bounds(problem)
    start = np.clip(x, low, high)
    rest = problem.residuals(start, deadbands)
    scale = max(LEAST_LOSS_SCALE, 1.5 * float(np.median(np.abs(rest))))

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
        **SOLVER_OPTIONS,
    )
    return FitSolution(full(result.x), tuple(deadbands), free, scale, float(result.cost))


def _rest(
    problem: FitProblem, full: Callable[[Floats], Floats], deadbands: Sequence[float], part: Floats
) -> Floats:
    """Residuals for the free parameters."""
    return problem.residuals(full(part), deadbands)


def _slopes(
    problem: FitProblem,
    full: Callable[[Floats], Floats],
    deadbands: Sequence[float],
    free: Bools,
    part: Floats,
) -> Floats:
    """Derivatives by the free parameters."""
    return np.asarray(problem.jacobian(full(part), deadbands)[:, free])


def parameter_bounds(problem: FitProblem) -> tuple[Floats, Floats]:
    """Lower and upper bounds of the parameters."""
    n = len(problem.wheels)
    low = np.concatenate((np.tile(WHEEL_LOW, n), [DELAY_BOUNDS[0], problem.dt, 0.02]))
    high = np.concatenate((np.tile(WHEEL_HIGH, n), [DELAY_BOUNDS[1], LONGEST_WINDOW, NO_TIMEOUT]))
    return low, high


def search_window(
    problem: FitProblem, x: Floats, deadbands: Sequence[float], free: Bools
) -> FitSolution:
    """Fit from several averaging times: cost is flat along it, and has several minima.

    Args:
        problem: to solve.
        x: start.
        deadbands: of the wheels [rad/s].
        free: which parameters may move.
    """
    window = problem.size - 2
    if not free[window]:
        return solve_problem(problem, x, deadbands, free)
    fixed = free.copy()
    fixed[window] = False
    nearby, tried = x, []
    for value in SEARCHED_WINDOWS:
        start = nearby.copy()
        start[window] = value
        tried.append(solve_problem(problem, start, deadbands, fixed, evaluations=8))
        nearby = tried[-1].x
    best = min(tried, key=lambda one: _absolute(problem, one))
    return solve_problem(problem, best.x, deadbands, free)


def _absolute(problem: FitProblem, solution: FitSolution) -> float:
    """Sum of the absolute residuals, which doesn't depend on a fit's scale."""
    return float(np.abs(problem.residuals(solution.x, solution.deadbands)).sum())


def estimate_covariance(problem: FitProblem, solution: FitSolution) -> Floats:
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


def estimate_slack(problem: FitProblem, solution: FitSolution) -> Floats:
    """By how much fitted parameters move if lags that were held are any of those of robots.

    Zeros where all lags were fitted.
    """
    lags = PARAMETERS_PER_WHEEL * np.arange(len(problem.wheels))
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


SMOOTH_PARAMETERS = ("motor.time_constant", "motor.gain", "motor.acceleration")
"""Parameters of a wheel in the problem's order."""
WINDOW_SIGMAS = 2.5
"""A window as configured is given up for one that differs by so many standard errors."""
VAGUE_WINDOW = 0.006
"""A window with a larger standard error stays as configured [s]."""
LONGEST_COUNT_WINDOW = 60
"""Longest window that is compared with the printed counts [loops]."""


@dataclass(frozen=True, eq=False)
class MotorFit:
    """What was fitted.

    Attributes:
        problem: with the tracks and the wheels that turned.
        solution: parameters.
        spread: their covariance.
        slack: by how much they may be off since lags that the log can't tell were held.
        deadbands: of the wheels in the problem; None where the log can't tell.
        quantum: step of the printed numbers; None where the log can't tell.
        printed: how speeds are rounded.
        counted: whether they are whole encoder counts, which tell the window exactly.
    """

    problem: FitProblem
    solution: FitSolution
    spread: Floats
    slack: Floats
    deadbands: tuple[DeadbandEstimate | None, ...]
    quantum: feedback_lines.Quantum | None
    printed: SpeedRounding
    counted: bool

    @property
    def motors(self) -> list[WheelModel]:
        """Parameters of the wheels."""
        return self.problem.split(self.solution.x, self.solution.deadbands)[0]

    @property
    def clock(self) -> BoardTimes:
        """Times of the board."""
        return self.problem.split(self.solution.x, self.solution.deadbands)[1]


def configured_wheel(config: RobotConfig, wheel: int) -> WheelModel:
    """Make the motor of one wheel from a robot's configuration."""
    own = config.motor.of_wheel(wheel)
    return WheelModel(own.time_constant, own.gain, 1.0 / own.acceleration, own.deadband)


def configured_times(config: RobotConfig) -> BoardTimes:
    """Make the board's times from a robot's configuration."""
    board = config.firmware
    return BoardTimes(
        board.command_delay, config.encoder.window, board.command_timeout or NO_TIMEOUT
    )


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
    steps = feedback_lines.find_quantum(np.concatenate([track.speeds for track in tracks]))
    free = _free(problem, known)
    x, bands = _start(problem, config, known, free)
    solution = search_window(problem, x, bands, free)
    solution, printed, found = _in_turn(problem, solution, config, known, steps)
    spread = estimate_covariance(problem, solution)
    slack = estimate_slack(problem, solution)
    counted = bool(free[-2] != solution.free[-2])
    return MotorFit(problem, solution, spread, slack, found, steps, printed, counted)


def _free(problem: FitProblem, known: Identifiability) -> Bools:
    """Which parameters the log can tell."""
    # Ramp and delay are fitted with every lag, even where the log can't tell them apart.
    names = ("motor.time_constant", "motor.gain", "motor.time_constant")
    rows = [known.can(name, MOTORS[w]) for w in problem.wheels for name in names]
    delay = any(known.can("motor.time_constant", MOTORS[w]) for w in problem.wheels)
    return np.array([*rows, delay, delay, known.can("firmware.command_timeout")])


def _start(
    problem: FitProblem, config: RobotConfig, known: Identifiability, free: Bools
) -> tuple[Floats, list[float]]:
    """First parameters and deadbands; decides in `free` whether there is a time-out to fit."""
    configured = [configured_wheel(config, w) for w in problem.wheels]
    clock = configured_times(config)
    if free[-1]:
        guess = guess_timeout(problem.tracks)
        free[-1] = np.isfinite(guess)
        clock = clock._replace(timeout=min(guess, NO_TIMEOUT))
    bands = [_usual_band(problem, known, config, k) or 0.0 for k in range(len(configured))]
    x = problem.joined(configured, clock)
    if not free[-3]:
        return x, bands
    for _ in range(2):
        rough = search_start(problem, bands, clock.window, clock.timeout)
        motors, rough_clock = problem.split(rough, bands)
        for k in range(len(bands)):
            usual = _usual_band(problem, known, config, k)
            one = fit_deadband(problem, k, motors[k], rough_clock, SpeedRounding(0.0, 0.0), usual)
            bands[k] = one.value
    if free[-1]:
        rough[-1] = refine_timeout(problem, motors, rough_clock)
    return np.where(free, rough, x), bands


def _usual_band(
    problem: FitProblem, known: Identifiability, config: RobotConfig, k: int
) -> float | None:
    """The configured deadband of a wheel of which the log can't tell one; otherwise None."""
    wheel = problem.wheels[k]
    told = known.can("motor.deadband", MOTORS[wheel])
    return None if told else configured_wheel(config, wheel).deadband


def _in_turn(
    problem: FitProblem,
    solution: FitSolution,
    config: RobotConfig,
    known: Identifiability,
    steps: feedback_lines.Quantum | None,
) -> tuple[FitSolution, SpeedRounding, tuple[DeadbandEstimate | None, ...]]:
    """Fit deadbands with the rest given, and the rest with the deadbands given, twice."""
    found: list[DeadbandEstimate | None] = [None] * len(problem.wheels)
    solution, printed = _rounded(problem, solution, config, steps)
    for _ in range(2):
        motors, clock = problem.split(solution.x, solution.deadbands)
        bands = list(solution.deadbands)
        for k in range(len(bands)):
            usual = _usual_band(problem, known, config, k)
            one = fit_deadband(problem, k, motors[k], clock, printed, usual)
            found[k], bands[k] = one if usual is None else None, one.value
        solution = solve_problem(problem, solution.x, bands, solution.free)
    return solution, printed, tuple(found)


def _rounded(
    problem: FitProblem,
    solution: FitSolution,
    config: RobotConfig,
    steps: feedback_lines.Quantum | None,
) -> tuple[FitSolution, SpeedRounding]:
    """Find how the board rounds, and hold the window where something better than the fit tells it.

    That are whole encoder counts, which tell it exactly, or else the config, unless the fit is
    sure of another one.
    """
    printed, window = find_rounding(problem, config, solution.x[-2], steps)
    free, x = solution.free.copy(), solution.x.copy()
    if window is None and free[-2]:
        sigma = math.sqrt(estimate_covariance(problem, solution)[-2, -2])
        away = abs(x[-2] - config.encoder.window)
        if sigma > VAGUE_WINDOW or away < max(WINDOW_SIGMAS * sigma, problem.dt):
            window = config.encoder.window
    if window is not None and free[-2]:
        x[-2], free[-2] = window, False
    return solve_problem(problem, x, solution.deadbands, free), printed


def find_rounding(
    problem: FitProblem, config: RobotConfig, window: float, steps: feedback_lines.Quantum | None
) -> tuple[SpeedRounding, float | None]:
    """How a board rounds its speeds: by its encoder's counts, a step of its own, or both.

    Returns:
        The rounding; and the window, if whole counts tell it exactly [s].
    """
    step = steps.step if steps else 0.0
    speeds = np.concatenate([track.speeds for track in problem.tracks])
    for n in range(
        1, LONGEST_COUNT_WINDOW + 1
    ):  # the coarsest counts: finer ones explain multiples, too
        counts = feedback_lines.count_speed(config, n * problem.dt)
        own = 0.0 if abs(counts - step) < feedback_lines.SAME_QUANTUM * step else step
        if feedback_lines.is_explained_by_counts(speeds, config, n * problem.dt, own):
            return SpeedRounding(counts, own), n * problem.dt
    counts = feedback_lines.count_speed(config, window)
    return SpeedRounding(counts if counts < step else 0.0, step), None
