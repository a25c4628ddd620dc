"""From tracks to estimates: wheels and clock by least squares, deadbands by their cost, in turn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.identification import deadband, pauses, quantum, solving
from acsar_gym.identification.deadband import Deadband, Printed
from acsar_gym.identification.knowable import Knowable
from acsar_gym.identification.problem import Problem
from acsar_gym.identification.response import Clock, Wheel
from acsar_gym.identification.solving import NEVER, Solution
from acsar_gym.identification.tracks import Track
from acsar_gym.protocol import MOTORS

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SMOOTH_NAMES = ("motor.time_constant", "motor.gain", "motor.acceleration")
"""Parameters of a wheel in the problem's order."""
SURE = 2.5
"""A window as configured is given up for one that differs by so many standard errors."""
VAGUE = 0.006
"""A window with a larger standard error stays as configured [s]."""
MOST_LOOPS = 60
"""Longest window that is compared with the printed counts [loops]."""


@dataclass(frozen=True, eq=False)
class Estimate:
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

    problem: Problem
    solution: Solution
    spread: Floats
    slack: Floats
    deadbands: tuple[Deadband | None, ...]
    quantum: quantum.Quantum | None
    printed: Printed
    counted: bool

    @property
    def motors(self) -> list[Wheel]:
        """Parameters of the wheels."""
        return self.problem.split(self.solution.x, self.solution.deadbands)[0]

    @property
    def clock(self) -> Clock:
        """Times of the board."""
        return self.problem.split(self.solution.x, self.solution.deadbands)[1]


def motor_of(config: RobotConfig, wheel: int) -> Wheel:
    """Make the motor of one wheel from a robot's configuration."""
    own = config.motor.of_wheel(wheel)
    return Wheel(own.time_constant, own.gain, 1.0 / own.acceleration, own.deadband)


def clock_of(config: RobotConfig) -> Clock:
    """Make the board's times from a robot's configuration."""
    board = config.firmware
    return Clock(board.command_delay, config.encoder.window, board.command_timeout or NEVER)


def estimated(tracks: Sequence[Track], config: RobotConfig, known: Knowable) -> Estimate | None:
    """Fit what a log can tell.

    Args:
        tracks: of one robot.
        config: of the robot; what the log can't tell stays as configured.
        known: what it can tell.

    Returns:
        The fit; None where the log tells nothing of any wheel.
    """
    wheels = [k for k, w in enumerate(MOTORS) if any(known.can(n, w) for n in SMOOTH_NAMES)]
    if not wheels:
        return None
    problem = Problem.of(tracks, wheels, config)
    steps = quantum.found(np.concatenate([track.speeds for track in tracks]))
    free = _free(problem, known)
    x, bands = _start(problem, config, known, free)
    solution = solving.searched(problem, x, bands, free)
    solution, printed, found = _in_turn(problem, solution, config, known, steps)
    spread = solving.covariance(problem, solution)
    slack = solving.slack(problem, solution)
    counted = bool(free[-2] != solution.free[-2])
    return Estimate(problem, solution, spread, slack, found, steps, printed, counted)


def _free(problem: Problem, known: Knowable) -> Bools:
    """Which parameters the log can tell."""
    # Ramp and delay are fitted with every lag, even where the log can't tell them apart.
    names = ("motor.time_constant", "motor.gain", "motor.time_constant")
    rows = [known.can(name, MOTORS[w]) for w in problem.wheels for name in names]
    delay = any(known.can("motor.time_constant", MOTORS[w]) for w in problem.wheels)
    return np.array([*rows, delay, delay, known.can("firmware.command_timeout")])


def _start(
    problem: Problem, config: RobotConfig, known: Knowable, free: Bools
) -> tuple[Floats, list[float]]:
    """First parameters and deadbands; decides in `free` whether there is a time-out to fit."""
    configured = [motor_of(config, w) for w in problem.wheels]
    clock = clock_of(config)
    if free[-1]:
        guess = pauses.guess(problem.tracks)
        free[-1] = np.isfinite(guess)
        clock = clock._replace(timeout=min(guess, NEVER))
    bands = [_usual_band(problem, known, config, k) or 0.0 for k in range(len(configured))]
    x = problem.joined(configured, clock)
    if not free[-3]:
        return x, bands
    for _ in range(2):
        rough = solving.coarse(problem, bands, clock.window, clock.timeout)
        motors, rough_clock = problem.split(rough, bands)
        for k in range(len(bands)):
            usual = _usual_band(problem, known, config, k)
            one = deadband.found(problem, k, motors[k], rough_clock, Printed(0.0, 0.0), usual)
            bands[k] = one.value
    if free[-1]:
        rough[-1] = pauses.refined(problem, motors, rough_clock)
    return np.where(free, rough, x), bands


def _usual_band(problem: Problem, known: Knowable, config: RobotConfig, k: int) -> float | None:
    """The configured deadband of a wheel of which the log can't tell one; otherwise None."""
    wheel = problem.wheels[k]
    told = known.can("motor.deadband", MOTORS[wheel])
    return None if told else motor_of(config, wheel).deadband


def _in_turn(
    problem: Problem,
    solution: Solution,
    config: RobotConfig,
    known: Knowable,
    steps: quantum.Quantum | None,
) -> tuple[Solution, Printed, tuple[Deadband | None, ...]]:
    """Fit deadbands with the rest given, and the rest with the deadbands given, twice."""
    found: list[Deadband | None] = [None] * len(problem.wheels)
    solution, printed = _rounded(problem, solution, config, steps)
    for _ in range(2):
        motors, clock = problem.split(solution.x, solution.deadbands)
        bands = list(solution.deadbands)
        for k in range(len(bands)):
            usual = _usual_band(problem, known, config, k)
            one = deadband.found(problem, k, motors[k], clock, printed, usual)
            found[k], bands[k] = one if usual is None else None, one.value
        solution = solving.solve(problem, solution.x, bands, solution.free)
    return solution, printed, tuple(found)


def _rounded(
    problem: Problem, solution: Solution, config: RobotConfig, steps: quantum.Quantum | None
) -> tuple[Solution, Printed]:
    """Find how the board rounds, and hold the window where something better than the fit tells it.

    That are whole encoder counts, which tell it exactly, or else the config, unless the fit is
    sure of another one.
    """
    printed, window = printed_by(problem, config, solution.x[-2], steps)
    free, x = solution.free.copy(), solution.x.copy()
    if window is None and free[-2]:
        sigma = math.sqrt(solving.covariance(problem, solution)[-2, -2])
        away = abs(x[-2] - config.encoder.window)
        if sigma > VAGUE or away < max(SURE * sigma, problem.dt):
            window = config.encoder.window
    if window is not None and free[-2]:
        x[-2], free[-2] = window, False
    return solving.solve(problem, x, solution.deadbands, free), printed


def printed_by(
    problem: Problem, config: RobotConfig, window: float, steps: quantum.Quantum | None
) -> tuple[Printed, float | None]:
    """How a board rounds its speeds: by its encoder's counts, a step of its own, or both.

    Returns:
        The rounding; and the window, if whole counts tell it exactly [s].
    """
    step = steps.step if steps else 0.0
    speeds = np.concatenate([track.speeds for track in problem.tracks])
    for n in range(1, MOST_LOOPS + 1):  # the coarsest counts: finer ones explain multiples, too
        counts = quantum.of_counts(config, n * problem.dt)
        own = 0.0 if abs(counts - step) < quantum.ALIKE * step else step
        if quantum.explained_by_counts(speeds, config, n * problem.dt, own):
            return Printed(counts, own), n * problem.dt
    counts = quantum.of_counts(config, window)
    return Printed(counts if counts < step else 0.0, step), None
