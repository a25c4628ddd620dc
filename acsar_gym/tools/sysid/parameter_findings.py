"""Findings: each parameter of motors and board with its interval, or why the log can't tell it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.protocol import MOTORS
from acsar_gym.tools.sysid.delays import Floats
from acsar_gym.tools.sysid.feedback_lines import (
    PRINTED_STEP,
    find_quantum,
    is_explained_by_counts,
    measure_line_rate,
)
from acsar_gym.tools.sysid.fit import (
    DELAY_BOUNDS,
    LONGEST_WINDOW,
    SMOOTH_PARAMETERS,
    WHEEL_HIGH,
    WHEEL_LOW,
    MotorFit,
)
from acsar_gym.tools.sysid.identifiability import (
    HANGS_ON_LAG,
    LONG_PAUSE,
    TURNING_SPEED,
    Identifiability,
)
from acsar_gym.tools.sysid.response import PARAMETERS_PER_WHEEL
from acsar_gym.tools.sysid.tracks import BoardTrack

with require_extra("identification", "scipy"):
    from scipy import stats

NORMAL_QUANTILE = 1.96
INTERVAL_FACTOR = 2.5
"""Factor on intervals, so that those of four wheels hold together in 19 of 20 simulated robots: the
twin's answer is a mean over phases."""
LEAST_INTERVAL_SHARE = 0.002
"""Least half width of an interval of a lag or gain, as a share."""
UNLIKE_PROBABILITY = 0.01
"""Wheels differ if the probability that they don't is below this."""
NO_RAMP = 1e6
"""Acceleration of a board without a ramp [rad/s^2]; the largest of the field."""
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


def find_wheels(
    fit: MotorFit | None, config: RobotConfig, known: Identifiability
) -> list[ParameterFinding]:
    """Findings of the four motors; one for all wheels where they don't differ."""
    found = []
    for p in range(len(SMOOTH_PARAMETERS)):
        spread = None
        if fit is not None:
            rows = [PARAMETERS_PER_WHEEL * k + p for k in range(len(fit.problem.wheels))]
            spread = np.asarray(fit.spread[np.ix_(rows, rows)])
        four = [_find_smooth(fit, config, known, p, wheel) for wheel in range(4)]
        found += _merge_wheels(four, spread)
    four = [_find_deadband(fit, config, known, wheel) for wheel in range(4)]
    return found + _merge_wheels(four, None)


def _describe_configured(config: RobotConfig, name: str, wheel: int) -> ParameterFinding:
    """The finding of one wheel's parameter before it is told."""
    before = float(getattr(config.motor.of_wheel(wheel), name.removeprefix("motor.")))
    return ParameterFinding(name, MOTORS[wheel], before=before)


def _find_smooth(
    fit: MotorFit | None, config: RobotConfig, known: Identifiability, p: int, wheel: int
) -> ParameterFinding:
    """Lag, gain or ramp of one wheel."""
    name, letter = SMOOTH_PARAMETERS[p], MOTORS[wheel]
    unknown = _describe_configured(config, name, wheel)
    if fit is None or not known.can(name, letter):
        return replace(unknown, note=known.missing[name, letter])
    index = PARAMETERS_PER_WHEEL * fit.problem.wheels.index(wheel) + p
    value = float(fit.solution.x[index])
    half = NORMAL_QUANTILE * INTERVAL_FACTOR * math.sqrt(fit.spread[index, index])
    half += float(fit.slack[index])
    if name == "motor.acceleration":
        return _find_ramp(unknown, value, half)
    half = max(half, LEAST_INTERVAL_SHARE * value)
    if not WHEEL_LOW[p] * (1.0 + BOUND_EDGE) <= value <= WHEEL_HIGH[p] * (1.0 - BOUND_EDGE):
        return replace(unknown, note=f"the fit ended at its bound of {value:.3g}")
    if half > VAGUE_WHEEL[name] * value:
        return replace(unknown, note=f"too vague, +-{half / value:.0%}: record more steps")
    return replace(unknown, value=value, low=max(0.0, value - half), high=value + half, told=True)


def _find_ramp(unknown: ParameterFinding, slowness: float, half: float) -> ParameterFinding:
    """The ramp of one wheel, from the time it needs for 1 rad/s and its half width."""
    if slowness > WHEEL_HIGH[2] * (1.0 - BOUND_EDGE):
        return replace(unknown, note="the fit ended at its bound")
    if slowness - half <= 0.0 or slowness < 1.0 / NO_RAMP or slowness < 1e-3:
        fastest = 1.0 / max(slowness + half, 1e-6)
        note = f"no ramp, or one faster than {fastest:.0f} rad/s^2"
        return replace(unknown, value=NO_RAMP, low=fastest, high=NO_RAMP, note=note, told=True)
    if half > VAGUE_WHEEL["motor.acceleration"] * slowness:
        return replace(unknown, note="too vague: record more large steps")
    low, high = 1.0 / (slowness + half), min(NO_RAMP, 1.0 / (slowness - half))
    return replace(unknown, value=1.0 / slowness, low=low, high=high, told=True)


def _find_deadband(
    fit: MotorFit | None, config: RobotConfig, known: Identifiability, wheel: int
) -> ParameterFinding:
    """The deadband of one wheel."""
    name, letter, most = "motor.deadband", MOTORS[wheel], known.slowest[wheel]
    unknown = _describe_configured(config, name, wheel)
    if fit is None or not known.can(name, letter):
        return replace(unknown, note=known.missing[name, letter])
    index = fit.problem.wheels.index(wheel)
    one = fit.deadbands[index]
    lag_told = _find_smooth(fit, config, known, 0, wheel).told
    if one is None:
        note = "the wheel never turned"
    elif not lag_told and fit.wheels[index].lag > WHEEL_LOW[0] * (1.0 + BOUND_EDGE):
        note = HANGS_ON_LAG
    elif one.high > most:
        note = f"ended at its bound: slow commands up to {most:.1f} rad/s don't show it"
    elif one.high - one.low > 2.0 * VAGUE_WHEEL[name]:
        note = "too vague: command a slower staircase"
    else:
        return replace(unknown, value=one.value, low=one.low, high=one.high, told=True)
    return replace(unknown, note=note)


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
    away = float((((values - mean) / sigmas) ** 2).sum())
    if away > stats.chi2.ppf(1.0 - UNLIKE_PROBABILITY, len(four) - 1):
        return four
    half = NORMAL_QUANTILE * float(weights @ sigmas)  # of errors that wheels have in common
    if spread is not None and len(spread) == len(four):
        shares = np.sqrt(np.maximum(np.diag(spread), 1e-18))
        common = spread / np.outer(shares, shares)
        half = NORMAL_QUANTILE * math.sqrt(float((weights * sigmas) @ common @ (weights * sigmas)))
    half *= max(1.0, math.sqrt(away / (len(four) - 1)))
    return [replace(every, value=mean, low=max(0.0, mean - half), high=mean + half)]


def find_board(
    fit: MotorFit | None,
    config: RobotConfig,
    known: Identifiability,
    tracks: Sequence[BoardTrack],
) -> list[ParameterFinding]:
    """Findings of the board, in the order of the table."""
    board, encoder = config.firmware, config.encoder
    found = {
        DELAY_NAME: ParameterFinding(DELAY_NAME, before=board.command_delay),
        TIMEOUT_NAME: ParameterFinding(TIMEOUT_NAME, before=board.command_timeout),
        WINDOW_NAME: ParameterFinding(WINDOW_NAME, before=encoder.window),
    }
    for name, unknown in found.items():
        if fit is None or not known.can(name):
            note = known.missing.get((name, ""), "no wheel turned")
            found[name] = replace(unknown, note=note)
    if fit is not None:
        if known.can(DELAY_NAME):
            found[DELAY_NAME] = _find_delay(found[DELAY_NAME], fit)
        if known.can(TIMEOUT_NAME):
            found[TIMEOUT_NAME] = _find_timeout(found[TIMEOUT_NAME], fit, tracks)
        if known.can(WINDOW_NAME):
            found[WINDOW_NAME] = _find_window(found[WINDOW_NAME], fit, known)
    rate = ParameterFinding(RATE_NAME, before=config.feedback_rate)
    if not known.can(RATE_NAME):
        rate = replace(rate, note=known.missing[RATE_NAME, ""])
    elif (lines := measure_line_rate(tracks)).rate > board.loop_rate:
        rate = replace(rate, note="more lines than the twin has loops")
    else:
        low = max(0.1 * lines.rate, lines.rate - lines.half)
        high, note = lines.rate + lines.half, f"jitter {1e3 * lines.jitter:.1f} ms"
        rate = replace(rate, value=lines.rate, low=low, high=high, note=note, told=True)
    quantum = _find_quantum(fit, config, tracks)
    return [found[DELAY_NAME], found[TIMEOUT_NAME], rate, found[WINDOW_NAME], quantum]


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
    if not DELAY_BOUNDS[0] * 0.9 < value < DELAY_BOUNDS[1] * 0.9:
        return replace(unknown, note="the fit ended at its bound")
    if value + half < -NEGATIVE_DELAY:
        why = "less than the wire alone takes: check baud_rate and firmware.processing_time"
        return replace(unknown, note=why)
    if half > VAGUE_TIME:
        return replace(unknown, note="too vague: record more steps")
    low, high = max(0.0, value - half), max(half, value + half)
    note = "on top of wire and processing_time; the board's loops blur it"
    return replace(unknown, value=max(0.0, value), low=low, high=high, note=note, told=True)


def _find_timeout(
    unknown: ParameterFinding, fit: MotorFit, tracks: Sequence[BoardTrack]
) -> ParameterFinding:
    """The command time-out, or that there is none."""
    gaps = [
        float(track.arrivals[k + 1] - track.arrivals[k])
        for track in tracks
        for k in track.pauses
        if np.abs(track.commands[k]).max() >= TURNING_SPEED
    ]
    longest = max(gaps, default=0.0)
    if not fit.solution.free[-1]:
        if longest >= LONG_PAUSE:
            note = f"none: the wheels kept turning for {longest:.1f} s without commands"
            return replace(unknown, note=note, told=True)
        why = f"above {longest:.2f} s, the longest pause: stop sending commands for 2 s"
        return replace(unknown, note=why)
    value = fit.times.timeout - fit.problem.dt / 2.0  # a board looks once a loop
    half = _half_width(fit, (-1, 1.0)) + 3.0 * fit.problem.dt
    if fit.slack[-1] > VAGUE_TIME:
        return replace(unknown, note=HANGS_ON_LAG)
    if half > 2.0 * VAGUE_TIME or value >= longest:
        return replace(unknown, note="too vague: stop sending commands for 2 s")
    return replace(unknown, value=value, low=value - half, high=value + half, told=True)


def _find_window(
    unknown: ParameterFinding, fit: MotorFit, known: Identifiability
) -> ParameterFinding:
    """The averaging time of the encoders, in whole loops of the twin."""
    dt, value, half = fit.problem.dt, fit.times.window, _half_width(fit, (-2, 1.0))
    if not known.can(DELAY_NAME):
        return replace(unknown, note="no wheel turned")
    if value > 0.95 * LONGEST_WINDOW:
        return replace(unknown, note="the fit ended at its bound")
    if not fit.solution.free[-2] and not fit.window_held:
        why = "too vague: record more steps at a higher line rate"
        return replace(unknown, note=why)
    if half > VAGUE_TIME:
        return replace(unknown, note="too vague: record more steps")
    whole = max(1, round(value / dt)) * dt
    low, high = max(dt, value - half - dt), value + half + dt
    note = "by encoder counts" if fit.window_held else ""
    return replace(
        unknown, value=whole, low=min(low, whole), high=max(high, whole), note=note, told=True
    )


def _find_quantum(
    fit: MotorFit | None, config: RobotConfig, tracks: Sequence[BoardTrack]
) -> ParameterFinding:
    """The step of the printed speeds."""
    unknown = ParameterFinding(QUANTUM_NAME, before=config.encoder.quantum)
    speeds = np.concatenate([track.speeds for track in tracks]) if tracks else np.empty(0)
    found = fit.quantum if fit else find_quantum(speeds)
    if found is None:
        return replace(unknown, note="too few different speeds: record slow and fast driving")
    counted = fit is not None and fit.window_held and not fit.rounding.step
    if counted or is_explained_by_counts(speeds, config, config.encoder.window, 0.0):
        note = COUNTED_NOTE
    elif found.step <= PRINTED_STEP:
        note = "finer than the two decimals of a line show"
    else:
        note = ""
    return replace(
        unknown, value=found.step, low=found.low, high=found.high, note=note, told=not note
    )


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
