"""Findings: each parameter of motors and board with its interval, or why the log can't tell it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.protocol import MOTORS, PRINTED_STEP
from acsar_gym.tools.sysid import feedback_lines, identifiability
from acsar_gym.tools.sysid.delays import Floats
from acsar_gym.tools.sysid.fit import (
    DELAY_BOUNDS,
    LONGEST_WINDOW,
    SMOOTH_PARAMETERS,
    WHEEL_HIGH,
    WHEEL_LOW,
    MotorFit,
)
from acsar_gym.tools.sysid.identifiability import Identifiability
from acsar_gym.tools.sysid.response import PARAMETERS_PER_WHEEL
from acsar_gym.tools.sysid.tracks import BoardTrack

with require_extra("identification", "scipy"):
    from scipy import stats

NORMAL_QUANTILE = 1.96
INTERVAL_FACTOR = 2.5
"""Factor on intervals, so that those of four wheels hold together in 19 of 20 simulated robots: the
twin's answer is a mean over phases."""
LEAST_INTERVALS = {
    "motor.time_constant": (0.0, 3e-3),
    "motor.gain": (0.008, 0.0),
    "motor.acceleration": (0.025, 0.0),
    "motor.deadband": (0.0, 0.02),
}
"""Least half widths of intervals, as a share and on top of it: the phases of the board's loops move
values by so much, whatever a log's length."""
UNLIKE_PROBABILITY = 0.01
"""Wheels differ if the probability that they don't is below this."""
LIKENESS_FACTOR = 1.5
"""Factor on differences of wheels in that test: `INTERVAL_FACTOR` isn't of random errors."""
NO_RAMP = 1e6
"""Acceleration of a board without a ramp [rad/s^2]; the largest of the field."""
LEAST_SLOWNESS = 0.01
"""Where a ramp may be none, it is told as none if it surely takes less than this [s^2/rad]."""
BOUND_EDGE = 0.02
"""A value so near its bound, as a share of it, has ended there."""
VAGUE_WHEEL = {
    "motor.time_constant": 0.3,
    "motor.gain": 0.05,
    "motor.acceleration": 0.6,
    "motor.deadband": 0.3,
}
"""Half widths of intervals above which a number isn't told: shares, but for deadbands [rad/s]."""
VAGUE_TIME = 0.03
"""Half width above which a time isn't told [s]."""
VAGUE_WINDOW = 0.06
"""The same of an averaging time, which steps tell less exactly [s]."""
LEAST_WINDOW_INTERVAL = 0.015
"""Least half width where only the answers' shape tells a window: a lag's is nearly the same [s]."""
SHORTEST_WINDOW = 0.001
"""Of an encoder that doesn't average [s]."""
NEGATIVE_DELAY = 0.01
"""A delay that is negative by more than this contradicts the baud rate [s]."""
DELAY_QUANTILES = np.linspace(0.05, 0.95, 10)
"""Of the delays of single steps."""
INFORMATIVE_SHARE = 0.2
"""A block tells a delay if it has this share of the median block's information."""
DELAY_NAME = "firmware.command_delay"
TIMEOUT_NAME = "firmware.command_timeout"
RATE_NAME = "firmware.feedback_rate"
WINDOW_NAME = "encoder.window"
QUANTUM_NAME = "encoder.quantum"
COUNTED_NOTE = "whole encoder counts, as counts_per_revolution says"


@dataclass(frozen=True)
class ParameterFinding:
    """One parameter of one wheel, or of the board.

    Attributes:
        name: field of the robot's config, such as "motor.gain".
        wheel: "a" to "d"; "" for all.
        value: in the field's unit; None where the log can't tell, or there is none.
        low: lower end of the 95 % interval.
        high: upper end.
        before: as configured.
        note: why it can't be told, or what it means.
        told: whether it goes into the robot's file.
    """

    name: str
    wheel: str = ""
    value: float | None = None
    low: float | None = None
    high: float | None = None
    before: float | None = None
    note: str = ""
    told: bool = False

    def explain(self, why: str) -> ParameterFinding:
        """A copy that can't be told, and why."""
        return replace(self, note=why)

    def tell(self, value: float, low: float, high: float, note: str = "") -> ParameterFinding:
        """A copy with a value and its interval."""
        return replace(self, value=value, low=low, high=high, note=note, told=True)


def find_wheels(
    fit: MotorFit | None, config: RobotConfig, known: Identifiability
) -> list[ParameterFinding]:
    """Findings of the four motors; one for all wheels where they don't differ."""
    unlike: dict[str, list[ParameterFinding]] = {
        name: [] for name in identifiability.WHEEL_PARAMETERS
    }
    for wheel, letter in enumerate(MOTORS):
        lag_told = False
        for name, four in unlike.items():
            own = config.motor.of_wheel(wheel)
            before = float(getattr(own, name.removeprefix("motor.")))
            one = ParameterFinding(name, letter, before=before)
            if fit is None or not known.can(name, letter):
                one = one.explain(known.missing[name, letter])
            elif name == "motor.deadband":
                index, slowest = fit.problem.wheels.index(wheel), known.slowest[wheel]
                one = _find_deadband(one, fit, index, slowest, lag_told=lag_told)
            else:
                one = _find_smooth(one, fit, fit.problem.wheels.index(wheel))
                lag_told = lag_told or (name == SMOOTH_PARAMETERS[0] and one.told)
            four.append(one)
    found = []
    for name, four in unlike.items():
        spread = None
        if fit is not None and name in SMOOTH_PARAMETERS:
            rows = np.arange(len(fit.problem.wheels)) * PARAMETERS_PER_WHEEL
            rows += SMOOTH_PARAMETERS.index(name)
            spread = np.asarray(fit.spread[np.ix_(rows, rows)])
        found += [_widen(one) for one in _merge_wheels(four, spread)]
    return found


def _widen(one: ParameterFinding) -> ParameterFinding:
    """Make an interval as wide as it is at least."""
    if one.value is None or one.low is None or one.high is None or one.value == NO_RAMP:
        return one
    share, fixed = LEAST_INTERVALS[one.name]
    least = share * one.value + fixed
    low, high = min(one.low, max(0.0, one.value - least)), max(one.high, one.value + least)
    note = one.note or (f"below {high:.2f} rad/s" if low <= 0.0 < one.value else "")
    return replace(one, low=low, high=high, note=note)


def _find_smooth(unknown: ParameterFinding, fit: MotorFit, index: int) -> ParameterFinding:
    """Lag, gain or ramp of one wheel; a ramp from the time that it needs for 1 rad/s."""
    p = SMOOTH_PARAMETERS.index(unknown.name)
    row = PARAMETERS_PER_WHEEL * index + p
    value = float(fit.solution.x[row])
    half = NORMAL_QUANTILE * INTERVAL_FACTOR * math.sqrt(fit.spread[row, row])
    half += float(fit.slack[row])
    at_bound = value > WHEEL_HIGH[p] * (1.0 - BOUND_EDGE)
    vague = half > VAGUE_WHEEL[unknown.name] * value
    if unknown.name == "motor.acceleration":
        if value + half < LEAST_SLOWNESS and (value - half <= 0.0 or value < 1e-3):
            fastest = 1.0 / max(value + half, 1e-6)
            note = f"no ramp, or one faster than {fastest:.0f} rad/s^2"
            return unknown.tell(NO_RAMP, fastest, NO_RAMP, note)
        if at_bound or vague:
            why = "too vague: record more large steps"
            return unknown.explain("the fit ended at its bound" if at_bound else why)
        high = min(NO_RAMP, 1.0 / (value - half))
        return unknown.tell(1.0 / value, 1.0 / (value + half), high)
    if at_bound or value < WHEEL_LOW[p] * (1.0 + BOUND_EDGE):
        return unknown.explain(f"the fit ended at its bound of {value:.3g}")
    if vague:
        return unknown.explain(f"too vague, +-{half / value:.0%}: record more steps")
    return unknown.tell(value, max(0.0, value - half), value + half)


def _find_deadband(
    unknown: ParameterFinding, fit: MotorFit, index: int, slowest: float, *, lag_told: bool
) -> ParameterFinding:
    """The deadband of one wheel."""
    one = fit.deadbands[index]
    if one is None:
        return unknown.explain("the wheel never turned")
    if not lag_told and fit.wheels[index].lag > WHEEL_LOW[0] * (1.0 + BOUND_EDGE):
        return unknown.explain(identifiability.HANGS_ON_LAG)
    if one.high > slowest:
        why = f"slow commands up to {slowest:.1f} rad/s don't show it"
        return unknown.explain(f"ended at its bound: {why}")
    if one.high - one.low > 2.0 * VAGUE_WHEEL[unknown.name]:
        return unknown.explain("too vague: command a slower staircase")
    return unknown.tell(*one)


def _merge_wheels(four: list[ParameterFinding], spread: Floats | None) -> list[ParameterFinding]:
    """One finding for all wheels, where all are told and they don't differ."""
    every = replace(four[0], wheel="")
    if any(one.value is None for one in four):
        return [every] if len({(one.note, one.value) for one in four}) == 1 else four
    values = np.array([one.value for one in four], float)
    ends = np.array([[one.low, one.high] for one in four], float)
    if (values == NO_RAMP).all():
        return [replace(every, low=float(ends[:, 0].min()))]
    sigmas = np.maximum((ends[:, 1] - ends[:, 0]) / 2.0 / NORMAL_QUANTILE, 1e-9)
    weights = sigmas**-2 / (sigmas**-2).sum()
    mean = float(weights @ values)
    away = float((((values - mean) / sigmas * LIKENESS_FACTOR) ** 2).sum())
    if away > stats.chi2.ppf(1.0 - UNLIKE_PROBABILITY, len(four) - 1):
        return four
    half = NORMAL_QUANTILE * float(weights @ sigmas)  # of errors that wheels have in common
    if spread is not None and len(spread) == len(four):
        shares = np.sqrt(np.maximum(np.diag(spread), 1e-18))
        common = spread / np.outer(shares, shares)
        half = NORMAL_QUANTILE * math.sqrt(float((weights * sigmas) @ common @ (weights * sigmas)))
    low, high = float(values.min()) - half, float(values.max()) + half
    return [replace(every, value=mean, low=max(0.0, low), high=high)]


def find_board(
    fit: MotorFit | None,
    config: RobotConfig,
    known: Identifiability,
    tracks: Sequence[BoardTrack],
) -> list[ParameterFinding]:
    """Findings of the board, in the order of the table."""
    found = []
    for name, before, find in (
        (DELAY_NAME, config.firmware.command_delay, _find_delay),
        (TIMEOUT_NAME, config.firmware.command_timeout, _find_timeout),
        (WINDOW_NAME, config.encoder.window, _find_window),
    ):
        one = ParameterFinding(name, before=before)
        hidden = name == WINDOW_NAME and not known.can(DELAY_NAME)
        if fit is None or hidden or not known.can(name):
            found.append(one.explain(known.missing.get((name, ""), "no wheel turned")))
        else:
            found.append(find(one, fit))
    rate = ParameterFinding(RATE_NAME, before=config.feedback_rate)
    if not known.can(RATE_NAME):
        rate = rate.explain(known.missing[RATE_NAME, ""])
    elif (lines := feedback_lines.measure_line_rate(tracks)).rate > config.firmware.loop_rate:
        rate = rate.explain("more lines than the twin has loops")
    else:
        low = max(0.1 * lines.rate, lines.rate - lines.half)
        note = f"jitter {1e3 * lines.jitter:.1f} ms"
        rate = rate.tell(lines.rate, low, lines.rate + lines.half, note)
    quantum = _find_quantum(fit, config, np.concatenate([track.speeds for track in tracks]))
    return [*found[:2], rate, found[2], quantum]


def _half_width(fit: MotorFit, *weights: tuple[int, float]) -> float:
    """Half width of the interval of a sum of the board's times, counted from the last one."""
    row = np.zeros(len(fit.solution.x))
    for index, weight in weights:
        row[index] = weight
    sigma = math.sqrt(max(0.0, float(row @ fit.spread @ row)))
    return NORMAL_QUANTILE * INTERVAL_FACTOR * sigma + float(np.abs(row) @ fit.slack)


def _find_delay(unknown: ParameterFinding, fit: MotorFit) -> ParameterFinding:
    """The delay of commands; the phase of the board's loops adds up to one to its interval."""
    value = fit.times.delay
    half = _half_width(fit, (-3, 1.0), (-2, -0.5)) + fit.problem.dt
    half += 0.0 if fit.counted else LEAST_WINDOW_INTERVAL / 2.0
    if not DELAY_BOUNDS[0] * 0.9 < value < DELAY_BOUNDS[1] * 0.9:
        return unknown.explain("the fit ended at its bound")
    if value + half < -NEGATIVE_DELAY:
        why = "less than the wire alone takes: check baud_rate and firmware.processing_time"
        return unknown.explain(why)
    if half > VAGUE_TIME:
        return unknown.explain("too vague: record more steps")
    note = "on top of wire and processing_time; the board's loops blur it"
    low, high = max(0.0, value - half), max(half, value + half)
    return unknown.tell(max(0.0, value), low, high, note)


def _find_timeout(unknown: ParameterFinding, fit: MotorFit) -> ParameterFinding:
    """The command time-out, or that there is none."""
    gaps = [
        float(track.arrivals[k + 1] - track.arrivals[k])
        for track in fit.problem.tracks
        for k in track.pauses
        if np.abs(track.commands[k]).max() >= identifiability.TURNING_SPEED
    ]
    longest = max(gaps, default=0.0)
    if not fit.solution.free[-1]:
        if longest >= identifiability.LONG_PAUSE:
            note = f"none: the wheels kept turning for {longest:.1f} s without commands"
            return replace(unknown, note=note, told=True)
        why = f"above {longest:.2f} s, the longest pause: stop sending commands for 2 s"
        return unknown.explain(why)
    value = fit.times.timeout - fit.problem.dt / 2.0  # a board looks once a loop
    half = _half_width(fit, (-1, 1.0)) + 3.0 * fit.problem.dt
    if fit.slack[-1] > VAGUE_TIME:
        return unknown.explain(identifiability.HANGS_ON_LAG)
    if half > 2.0 * VAGUE_TIME or value >= longest:
        return unknown.explain("too vague: stop sending commands for 2 s")
    return unknown.tell(value, value - half, value + half)


def _find_window(unknown: ParameterFinding, fit: MotorFit) -> ParameterFinding:
    """The averaging time of the encoders, in whole loops of the twin."""
    dt, value, half = fit.problem.dt, fit.times.window, _half_width(fit, (-2, 1.0))
    if value > 0.95 * LONGEST_WINDOW:
        return unknown.explain("the fit ended at its bound")
    if not fit.solution.free[-2] and not fit.counted:
        return unknown.explain("too vague: record more steps at a higher line rate")
    whole = max(1, round(value / dt)) * dt
    if fit.counted:
        return unknown.tell(whole, max(dt, whole - dt), whole + dt, "by encoder counts")
    if half > VAGUE_WINDOW:
        return unknown.explain(f"too vague, +-{1e3 * half:.0f} ms: record more steps")
    half += LEAST_WINDOW_INTERVAL
    low, high = max(SHORTEST_WINDOW, value - half), max(whole, value + half)
    return unknown.tell(
        whole, low, high, "" if low > SHORTEST_WINDOW else f"below {1e3 * high:.0f} ms"
    )


def _find_quantum(fit: MotorFit | None, config: RobotConfig, speeds: Floats) -> ParameterFinding:
    """The step of the printed speeds."""
    unknown = ParameterFinding(QUANTUM_NAME, before=config.encoder.quantum)
    found = fit.quantum if fit else feedback_lines.find_quantum(speeds)
    if found is None:
        return unknown.explain("too few different speeds: record slow and fast driving")
    counted = fit is not None and fit.counted and not fit.rounding.step
    if counted or feedback_lines.is_explained_by_counts(speeds, config, config.encoder.window, 0.0):
        return replace(unknown.tell(*found, COUNTED_NOTE), told=False)
    if found.step <= PRINTED_STEP:
        note = "finer than the two decimals of a line show"
        return replace(unknown.tell(*found, note), told=False)
    return unknown.tell(*found)


def sample_delays(fit: MotorFit) -> tuple[float, ...]:
    """Quantiles of the delays of single steps, on top of the fitted one [s]; at least zero.

    Each block of the log has a delay of its own: the shift that explains its residuals best.
    """
    problem, solution = fit.problem, fit.solution
    rest = problem.residuals(solution.x, solution.deadbands)
    slope = problem.jacobian(solution.x, solution.deadbands)[:, -3]
    blocks = problem.blocks() % problem.blocks_of_wheel
    information = np.bincount(blocks, slope * slope)
    shifts = -np.bincount(blocks, slope * rest) / np.maximum(information, 1e-9)
    good = information > INFORMATIVE_SHARE * np.median(information[information > 0.0])
    extra = np.maximum(0.0, np.quantile(shifts[good], DELAY_QUANTILES))
    return tuple(round(float(one), 5) for one in extra)
