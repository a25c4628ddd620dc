"""Findings: each parameter of motors and board with its interval, or why the log can't tell it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.protocol import MOTORS, PRINTED_STEP
from acsar_gym.tools.sysid import board_log
from acsar_gym.tools.sysid.board_log import BoardTrack, Estimate, Floats, Identifiability
from acsar_gym.tools.sysid.fit import (
    DELAY_BOUNDS,
    LONGEST_WINDOW,
    SMOOTH_PARAMETERS,
    WHEEL_HIGH,
    WHEEL_LOW,
    MotorFit,
)
from acsar_gym.tools.sysid.model_check import FAST_PARTS, STEADY_SLOW, PartError
from acsar_gym.tools.sysid.response import PARAMETERS_PER_WHEEL

with require_extra("identification", "scipy"):
    from scipy import stats

NORMAL_QUANTILE = 1.96
INTERVAL_FACTOR = 2.5
"""Factor on intervals, so that those of four wheels hold together in 19 of 20 simulated robots: the
twin's answer is a mean over phases."""
LEAST_INTERVALS = {
    "motor.time_constant": (0.0, 3e-3),
    "motor.gain": (0.01, 0.0),
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
RAMP_SHARE, RAMP_TICKS, RAMP_QUANTILE = 0.85, 5, 0.99
"""A wheel that followed a commanded ramp has none of its own that is slower than this share of it;
over how many commands a ramp is measured, and which of them all is called the steepest."""
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
NO_WHEEL = "no wheel turned"
CUT_NOTE = "speeds are cut to it; a twin rounds them, so it reads half a step more"
IN_ROS_NOTE = "from publishing to the stamp that shows it, without the controller's lag"
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
    fit: MotorFit | None,
    config: RobotConfig,
    known: Identifiability,
    parts: Sequence[PartError] = (),
) -> list[ParameterFinding]:
    """Findings of the four motors; wheels that can't be told apart have one value.

    Args:
        fit: of the motors; None where the log tells nothing of any wheel.
        config: of the robot, as it was.
        known: what the log can tell.
        parts: errors of the fit, which widen the intervals.
    """
    found: list[ParameterFinding] = []
    lags_told = [False] * 4
    for name in board_log.WHEEL_PARAMETERS:
        before = [getattr(config.motor.of_wheel(w), name.removeprefix("motor.")) for w in range(4)]
        four = [
            ParameterFinding(name, letter, before=float(value))
            for letter, value in zip(MOTORS, before, strict=True)
        ]
        estimates = {}
        for wheel, letter in enumerate(MOTORS):
            if fit is None or not known.can(name, letter):
                four[wheel] = four[wheel].explain(known.missing[name, letter])
                if name == "motor.acceleration" and fit is not None:
                    four[wheel] = _find_no_ramp(four[wheel], fit, wheel)
            else:
                estimates[wheel] = _estimate(name, fit, wheel, parts)
        for wheels in _group_wheels(name, fit, estimates):
            estimate = _merge_wheels(name, fit, {w: estimates[w] for w in wheels})
            slowest = max(known.slowest[wheel] for wheel in wheels)
            for wheel in wheels:
                if name != "motor.deadband":
                    four[wheel] = _find_smooth(four[wheel], estimate)
                elif any(lags_told[wheel] for wheel in wheels):
                    finest = max(fit.rounding) if fit else 0.0
                    four[wheel] = _find_deadband(four[wheel], estimate, slowest, finest)
                else:
                    four[wheel] = four[wheel].explain(board_log.HANGS_ON_LAG)
        alike = len({replace(one, wheel="", before=None) for one in four}) == 1
        found += [_widen(one) for one in ([replace(four[0], wheel="")] if alike else four)]
        if fit is not None and name == "motor.time_constant":
            instant = [wheel.lag < WHEEL_LOW[0] * (1.0 + BOUND_EDGE) for wheel in fit.wheels]
            short = {w for w, lag in zip(fit.problem.wheels, instant, strict=True) if lag}
            lags_told = [one.told or wheel in short for wheel, one in enumerate(four)]
    return found


def _estimate(name: str, fit: MotorFit, wheel: int, parts: Sequence[PartError]) -> Estimate:
    """A parameter of one wheel as it was fitted, with its interval; of a ramp, the slowness.

    What the model misses at steady speeds may be hidden in it: all of it in a deadband, and as a
    share of the speed in a gain.
    """
    index = fit.problem.wheels.index(wheel)
    own = [one for one in parts if one.place == index]
    if name == "motor.deadband":
        value, low, high = fit.deadbands[index] or (0.0, 0.0, math.inf)
        missed = max((one.excess for one in own if one.part == STEADY_SLOW), default=0.0)
        return Estimate(value, max(0.0, low - missed), high + missed)
    row = PARAMETERS_PER_WHEEL * index + SMOOTH_PARAMETERS.index(name)
    value = float(fit.solution.x[row])
    half = NORMAL_QUANTILE * INTERVAL_FACTOR * math.sqrt(fit.spread[row, row])
    half += float(fit.slack[row])
    if name == "motor.gain":
        half += value * max((one.share for one in own if one.part in FAST_PARTS), default=0.0)
    return Estimate(value, value - half, value + half)


def _group_wheels(
    name: str, fit: MotorFit | None, estimates: dict[int, Estimate]
) -> list[list[int]]:
    """Share out wheels into groups that can't be told apart."""
    wheels = sorted(estimates, key=lambda wheel: estimates[wheel].value)
    if len(wheels) < 2:
        return [wheels] if wheels else []
    values, sigmas, weights = _weigh_wheels(estimates)
    away = float((((values - weights @ values) / sigmas * LIKENESS_FACTOR) ** 2).sum())
    if away <= stats.chi2.ppf(1.0 - UNLIKE_PROBABILITY, len(wheels) - 1):
        return [wheels]
    ordered = [estimates[wheel].value for wheel in wheels]
    cut = 1 + int(np.argmax(np.diff(ordered)))
    halves = ({wheel: estimates[wheel] for wheel in half} for half in (wheels[:cut], wheels[cut:]))
    return [group for half in halves for group in _group_wheels(name, fit, half)]


def _weigh_wheels(estimates: dict[int, Estimate]) -> tuple[Floats, Floats, Floats]:
    """Values of wheels, their standard deviations, and weights for a mean."""
    values, lows, highs = np.array(list(estimates.values())).T
    sigmas = np.clip((highs - lows) / 2.0 / NORMAL_QUANTILE, 1e-9, 1e9)
    return values, sigmas, sigmas**-2 / (sigmas**-2).sum()


def _merge_wheels(name: str, fit: MotorFit | None, estimates: dict[int, Estimate]) -> Estimate:
    """One estimate for wheels that can't be told apart; its interval has room for each."""
    if len(estimates) == 1:
        (one,) = estimates.values()
        return one
    values, sigmas, weights = _weigh_wheels(estimates)
    half = NORMAL_QUANTILE * float(weights @ sigmas)  # of errors that wheels have in common
    if fit is not None and name in SMOOTH_PARAMETERS:
        rows = [PARAMETERS_PER_WHEEL * fit.problem.wheels.index(wheel) for wheel in estimates]
        places = np.array(rows) + SMOOTH_PARAMETERS.index(name)
        spread = fit.spread[np.ix_(places, places)]
        shares = np.sqrt(np.maximum(np.diag(spread), 1e-18))
        common = spread / np.outer(shares, shares)
        half = NORMAL_QUANTILE * math.sqrt(float((weights * sigmas) @ common @ (weights * sigmas)))
    low, high = float(values.min()) - half, float(values.max()) + half
    return Estimate(float(weights @ values), low, high)


def _widen(one: ParameterFinding) -> ParameterFinding:
    """Make an interval as wide as it is at least."""
    if one.value is None or one.low is None or one.high is None or one.value == NO_RAMP:
        return one
    share, fixed = LEAST_INTERVALS[one.name]
    least = share * one.value + fixed
    low, high = min(one.low, max(0.0, one.value - least)), max(one.high, one.value + least)
    note = one.note or (f"below {high:.2f} rad/s" if low <= 0.0 < one.value else "")
    return replace(one, low=low, high=high, note=note)


def _find_smooth(unknown: ParameterFinding, estimate: Estimate) -> ParameterFinding:
    """Lag, gain or ramp of wheels; a ramp from the time that it needs for 1 rad/s."""
    p = SMOOTH_PARAMETERS.index(unknown.name)
    value, low, high = estimate
    at_bound = value > WHEEL_HIGH[p] * (1.0 - BOUND_EDGE)
    before = unknown.before or 0.0
    if unknown.name == "motor.acceleration":
        before = 1.0 / max(before, 1e-9)
    # What was configured is kept where the log tells no more, but not where it can't be true.
    vague = high - low > 2.0 * VAGUE_WHEEL[unknown.name] * value and low <= before <= high
    if unknown.name == "motor.acceleration":
        sure = high < LEAST_SLOWNESS and (low <= 0.0 or value < 1e-3)
        if sure or (low <= 0.0 and not vague and not at_bound):
            fastest = 1.0 / max(high, 1e-6)
            note = f"no ramp, or one faster than {fastest:.0f} rad/s^2"
            return unknown.tell(NO_RAMP, fastest, NO_RAMP, note)
        if at_bound or vague:
            why = "too vague: record more large steps"
            return unknown.explain("the fit ended at its bound" if at_bound else why)
        return unknown.tell(1.0 / value, 1.0 / high, min(NO_RAMP, 1.0 / low))
    if at_bound or value < WHEEL_LOW[p] * (1.0 + BOUND_EDGE):
        return unknown.explain(f"the fit ended at its bound of {value:.3g}")
    if vague:
        half = (high - low) / 2.0 / value
        return unknown.explain(f"too vague, +-{half:.0%}: record more steps")
    return unknown.tell(value, max(0.0, low), high)


def _find_no_ramp(unknown: ParameterFinding, fit: MotorFit, wheel: int) -> ParameterFinding:
    """Whether a wheel in ROS followed ramps that are steeper than the configured one of its own."""
    if wheel not in fit.problem.wheels or not board_log.takes_twists(fit.problem.tracks):
        return unknown
    steepest = RAMP_SHARE * max(_find_steepest(track) for track in fit.problem.tracks)
    slowness = fit.wheels[fit.problem.wheels.index(wheel)].slowness
    if (unknown.before or 0.0) > steepest or slowness * steepest > RAMP_SHARE:
        return unknown
    return unknown.tell(NO_RAMP, steepest, NO_RAMP, f"no ramp, or one faster than {steepest:.0f}")


def _find_steepest(track: BoardTrack) -> float:
    """The steepest ramp that all wheels were commanded [rad/s^2]."""
    rises = track.commands[RAMP_TICKS:] - track.commands[:-RAMP_TICKS]
    times = track.arrivals[RAMP_TICKS:] - track.arrivals[:-RAMP_TICKS]
    return float(np.quantile(np.abs(rises / times[:, None]), RAMP_QUANTILE, axis=0).min())


def _find_deadband(
    unknown: ParameterFinding, estimate: Estimate, slowest: float, finest: float
) -> ParameterFinding:
    """The deadband of wheels, from slow commands and the step of printed speeds [rad/s]."""
    value, low, high = estimate.value, max(0.0, estimate.low), estimate.high
    if value < finest:  # such speeds are printed as zero, deadband or not
        low, high = 0.0, max(high, finest)
    if high > slowest:
        why = f"slow commands up to {slowest:.1f} rad/s don't show it"
        return unknown.explain(f"ended at its bound: {why}")
    if high - low > 2.0 * VAGUE_WHEEL[unknown.name] and low <= (unknown.before or 0.0) <= high:
        return unknown.explain("too vague: command a slower staircase")
    return unknown.tell(value, low, high)


def find_board(
    fit: MotorFit | None,
    config: RobotConfig,
    known: Identifiability,
    tracks: Sequence[BoardTrack],
) -> list[ParameterFinding]:
    """Findings of the board, in the order of the table."""
    delay = ParameterFinding(DELAY_NAME, before=config.firmware.command_delay)
    timeout = ParameterFinding(TIMEOUT_NAME, before=config.firmware.command_timeout)
    window = ParameterFinding(WINDOW_NAME, before=config.encoder.window)
    if fit is None or not known.can(DELAY_NAME):
        why = known.missing.get((DELAY_NAME, ""), NO_WHEEL)
        delay, window = delay.explain(why), window.explain(why)
    else:
        window = _find_window(window, fit)
        delay = _find_delay(delay, fit, window.value or config.encoder.window)
    if fit is None or not known.can(TIMEOUT_NAME):
        timeout = timeout.explain(known.missing.get((TIMEOUT_NAME, ""), NO_WHEEL))
    else:
        timeout = _find_timeout(timeout, fit)
    rate = ParameterFinding(RATE_NAME, before=config.feedback_rate)
    if not known.can(RATE_NAME):
        rate = rate.explain(known.missing[RATE_NAME, ""])
    elif (lines := board_log.measure_line_rate(tracks)).rate > config.firmware.loop_rate:
        rate = rate.explain("more lines than the twin has loops")
    else:
        low = max(0.1 * lines.rate, lines.rate - lines.half)
        note = f"jitter {1e3 * lines.jitter:.1f} ms"
        rate = rate.tell(lines.rate, low, lines.rate + lines.half, note)
    quantum = _find_quantum(fit, config, np.concatenate([track.speeds for track in tracks]))
    return [delay, timeout, rate, window, quantum]


def _half_width(fit: MotorFit, *weights: tuple[int, float]) -> float:
    """Half width of the interval of a sum of the board's times, counted from the last one."""
    row = np.zeros(len(fit.solution.x))
    for index, weight in weights:
        row[index] = weight
    sigma = math.sqrt(max(0.0, float(row @ fit.spread @ row)))
    return NORMAL_QUANTILE * INTERVAL_FACTOR * sigma + float(np.abs(row) @ fit.slack)


def _find_delay(unknown: ParameterFinding, fit: MotorFit, window: float) -> ParameterFinding:
    """The delay of commands, of a twin whose encoders average for `window` [s].

    The phase of the board's loops adds up to one to its interval.
    """
    value = fit.times.delay
    half = _half_width(fit, (-3, 1.0), (-2, -0.5)) + fit.problem.dt
    half += 0.0 if fit.counted else LEAST_WINDOW_INTERVAL / 2.0
    if not DELAY_BOUNDS[0] * 0.9 < value < DELAY_BOUNDS[1] * 0.9:
        return unknown.explain("the fit ended at its bound")
    if value + half < -NEGATIVE_DELAY:
        why = "less than the wire alone takes: check baud_rate and firmware.processing_time"
        return unknown.explain(why)
    low, high = max(0.0, value - half), max(half, value + half)
    if half > VAGUE_TIME and low <= (unknown.before or 0.0) <= high:
        return unknown.explain("too vague: record more steps")
    in_ros = all(track.in_ros for track in fit.problem.tracks)
    note = (
        IN_ROS_NOTE if in_ros else "on top of wire and processing_time; the board's loops blur it"
    )
    value = max(0.0, value + (fit.times.window - window) / 2.0)  # what both add up to is told best
    return unknown.tell(value, min(low, value), max(high, value), note)


def _find_timeout(unknown: ParameterFinding, fit: MotorFit) -> ParameterFinding:
    """The command time-out, or that there is none."""
    gaps = [
        float(track.arrivals[k + 1] - track.arrivals[k])
        for track in fit.problem.tracks
        for k in track.pauses
        if np.abs(track.commands[k]).max() >= board_log.TURNING_SPEED
    ]
    longest = max(gaps, default=0.0)
    if not fit.solution.free[-1]:
        if longest >= board_log.LONG_PAUSE:
            note = f"none: the wheels kept turning for {longest:.1f} s without commands"
            return replace(unknown, note=note, told=True)
        why = f"above {longest:.2f} s, the longest pause: stop sending commands for 2 s"
        return unknown.explain(why)
    value = fit.times.timeout - fit.problem.dt / 2.0  # a board looks once a loop
    half = _half_width(fit, (-1, 1.0)) + 3.0 * fit.problem.dt
    if fit.slack[-1] > VAGUE_TIME:
        return unknown.explain(board_log.HANGS_ON_LAG)
    if half > 2.0 * VAGUE_TIME or value >= longest:
        return unknown.explain("too vague: stop sending commands for 2 s")
    return unknown.tell(value, value - half, value + half)


def _find_window(unknown: ParameterFinding, fit: MotorFit) -> ParameterFinding:
    """The averaging time of the encoders, in whole loops of the twin."""
    dt, value, half = fit.problem.dt, fit.times.window, _half_width(fit, (-2, 1.0))
    if value > 0.95 * LONGEST_WINDOW:
        return unknown.explain("the fit ended at its bound")
    if not fit.solution.free[-2] and not fit.counted and not fit.bounded:
        return unknown.explain("too vague: record more steps at a higher line rate")
    if fit.bounded:  # the delay to its middle tells it, as the delay to its begin isn't negative
        half = 2.0 * _half_width(fit, (-3, 1.0))
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
    found = fit.quantum if fit else board_log.find_quantum(speeds)
    if found is None:
        return unknown.explain("too few different speeds: record slow and fast driving")
    counted = fit is not None and fit.counted and not fit.rounding.step
    if counted or board_log.is_explained_by_counts(speeds, config, config.encoder.window, 0.0):
        return replace(unknown.tell(*found, COUNTED_NOTE), told=False)
    if found.value <= PRINTED_STEP:
        note = "finer than the two decimals of a line show"
        return replace(unknown.tell(*found, note), told=False)
    cut = fit is not None and fit.rounding.cut > 0.0
    return unknown.tell(*found, CUT_NOTE if cut else "")


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
