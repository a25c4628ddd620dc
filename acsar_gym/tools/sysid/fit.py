"""The estimator: motors and board by robust least squares, with what is usual as prior.

`WHEEL_PARAMETERS` and `BOARD_PARAMETERS` are the table of what is fitted. Priors are residuals like
any other, so a log that shows nothing of a parameter leaves it at its prior, and its covariance
tells so. `fit_tracks` reads top to bottom: a coarse search, least squares from a few averaging
times, the way of rounding, then the covariance.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.tools.sysid.board_log import BoardTrack, Floats
from acsar_gym.tools.sysid.response import BoardModel, Responder, Rounding, WheelModel

with require_extra("identification", "scipy"):
    from scipy import optimize

Bools = NDArray[np.bool_]


class Parameter(NamedTuple):
    """A row of the table of what is fitted."""

    name: str
    """Field of the robot's file, of which a ramp is the inverse."""
    mean: float
    """What is usual, unless the robot's file is taken for it."""
    deviation: float
    """By how much robots differ from that; of a logarithm, as a share."""
    bounds: tuple[float, float]
    """Least and largest value that a fit tries."""
    step: float
    """Step of its derivative."""
    resolution: float
    """Least half width of an interval, since the phases of the board's loops move values by so
    much, whatever a log's length."""
    is_log: bool = False
    """Whether the logarithm is fitted."""
    manoeuvre: str = "sudden changes of 4 rad/s or more, each held for 0.3 s"
    """What narrows it."""

    @property
    def missing(self) -> str:
        """What is said of it if a log doesn't show it."""
        return f"not narrowed by this log: drive {self.manoeuvre}"

    def to_fit(self, value: float) -> float:
        """Turn a value into the number that is fitted."""
        bounded = min(max(value, self.bounds[0]), self.bounds[1])
        return math.log(bounded) if self.is_log else bounded

    def from_fit(self, number: float) -> float:
        """Turn a fitted number into a value."""
        return math.exp(number) if self.is_log else number


WHEEL_PARAMETERS = (
    Parameter(
        name="motor.time_constant",
        mean=0.1,
        deviation=1.0,
        bounds=(2e-3, 3.0),
        step=0.02,
        resolution=0.03,
        is_log=True,
    ),
    Parameter(
        name="motor.gain",
        mean=1.0,
        deviation=0.2,
        bounds=(0.01, 100.0),
        step=2e-3,
        resolution=0.015,
        is_log=True,
        manoeuvre="a second at 2 rad/s or more",
    ),
    Parameter(
        name="motor.acceleration",
        mean=0.03,
        deviation=0.04,
        bounds=(0.0, 1.0),
        step=5e-4,
        resolution=1e-3,
    ),
    Parameter(
        name="motor.deadband",
        mean=0.2,
        deviation=0.5,
        bounds=(0.0, 2.0),
        step=0.02,
        resolution=0.03,
        manoeuvre="a slow staircase through zero",
    ),
)
"""Of each wheel, as the fields of `WheelModel`."""
BOARD_PARAMETERS = (
    Parameter(
        name="firmware.command_delay",
        mean=0.02,
        deviation=0.05,
        bounds=(0.0, 0.5),
        step=1e-3,
        resolution=0.015,
    ),
    Parameter(
        name="encoder.window",
        mean=0.05,
        deviation=0.06,
        bounds=(5e-4, 0.4),
        step=2e-3,
        resolution=0.03,
    ),
    Parameter(
        name="firmware.command_timeout",
        mean=0.5,
        deviation=1.0,
        bounds=(0.02, 3600.0),
        step=2e-3,
        resolution=0.02,
        manoeuvre="2 s without commands while wheels turn",
    ),
)
"""Of all wheels, as the fields of `BoardModel`."""
DELAY, WINDOW, TIMEOUT = range(-len(BOARD_PARAMETERS), 0)
"""Places of the board's numbers in the vector of parameters, behind those of the wheels."""

SEARCHED_LAGS = (0.03, 0.08, 0.2)
SEARCHED_SLOWNESSES = (0.005, 0.03)
SEARCHED_DELAYS = np.arange(0.0, 0.25, 0.02)
SEARCHED_DEADBANDS = (0.05, 0.4, 0.8)
SEARCHED_WINDOWS = (0.015, 0.05, 0.1)
"""Starting points: lags, ramps, delays and deadbands of a search, then averaging times."""
NO_TIMEOUT = 3600.0
"""Time-out of a board that has none [s]."""
TIMEOUT_GRID = 0.02
"""Distance of the searched time-outs [s]; nearer than what least squares moves."""
LONGEST_TIMEOUT = 5.0
"""Longest searched time-out [s]: pauses are hardly longer."""
LEAST_LOSS_SCALE = 0.1
"""Least residual at which the loss becomes linear [rad/s]: an encoder count, so that a fit finds
the mean of two counts and not the more frequent one."""
CORRELATED_LINES = 5.0
"""Neighbouring lines that count as one beside the priors."""
NORMAL_MEDIAN = 1.48
"""Standard deviation of a normal distribution by its median size."""
LEAST_NOISE = 0.003
"""Two decimals scatter by so much [rad/s]."""
RESIDUAL_BLOCK = 0.5
"""Residuals within such a time and of one wheel may depend on each other [s]."""
ABOVE_TOP = 1.05
"""Lines that are faster than this share of the configured top speed show that it isn't the top."""
LEAST_CUT = 0.1
"""Finer steps hide whether speeds are cut to them or rounded [rad/s]."""
CLEARLY_LESS = 0.95
"""Share of the cost below which speeds are cut, not rounded."""
ALIKE = 0.995
"""Share of a cost that is as good: noise moves costs by so much."""
SEARCH_EVALUATIONS = 10
EVALUATIONS = 40
"""Evaluations of the residuals from a starting point, and to the end, at most."""


@dataclass(frozen=True, eq=False)
class FitProblem:
    """Tracks of one robot, the wheels that turned, and the model's residuals.

    Parameters are one vector: those of each wheel, then the board's.
    """

    tracks: Sequence[BoardTrack]
    wheels: tuple[int, ...]
    responder: Responder
    prior: Floats
    """Means of the parameters."""

    @property
    def rows(self) -> tuple[Parameter, ...]:
        """The row of the table for each parameter."""
        return WHEEL_PARAMETERS * len(self.wheels) + BOARD_PARAMETERS

    @property
    def deviations(self) -> Floats:
        """Of the priors."""
        return np.array([row.deviation for row in self.rows])

    @property
    def held_out(self) -> Bools:
        """Which lines of all tracks the fit doesn't see."""
        return np.concatenate([track.held_out for track in self.tracks])

    def split(self, x: Floats) -> tuple[list[WheelModel], BoardModel]:
        """Name the numbers of a parameter vector."""
        values = [row.from_fit(number) for row, number in zip(self.rows, x.tolist(), strict=True)]
        wheels = np.reshape(values[:DELAY], (-1, len(WHEEL_PARAMETERS))).tolist()
        return [WheelModel(*wheel) for wheel in wheels], BoardModel(*values[DELAY:])

    def join(self, wheels: Sequence[WheelModel], times: BoardModel) -> Floats:
        """Make a parameter vector; values beyond the bounds are moved to them."""
        values = [*itertools.chain.from_iterable(wheels), *times]
        return np.array([row.to_fit(value) for row, value in zip(self.rows, values, strict=True)])

    def residuals(self, x: Floats) -> Floats:
        """By how much all lines are off, (wheels, lines) [rad/s]."""
        models, times = self.split(x)
        return np.array([self.wheel_residuals(k, model, times) for k, model in enumerate(models)])

    def wheel_residuals(self, place: int, model: WheelModel, times: BoardModel) -> Floats:
        """By how much all lines of one wheel are off [rad/s]."""
        return self.responder.residuals(self.tracks, self.wheels[place], model, times)

    def jacobian(self, x: Floats, base: Floats) -> Floats:
        """Derivatives of the residuals, (wheels, lines, parameters), given these."""
        columns = np.zeros((*base.shape, len(x)))
        width = len(WHEEL_PARAMETERS)
        for k in range(len(self.wheels)):
            for p in (*range(k * width, (k + 1) * width), DELAY, WINDOW, TIMEOUT):
                moved = x.copy()
                moved[p] += self.rows[p].step
                models, times = self.split(moved)
                columns[k, :, p] = (
                    self.wheel_residuals(k, models[k], times) - base[k]
                ) / self.rows[p].step
        return columns

    def blocks(self) -> NDArray[np.intp]:
        """Number of the block of time that each line belongs to."""
        first = 0
        numbers = []
        for track in self.tracks:
            block = ((track.stamps - track.stamps[0]) / RESIDUAL_BLOCK).astype(np.intp)
            numbers.append(first + block)
            first += int(block[-1]) + 1
        return np.concatenate(numbers)


@dataclass(frozen=True, eq=False)
class MotorFit:
    """What was fitted of wheels and board."""

    problem: FitProblem
    x: Floats
    """The parameters."""
    spread: Floats
    """Their covariance."""
    slack: Floats
    """By how much the board's times differ from those of other starting points that fit as well."""
    residuals: Floats
    """By how much all lines are off, (wheels, lines) [rad/s]."""
    jacobian: Floats
    """Derivatives of the residuals, (wheels, lines, parameters)."""

    @property
    def wheels(self) -> list[WheelModel]:
        """Motors of the wheels that turned."""
        return self.problem.split(self.x)[0]

    @property
    def times(self) -> BoardModel:
        """Times of the board."""
        return self.problem.split(self.x)[1]


def configured_wheel(config: RobotConfig, wheel: int) -> WheelModel:
    """Make the model of one wheel from a robot's configuration."""
    motor = config.motor.of_wheel(wheel)
    return WheelModel(motor.time_constant, motor.gain, 1.0 / motor.acceleration, motor.deadband)


def configured_times(config: RobotConfig) -> BoardModel:
    """Make the board's times from a robot's configuration."""
    board = config.firmware
    timeout = board.command_timeout or NO_TIMEOUT
    return BoardModel(board.command_delay, config.encoder.window, timeout)


def fit_tracks(
    tracks: Sequence[BoardTrack], wheels: Sequence[int], config: RobotConfig, step: float
) -> MotorFit:
    """Fit motors and board.

    Args:
        tracks: Tracks of one robot.
        wheels: Those that turned.
        config: The robot; gains and averaging time are expected to be nearly its.
        step: Step of the printed speeds [rad/s].
    """
    problem = make_problem(tracks, wheels, config, Rounding(step))
    start = _search_start(problem)
    problem = replace(problem, prior=_with(problem.prior, TIMEOUT, start[TIMEOUT]))

    # The cost is flat along averaging times with the same middle, and has several minima.
    best = _solve(problem, start, EVALUATIONS)
    fits = [best]
    for window in SEARCHED_WINDOWS:
        delay = best[DELAY] + (best[WINDOW] - window) / 2.0
        moved = _with(_with(best, WINDOW, window), DELAY, max(0.0, delay))
        fits.append(_solve(problem, moved, SEARCH_EVALUATIONS))
    best = min(fits, key=lambda x: _cost(problem, x))
    if step > LEAST_CUT:
        cuts = replace(problem, responder=replace(problem.responder, rounding=Rounding(step, True)))
        cut = _solve(cuts, best, SEARCH_EVALUATIONS)
        if _cost(cuts, cut) < CLEARLY_LESS * _cost(problem, best):
            problem = cuts
            best = cut
    x = _solve(problem, best, EVALUATIONS)
    similar = [x, *(near for near in fits if ALIKE * _cost(problem, near) < _cost(problem, x))]

    residuals = problem.residuals(x)
    jacobian = problem.jacobian(x, residuals)
    spread = _estimate_spread(problem, residuals, jacobian)
    slack = np.abs(np.array(similar) - x).max(axis=0)
    slack[:DELAY] = 0.0
    return MotorFit(problem, x, spread, slack, residuals=residuals, jacobian=jacobian)


def make_problem(
    tracks: Sequence[BoardTrack], wheels: Sequence[int], config: RobotConfig, rounding: Rounding
) -> FitProblem:
    """Make the problem of a robot with this loop rate and top speed.

    Feedback in another unit exceeds the top speed, and then nothing is known of that.
    """
    fastest = max(float(np.abs(track.speeds).max()) for track in tracks)
    top = config.motor.max_speed
    if fastest > ABOVE_TOP * top:
        top = 1.1 * fastest
    responder = Responder(1.0 / config.firmware.loop_rate, top, rounding)
    problem = FitProblem(tracks, tuple(wheels), responder, np.empty(0))
    usual = WheelModel(*(row.mean for row in WHEEL_PARAMETERS))
    models = [usual._replace(gain=configured_wheel(config, wheel).gain) for wheel in wheels]
    times = BoardModel(*(row.mean for row in BOARD_PARAMETERS))
    return replace(
        problem, prior=problem.join(models, times._replace(window=config.encoder.window))
    )


def _with(x: Floats, place: int, value: float) -> Floats:
    moved = x.copy()
    moved[place] = value
    return moved


def _cost(problem: FitProblem, x: Floats) -> float:
    """Sum of the sizes of the residuals that a fit sees, which outliers hardly change."""
    return float(np.abs(problem.residuals(x)[:, ~problem.held_out]).sum())


def _search_start(problem: FitProblem) -> Floats:
    """Search delay, lags and deadbands on a grid, then the time-out."""
    models, times = problem.split(problem.prior)
    times = times._replace(timeout=NO_TIMEOUT)
    starts: list[tuple[float, float, list[WheelModel]]] = []
    for delay in SEARCHED_DELAYS.tolist():
        times = times._replace(delay=delay)
        wheels = [_search_wheel(problem, k, model, times) for k, model in enumerate(models)]
        starts.append((sum(cost for cost, _ in wheels), delay, [model for _, model in wheels]))
    _, delay, models = min(starts)
    x = problem.join(models, times._replace(delay=delay))

    longest = max(track.longest_pause for track in problem.tracks)
    timeouts = np.arange(TIMEOUT_GRID, min(longest, LONGEST_TIMEOUT), TIMEOUT_GRID).tolist()
    tried = [_with(x, TIMEOUT, timeout) for timeout in (NO_TIMEOUT, *timeouts)]
    return min(tried, key=lambda start: _cost(problem, start))


def _search_wheel(
    problem: FitProblem, place: int, model: WheelModel, times: BoardModel
) -> tuple[float, WheelModel]:
    """Search lag and deadband of one wheel; its gain is linear. Returns the cost, too."""
    chosen = ~problem.held_out
    wheel = problem.wheels[place]
    printed = np.concatenate([track.speeds[:, wheel] for track in problem.tracks])[chosen]
    candidates = []
    searched = itertools.product(SEARCHED_LAGS, SEARCHED_SLOWNESSES, SEARCHED_DEADBANDS)
    for lag, slowness, deadband in searched:
        tried = model._replace(lag=lag, slowness=slowness, deadband=deadband)
        answer = problem.wheel_residuals(place, tried, times)[chosen] + printed
        factor = float(answer @ printed) / max(float(answer @ answer), 1e-9)
        cost = float(np.abs(factor * answer - printed).sum())
        candidates.append((cost, tried._replace(gain=factor * model.gain)))
    return min(candidates)


def _solve(problem: FitProblem, start: Floats, evaluations: int) -> Floats:
    """Fit all parameters by robust least squares."""
    chosen = ~problem.held_out
    errors = problem.residuals(start)[:, chosen]
    scale = _loss_scale(errors)
    noise = NORMAL_MEDIAN * float(np.median(np.abs(errors)))
    weight = 1.0 / (scale * math.sqrt(CORRELATED_LINES))
    deviations = problem.deviations * max(1.0, scale / max(noise, LEAST_NOISE))
    low, high = np.array([[row.to_fit(end) for end in row.bounds] for row in problem.rows]).T

    def residuals(x: Floats) -> Floats:
        lines = problem.residuals(x)[:, chosen].ravel() * weight
        return np.append(lines, (x - problem.prior) / deviations)

    def jacobian(x: Floats) -> Floats:
        base = problem.residuals(x)
        lines = problem.jacobian(x, base)[:, chosen].reshape(-1, len(x)) * weight
        return np.vstack((lines, np.diag(1.0 / deviations)))

    result = optimize.least_squares(
        residuals,
        np.clip(start, low + 1e-9, high - 1e-9),
        jac=jacobian,
        bounds=(low, high),
        loss="soft_l1",
        f_scale=1.0 / math.sqrt(CORRELATED_LINES),
        x_scale="jac",
        ftol=1e-6,
        xtol=1e-6,
        tr_solver="lsmr",  # the exact solver decomposes the whole matrix, ten times as slowly
        max_nfev=evaluations,
    )
    return np.asarray(result.x)


def _loss_scale(residuals: Floats) -> float:
    """Residual at which the loss becomes linear [rad/s]."""
    return max(LEAST_LOSS_SCALE, 1.5 * float(np.median(np.abs(residuals))))


def _estimate_spread(problem: FitProblem, residuals: Floats, jacobian: Floats) -> Floats:
    """Covariance of the parameters, with residuals that depend on each other in blocks.

    Residuals of quantized, averaged speeds are correlated, so it is that of blocks (the
    "sandwich"). What no line shows has the prior's.
    """
    chosen = ~problem.held_out
    errors = residuals[:, chosen].ravel()
    columns = jacobian[:, chosen].reshape(len(errors), -1)
    scale = _loss_scale(errors)
    weights = 1.0 / np.sqrt(1.0 + (errors / scale) ** 2)  # of soft_l1

    blocks = problem.blocks()
    numbers = np.arange(len(problem.wheels))[:, None] * (blocks.max() + 1) + blocks[chosen]
    scores = np.zeros((int(numbers.max()) + 1, columns.shape[1]))
    np.add.at(scores, numbers.ravel(), columns * (weights * errors)[:, None])
    meat = scores.T @ scores

    # The prior counts as much as lines do whose noise is that of the residuals.
    variance = float(np.mean((weights * errors) ** 2)) * CORRELATED_LINES
    prior = np.diag(variance / problem.deviations**2)
    curvature = columns.T @ (columns * weights[:, None] ** 3) + prior
    bread = np.linalg.inv(curvature)
    return np.asarray(bread @ (meat + variance * prior) @ bread)
