"""The estimator: motors and board by robust least squares, with usual values as priors.

`WHEEL_PARAMETERS` and `BOARD_PARAMETERS` are the table of what is fitted. Priors are residuals like
any other, so a parameter that a log doesn't show stays at its prior, and so does its covariance.
`fit_tracks` reads top to bottom: a coarse search, least squares from a few averaging times, the
kind of rounding, then the covariance.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, require_extra
from acsar_gym.protocol import WHEELS
from acsar_gym.recording.types import Floats
from acsar_gym.tools.sysid.board_log import BoardTrack
from acsar_gym.tools.sysid.response import BoardModel, Responder, Rounding, WheelModel

with require_extra("identification", "scipy"):
    from scipy import optimize


class Parameter(NamedTuple):
    """A row of the table of what is fitted."""

    name: str
    """Field of the robot's file. A ramp is fitted as the inverse of its field."""
    mean: float
    """Usual value, unless the robot's file is taken for it."""
    deviation: float
    """Standard deviation of robots from that value. Of a logarithm, as a share."""
    bounds: tuple[float, float]
    """Least and largest value that a fit tries."""
    step: float
    """Step of its derivative."""
    resolution: float
    """Least half width of an interval for a log of any length, since the phases of the board's
    loops move values by this."""
    is_log: bool = False
    """Whether the logarithm is fitted."""
    is_configured: bool = False
    """Whether the prior's mean is the value of the robot's file."""
    manoeuvre: str = "sudden changes of 4 rad/s or more, each held for 0.3 s"
    """What narrows it."""

    @property
    def missing_note(self) -> str:
        """Why it is kept if a log doesn't narrow it."""
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
        is_configured=True,
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
"""Parameters of each wheel, as the fields of `WheelModel`."""
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
        is_configured=True,
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
"""Parameters of all wheels, as the fields of `BoardModel`."""
DELAY, WINDOW, TIMEOUT = range(-len(BOARD_PARAMETERS), 0)
"""Places of the board's parameters in the vector of parameters, after those of the wheels."""

SEARCHED_LAGS = (0.03, 0.08, 0.2)
SEARCHED_SLOWNESSES = (0.005, 0.03)
SEARCHED_DELAYS = np.arange(0.0, 0.25, 0.02)
SEARCHED_DEADBANDS = (0.05, 0.4, 0.8)
SEARCHED_WINDOWS = (0.015, 0.05, 0.1)
"""Starting points: lags, ramps, delays and deadbands of a search, then averaging times."""
NO_TIMEOUT = 3600.0
"""Time-out of a board that has none [s]."""
TIMEOUT_GRID = 0.02
"""Distance of the searched time-outs [s], which least squares moves by more."""
LONGEST_TIMEOUT = 5.0
"""Longest searched time-out [s]. Pauses are hardly longer."""
LEAST_LOSS_SCALE = 0.1
"""Least residual at which the loss becomes linear [rad/s]: an encoder count, so that a fit finds
the mean of two counts and not the more frequent count."""
CORRELATED_LINES = 5.0
"""Number of neighbouring lines that weigh as much as a single measurement against the priors."""
NORMAL_MEDIAN = 1.48
"""Standard deviation of a normal distribution by its median size."""
LEAST_NOISE = 0.003
"""Scatter of numbers with two decimals [rad/s]."""
RESIDUAL_BLOCK = 0.5
"""Residuals of a wheel within this time may depend on each other [s]."""
ABOVE_TOP = 1.05
"""Lines that are faster than this share of the configured top speed disprove it."""
LEAST_CUT = 0.1
"""Finer steps hide whether speeds are cut to them or rounded [rad/s]."""
CLEARLY_LESS = 0.95
"""Share of the cost below which speeds are cut, not rounded."""
ALIKE = 0.995
"""Share of a cost that counts as equal, since noise moves costs by as much."""
ANSWER_CORRELATION = 0.5
"""Least correlation of a wheel's speed with the answer to a command."""
ANSWER_ADVANTAGE = 0.3
"""By how much another command must explain a wheel's speed better than the wheel's own command."""
SEARCH_EVALUATIONS = 10
EVALUATIONS = 40
"""Largest numbers of evaluations of the residuals, from a starting point and of the final fit."""


class FitProblem:
    """Tracks of a robot, the wheels that turned, and the model's residuals.

    Parameters are a vector: those of each wheel, then the board's.

    Attributes:
        tracks: Tracks of the robot.
        wheels: Wheels that turned.
        rows: Row of the table for each parameter.
        bounds: Least and largest vector, (2, parameters).
        responder: Computes the model's answers.
        configured: Vector of the robot's file.
        prior: Means of the parameters.
        deviations: Standard deviations of the priors.
        held_out: Whether the fit doesn't see a line, for the lines of all tracks.

    Args:
        tracks: Tracks of the robot.
        wheels: Wheels that turned.
        config: Robot configuration.
        rounding: How speeds are printed.
    """

    def __init__(
        self,
        tracks: Sequence[BoardTrack],
        wheels: Sequence[int],
        config: RobotConfig,
        rounding: Rounding,
    ) -> None:
        self.tracks = tracks
        self.wheels = wheels
        self.rows = WHEEL_PARAMETERS * len(wheels) + BOARD_PARAMETERS
        self.bounds = np.array([[row.to_fit(end) for end in row.bounds] for row in self.rows]).T
        self.deviations = np.array([row.deviation for row in self.rows])
        self.held_out = np.concatenate([track.held_out for track in tracks])
        self.printed = np.concatenate([track.speeds for track in tracks]).T

        # Feedback in another unit exceeds the top speed, which is unknown then.
        top = config.motor.max_speed
        fastest = float(np.abs(self.printed).max())
        if fastest > ABOVE_TOP * top:
            top = 1.1 * fastest
        self.responder = Responder(tracks, 1.0 / config.firmware.loop_rate, top, rounding)

        # The robot's file is what the fit is compared with, and part of its prior.
        values: list[float] = []
        for motor in map(config.motor.of_wheel, wheels):
            values += (motor.time_constant, motor.gain, 1.0 / motor.acceleration, motor.deadband)
        board = config.firmware
        values += (board.command_delay, config.encoder.window, board.command_timeout or NO_TIMEOUT)
        self.configured = self.join(values)
        usual = self.join([row.mean for row in self.rows])
        self.prior = np.where([row.is_configured for row in self.rows], self.configured, usual)

    def join(self, values: Sequence[float]) -> Floats:
        """Make a parameter vector of the values of all parameters."""
        return np.array([row.to_fit(value) for row, value in zip(self.rows, values, strict=True)])

    def split(self, x: Floats) -> tuple[list[WheelModel], BoardModel]:
        """Name the numbers of a parameter vector."""
        values = [row.from_fit(number) for row, number in zip(self.rows, x.tolist(), strict=True)]
        wheels = np.reshape(values[:DELAY], (-1, len(WHEEL_PARAMETERS))).tolist()
        return [WheelModel(*wheel) for wheel in wheels], BoardModel(*values[DELAY:])

    def residuals(self, x: Floats) -> Floats:
        """Return the errors of all lines, (wheels, lines) [rad/s]."""
        models, times = self.split(x)
        pairs = zip(self.wheels, models, strict=True)
        answers = [self.responder.answers(wheel, model, times) for wheel, model in pairs]
        return np.asarray(np.array(answers) - self.printed[self.wheels])

    def jacobian(self, x: Floats, base: Floats) -> Floats:
        """Return the derivatives of these residuals, (wheels, lines, parameters)."""
        # Differences, as the twin's ramp and deadband have no derivative in closed form.
        columns = np.zeros((*base.shape, len(x)))
        width = len(WHEEL_PARAMETERS)
        for k, wheel in enumerate(self.wheels):
            # A wheel's residuals depend on its own parameters and on the board's.
            for p in (*range(k * width, (k + 1) * width), DELAY, WINDOW, TIMEOUT):
                step = self.rows[p].step
                models, times = self.split(_with(x, p, x[p] + step))
                answer = self.responder.answers(wheel, models[k], times)
                columns[k, :, p] = (answer - self.printed[wheel] - base[k]) / step
        return columns

    def cost(self, x: Floats) -> float:
        """Return the sum of the errors that a fit sees, which outliers hardly change."""
        return float(np.abs(self.residuals(x)[:, ~self.held_out]).sum())

    def blocks(self) -> NDArray[np.intp]:
        """Return the number of each line's block of time."""
        # Blocks of different tracks have different numbers.
        numbers = [np.full(1, -1)]
        for track in self.tracks:
            block = ((track.stamps - track.stamps[0]) / RESIDUAL_BLOCK).astype(np.intp)
            numbers.append(numbers[-1][-1] + 1 + block)
        return np.concatenate(numbers[1:])


class MotorFit(NamedTuple):
    """What was fitted of wheels and board."""

    problem: FitProblem
    x: Floats
    """Parameters."""
    spread: Floats
    """Covariance of the parameters."""
    slack: Floats
    """Distance of the board's times from those of other starting points that fit as well."""
    residuals: Floats
    """Errors of all lines, (wheels, lines) [rad/s]."""
    jacobian: Floats
    """Derivatives of the residuals, (wheels, lines, parameters)."""


def fit_tracks(
    tracks: Sequence[BoardTrack], wheels: Sequence[int], config: RobotConfig, step: float
) -> MotorFit:
    """Fit motors and board.

    Args:
        tracks: Tracks of a robot.
        wheels: Wheels that turned.
        config: Robot configuration. Gains and averaging time are expected to be nearly its.
        step: Step of the printed speeds [rad/s].

    Raises:
        AcsarError: A wheel doesn't answer its own command.
    """
    problem = FitProblem(tracks, wheels, config, Rounding(step))
    # Wheels in another order would be fitted to wrong commands.
    check_wheel_order(problem)
    start = _search_start(problem)
    problem.prior[TIMEOUT] = start[TIMEOUT]

    # The cost is flat along averaging times with the same middle, and has several minima.
    best = _solve(problem, start, EVALUATIONS)
    fits = [best]
    for window in SEARCHED_WINDOWS:
        delay = best[DELAY] + (best[WINDOW] - window) / 2.0
        moved = _with(_with(best, WINDOW, window), DELAY, max(0.0, delay))
        fits.append(_solve(problem, moved, SEARCH_EVALUATIONS))
    best = min(fits, key=problem.cost)

    # Boards that compute in integers cut their speeds to coarse steps.
    if step > LEAST_CUT:
        cuts = FitProblem(tracks, wheels, config, Rounding(step, is_cut=True))
        cuts.prior = problem.prior
        cut = _solve(cuts, best, SEARCH_EVALUATIONS)
        if cuts.cost(cut) < CLEARLY_LESS * problem.cost(best):
            problem = cuts
            best = cut

    # The best start is fitted to the end. Others that fit as well widen the intervals of times.
    x = _solve(problem, best, EVALUATIONS)
    alike = [x, *(fit for fit in fits if ALIKE * problem.cost(fit) < problem.cost(x))]
    slack = np.abs(np.array(alike) - x).max(axis=0)
    slack[:DELAY] = 0.0
    residuals = problem.residuals(x)
    jacobian = problem.jacobian(x, residuals)
    spread = _estimate_spread(problem, residuals, jacobian)
    return MotorFit(problem, x, spread, slack, residuals=residuals, jacobian=jacobian)


def check_wheel_order(problem: FitProblem) -> None:
    """Check that the speeds of each wheel are like a usual wheel's answer to its own command.

    Raises:
        AcsarError: A wheel turns backward, or answers another wheel's command.
    """
    advice = "run 'acsar-gym doctor DEVICE --spin --out FILE' first, and give the file as --robot"
    if problem.tracks[0].in_ros:
        advice = "name the joints in the order a, b, c, d in ros2.joints of the robot's file"
    advice += "; nothing was fitted"

    # The answers of a usual wheel to all commands, at any delay, compared with the speeds of each
    # wheel. Periodic commands correlate with both signs, and then a wheel isn't reversed.
    models, times = problem.split(problem.prior)
    delays = [
        _correlate(problem, models[0], times._replace(delay=delay))
        for delay in SEARCHED_DELAYS.tolist()
    ]
    highest = np.max(delays, axis=0)
    lowest = np.min(delays, axis=0)
    correlations = np.where(highest >= -lowest - ANSWER_ADVANTAGE, highest, lowest)
    for wheel in problem.wheels:
        row = correlations[wheel]
        best = int(np.argmax(np.abs(row)))
        if abs(row[best]) > max(ANSWER_CORRELATION, abs(row[wheel]) + ANSWER_ADVANTAGE):
            way = " backward" if row[best] < 0.0 else ""
            raise AcsarError(f"{WHEELS[wheel]} answers {WHEELS[best]}'s command{way}: {advice}")
        if row[wheel] < -ANSWER_CORRELATION:
            raise AcsarError(f"{WHEELS[wheel]} turns backward at forward commands: {advice}")


def _correlate(problem: FitProblem, model: WheelModel, times: BoardModel) -> Floats:
    """Return the correlation of each wheel's speeds (rows) with the answer to each command."""
    speeds = problem.printed
    answers = [problem.responder.answers(wheel, model, times) for wheel in range(len(WHEELS))]
    sizes = np.sqrt(np.outer(np.square(speeds).sum(axis=1), np.square(answers).sum(axis=1)))
    return np.asarray(speeds @ np.transpose(answers) / np.maximum(sizes, 1e-9))


def _with(x: Floats, place: int, value: float) -> Floats:
    """Return a copy of a vector with another number at a place."""
    moved = x.copy()
    moved[place] = value
    return moved


def _search_start(problem: FitProblem) -> Floats:
    """Search delay, lags and deadbands on a grid, then the time-out."""
    # Delay and lag explain the same lines, so that both are searched together.
    starts = []
    for delay in SEARCHED_DELAYS.tolist():
        x = _with(_with(problem.prior, TIMEOUT, NO_TIMEOUT), DELAY, delay)
        models, times = problem.split(x)
        costs, wheels = zip(
            *(_search_wheel(problem, k, model, times) for k, model in enumerate(models)),
            strict=True,
        )
        starts.append((sum(costs), problem.join([*itertools.chain(*wheels), *times])))
    _, chosen = min(starts, key=lambda start: start[0])

    # Least squares doesn't find a time-out from far away, as it changes few lines.
    longest = max(track.longest_pause for track in problem.tracks)
    timeouts = np.arange(TIMEOUT_GRID, min(longest, LONGEST_TIMEOUT), TIMEOUT_GRID).tolist()
    tried = [_with(chosen, TIMEOUT, timeout) for timeout in (NO_TIMEOUT, *timeouts)]
    return min(tried, key=problem.cost)


def _search_wheel(
    problem: FitProblem, place: int, model: WheelModel, times: BoardModel
) -> tuple[float, WheelModel]:
    """Search lag and deadband of a wheel, whose gain is linear. Returns the cost as well."""
    fitted = ~problem.held_out
    wheel = problem.wheels[place]
    printed = problem.printed[wheel, fitted]
    candidates = []
    searched = itertools.product(SEARCHED_LAGS, SEARCHED_SLOWNESSES, SEARCHED_DEADBANDS)
    for lag, slowness, deadband in searched:
        tried = model._replace(lag=lag, slowness=slowness, deadband=deadband)
        answer = problem.responder.answers(wheel, tried, times)[fitted]

        # The best gain is that of a straight line through the origin.
        factor = float(answer @ printed) / max(float(answer @ answer), 1e-9)
        cost = float(np.abs(factor * answer - printed).sum())
        candidates.append((cost, tried._replace(gain=factor * model.gain)))
    return min(candidates)


def _solve(problem: FitProblem, start: Floats, evaluations: int) -> Floats:
    """Fit all parameters by robust least squares."""
    fitted = ~problem.held_out

    # Outliers such as damaged lines count less. Their scale comes from the start.
    errors = problem.residuals(start)[:, fitted]
    scale = _loss_scale(errors)
    noise = NORMAL_MEDIAN * float(np.median(np.abs(errors)))
    weight = 1.0 / (scale * math.sqrt(CORRELATED_LINES))
    deviations = problem.deviations * max(1.0, scale / max(noise, LEAST_NOISE))
    low, high = problem.bounds

    def residuals(x: Floats) -> Floats:
        lines = problem.residuals(x)[:, fitted].ravel() * weight
        return np.append(lines, (x - problem.prior) / deviations)

    def jacobian(x: Floats) -> Floats:
        columns = problem.jacobian(x, problem.residuals(x))
        lines = columns[:, fitted].reshape(-1, len(x)) * weight
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
    """Return the residual at which the loss becomes linear [rad/s]."""
    return max(LEAST_LOSS_SCALE, 1.5 * float(np.median(np.abs(residuals))))


def _estimate_spread(problem: FitProblem, residuals: Floats, jacobian: Floats) -> Floats:
    """Return the covariance of the parameters for residuals that depend on each other in blocks.

    Residuals of quantized, averaged speeds are correlated, so it is that of blocks (the
    "sandwich"). A parameter that no line shows has the prior's.
    """
    fitted = ~problem.held_out
    # Outliers weigh as little in the interval as they do in the fit.
    errors = residuals[:, fitted].ravel()
    columns = jacobian[:, fitted].reshape(len(errors), -1)
    weights = 1.0 / np.sqrt(1.0 + (errors / _loss_scale(errors)) ** 2)  # of soft_l1

    blocks = problem.blocks()
    numbers = np.arange(len(problem.wheels))[:, None] * (blocks.max() + 1) + blocks[fitted]
    scores = np.zeros((int(numbers.max()) + 1, columns.shape[1]))
    np.add.at(scores, numbers.ravel(), columns * (weights * errors)[:, None])

    # The prior counts as much as lines do whose noise is that of the residuals.
    variance = float(np.mean((weights * errors) ** 2)) * CORRELATED_LINES
    prior = np.diag(variance / problem.deviations**2)
    curvature = columns.T @ (columns * weights[:, None] ** 3) + prior
    bread = np.linalg.inv(curvature)
    return np.asarray(bread @ (scores.T @ scores + variance * prior) @ bread)
