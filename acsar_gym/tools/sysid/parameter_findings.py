"""Findings: each parameter with its interval, or why the log can't tell it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import require_extra
from acsar_gym.protocol import MOTORS
from acsar_gym.tools.sysid import feedback_lines, fit
from acsar_gym.tools.sysid.fit import DELAY_BOUNDS, LONGEST_WINDOW, SMOOTH_PARAMETERS, MotorFit
from acsar_gym.tools.sysid.identifiability import HANGS_ON_LAG, LONG_PAUSE, Identifiability
from acsar_gym.tools.sysid.response import PARAMETERS_PER_WHEEL, WHEEL_HIGH, WHEEL_LOW
from acsar_gym.tools.sysid.tracks import BoardTrack


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


def unknown_finding(name: str, wheel: str, before: float | None, why: str) -> ParameterFinding:
    """Make the finding of a parameter that the log can't tell."""
    return ParameterFinding(name, wheel, before=before, note=why)


with require_extra("identification", "scipy"):
    from scipy import stats

Floats = NDArray[np.float64]

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


def find_wheels(
    estimate: MotorFit | None, config: RobotConfig, known: Identifiability
) -> list[ParameterFinding]:
    """Findings of the four motors; one for all wheels where they don't differ."""
    found = []
    for p, name in enumerate(SMOOTH_PARAMETERS):
        found += _merged(
            [_smooth(estimate, config, known, name, p, k) for k in range(4)],
            _share_spread(estimate, p),
        )
    bands = [_deadband(estimate, config, known, k) for k in range(4)]
    return found + _merged(bands, None)


def _before(config: RobotConfig, wheel: int, name: str) -> float:
    own = config.motor.of_wheel(wheel)
    return float(getattr(own, name.removeprefix("motor.")))


def _smooth(
    estimate: MotorFit | None,
    config: RobotConfig,
    known: Identifiability,
    name: str,
    p: int,
    wheel: int,
) -> ParameterFinding:
    """Lag, gain or ramp of one wheel."""
    letter, before = MOTORS[wheel], _before(config, wheel, name)
    if estimate is None or not known.can(name, letter):
        return unknown_finding(name, letter, before, known.missing[name, letter])
    index = PARAMETERS_PER_WHEEL * estimate.problem.wheels.index(wheel) + p
    value = float(estimate.solution.x[index])
    half = NORMAL_QUANTILE * INTERVAL_FACTOR * math.sqrt(estimate.spread[index, index]) + float(
        estimate.slack[index]
    )
    if name == "motor.acceleration":
        return _ramp(letter, before, value, half)
    half = max(half, LEAST_INTERVAL_SHARE * value)
    if value > WHEEL_HIGH[p] * (1.0 - BOUND_EDGE) or value < WHEEL_LOW[p] * (1.0 + BOUND_EDGE):
        return unknown_finding(name, letter, before, f"the fit ended at its bound of {value:.3g}")
    if half > VAGUE_WHEEL[name] * value:
        return unknown_finding(
            name, letter, before, f"too vague, +-{half / value:.0%}: record more steps"
        )
    low = max(0.0, value - half)
    return ParameterFinding(name, letter, value, low, value + half, before, told=True)


def _ramp(letter: str, before: float, slowness: float, half: float) -> ParameterFinding:
    """The ramp of one wheel, from the time it needs for 1 rad/s and its half width."""
    name = "motor.acceleration"
    if slowness > WHEEL_HIGH[2] * (1.0 - BOUND_EDGE):
        return unknown_finding(name, letter, before, "the fit ended at its bound")
    if slowness - half <= 0.0 or slowness < 1.0 / NO_RAMP or slowness < 1e-3:
        fastest = 1.0 / max(slowness + half, 1e-6)
        note = f"no ramp, or one faster than {fastest:.0f} rad/s^2"
        return ParameterFinding(name, letter, NO_RAMP, fastest, NO_RAMP, before, note, told=True)
    if half > VAGUE_WHEEL[name] * slowness:
        return unknown_finding(name, letter, before, "too vague: record more large steps")
    low, high = 1.0 / (slowness + half), min(NO_RAMP, 1.0 / (slowness - half))
    return ParameterFinding(name, letter, 1.0 / slowness, low, high, before, told=True)


def _deadband(
    estimate: MotorFit | None, config: RobotConfig, known: Identifiability, wheel: int
) -> ParameterFinding:
    """The deadband of one wheel."""
    name, letter = "motor.deadband", MOTORS[wheel]
    before = _before(config, wheel, name)
    if estimate is None or not known.can(name, letter):
        return unknown_finding(name, letter, before, known.missing[name, letter])
    index = estimate.problem.wheels.index(wheel)
    one = estimate.deadbands[index]
    if one is None:
        return unknown_finding(name, letter, before, "the wheel never turned")
    lag = _smooth(estimate, config, known, SMOOTH_PARAMETERS[0], 0, wheel)
    if not lag.told and estimate.motors[index].lag > WHEEL_LOW[0] * (1.0 + BOUND_EDGE):
        return unknown_finding(name, letter, before, HANGS_ON_LAG)
    if one.high > known.slowest[wheel]:
        most = known.slowest[wheel]
        why = f"ended at its bound: slow commands up to {most:.1f} rad/s don't show it"
        return unknown_finding(name, letter, before, why)
    if one.high - one.low > 2.0 * VAGUE_WHEEL[name]:
        return unknown_finding(name, letter, before, "too vague: command a slower staircase")
    return ParameterFinding(name, letter, one.value, one.low, one.high, before, told=True)


def _share_spread(estimate: MotorFit | None, p: int) -> Floats | None:
    """Covariance of one parameter of all wheels in the problem."""
    if estimate is None:
        return None
    rows = [PARAMETERS_PER_WHEEL * k + p for k in range(len(estimate.problem.wheels))]
    return np.asarray(estimate.spread[np.ix_(rows, rows)])


def _merged(four: list[ParameterFinding], spread: Floats | None) -> list[ParameterFinding]:
    """One finding for all wheels, where all are told and they don't differ."""
    if any(one.value is None for one in four):
        reasons = {(one.note, one.value) for one in four}
        same = len(reasons) == 1
        return [_for_all(four[0])] if same else four
    values = np.array([one.value for one in four], float)
    ends = np.array([[one.low, one.high] for one in four], float)
    if (values == NO_RAMP).all():
        return [_for_all(four[0], low=float(ends[:, 0].min()), note=four[0].note)]
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
    return [_for_all(four[0], value=mean, low=max(0.0, mean - half), high=mean + half)]


def _for_all(one: ParameterFinding, **changes: float | str) -> ParameterFinding:
    """The finding of one wheel, for all."""
    return replace(one, wheel="", **changes)  # type: ignore[arg-type]


VAGUE_TIME = 0.03
"""Half width above which a time isn't told [s]."""
NEGATIVE_DELAY = 0.01
"""A delay that is negative by more than this contradicts the baud rate [s]."""
DELAY_QUANTILES = np.linspace(0.05, 0.95, 10)
"""Of the delays of single steps."""
INFORMATIVE_SHARE = 0.2
"""A block tells a delay if it has this share of the median block's information."""
DELAY_NAME, WINDOW_NAME, TIMEOUT_NAME = (
    "firmware.command_delay",
    "encoder.window",
    "firmware.command_timeout",
)
COUNTED_NOTE = "whole encoder counts, as counts_per_revolution says"
RATE_NAME, QUANTUM_NAME = "firmware.feedback_rate", "encoder.quantum"


def find_board(
    estimate: MotorFit | None,
    config: RobotConfig,
    known: Identifiability,
    tracks: Sequence[BoardTrack],
) -> list[ParameterFinding]:
    """Findings of the board, in the order of the table."""
    return [
        _delay(estimate, config, known),
        _timeout(estimate, config, known, tracks),
        _rate(config, known, tracks),
        _window(estimate, config, known),
        _quantum(estimate, config, tracks),
    ]


def _half(estimate: MotorFit, *weights: tuple[int, float]) -> float:
    """Half width of a sum of clock parameters, counted from the last one."""
    n = len(estimate.solution.x)
    row = np.zeros(n)
    for index, weight in weights:
        row[n + index] = weight
    fitted = (
        NORMAL_QUANTILE * INTERVAL_FACTOR * math.sqrt(max(0.0, float(row @ estimate.spread @ row)))
    )
    return fitted + float(np.abs(row) @ estimate.slack)


def _delay(
    estimate: MotorFit | None, config: RobotConfig, known: Identifiability
) -> ParameterFinding:
    """The delay of commands; the phase of the board's loops adds up to one to its interval."""
    before = config.firmware.command_delay
    if estimate is None or not known.can(DELAY_NAME):
        return unknown_finding(
            DELAY_NAME, "", before, known.missing.get((DELAY_NAME, ""), "no wheel turned")
        )
    value = estimate.clock.delay
    half = _half(estimate, (-3, 1.0), (-2, -0.5)) + estimate.problem.dt
    if not DELAY_BOUNDS[0] * 0.9 < value < DELAY_BOUNDS[1] * 0.9:
        return unknown_finding(DELAY_NAME, "", before, "the fit ended at its bound")
    if value + half < -NEGATIVE_DELAY:
        why = "less than the wire alone takes: check baud_rate and firmware.processing_time"
        return unknown_finding(DELAY_NAME, "", before, why)
    if half > VAGUE_TIME:
        return unknown_finding(DELAY_NAME, "", before, "too vague: record more steps")
    low, high = max(0.0, value - half), max(half, value + half)
    note = "on top of wire and processing_time; the board's loops blur it"
    return ParameterFinding(DELAY_NAME, "", max(0.0, value), low, high, before, note, told=True)


def _window(
    estimate: MotorFit | None, config: RobotConfig, known: Identifiability
) -> ParameterFinding:
    """The averaging time of the encoders, in whole loops of the twin."""
    before = config.encoder.window
    if estimate is None or not known.can(WINDOW_NAME) or not known.can(DELAY_NAME):
        return unknown_finding(
            WINDOW_NAME, "", before, known.missing.get((WINDOW_NAME, ""), "no wheel turned")
        )
    dt, value = estimate.problem.dt, estimate.clock.window
    half = _half(estimate, (-2, 1.0))
    if value > 0.95 * LONGEST_WINDOW:
        return unknown_finding(WINDOW_NAME, "", before, "the fit ended at its bound")
    if not estimate.solution.free[-2] and not estimate.counted:
        return unknown_finding(
            WINDOW_NAME, "", before, "too vague: record more steps at a higher line rate"
        )
    if half > VAGUE_TIME:
        return unknown_finding(WINDOW_NAME, "", before, "too vague: record more steps")
    whole = max(1, round(value / dt)) * dt
    low, high = max(dt, value - half - dt), value + half + dt
    note = "by encoder counts" if estimate.counted else ""
    return ParameterFinding(
        WINDOW_NAME, "", whole, min(low, whole), max(high, whole), before, note, told=True
    )


def _timeout(
    estimate: MotorFit | None,
    config: RobotConfig,
    known: Identifiability,
    tracks: Sequence[BoardTrack],
) -> ParameterFinding:
    """The command time-out, or that there is none."""
    before = config.firmware.command_timeout
    longest = fit.find_longest_pause(tracks)
    if estimate is None or not known.can(TIMEOUT_NAME):
        return unknown_finding(
            TIMEOUT_NAME, "", before, known.missing.get((TIMEOUT_NAME, ""), "no wheel turned")
        )
    if not estimate.solution.free[-1]:
        if longest >= LONG_PAUSE:
            note = f"none: the wheels kept turning for {longest:.1f} s without commands"
            return ParameterFinding(TIMEOUT_NAME, "", None, None, None, before, note, told=True)
        why = f"above {longest:.2f} s, the longest pause: stop sending commands for 2 s"
        return unknown_finding(TIMEOUT_NAME, "", before, why)
    value = estimate.clock.timeout - estimate.problem.dt / 2.0  # a board looks once a loop
    half = _half(estimate, (-1, 1.0)) + 3.0 * estimate.problem.dt
    if estimate.slack[-1] > VAGUE_TIME:
        return unknown_finding(TIMEOUT_NAME, "", before, HANGS_ON_LAG)
    if half > 2.0 * VAGUE_TIME or value >= longest:
        return unknown_finding(TIMEOUT_NAME, "", before, "too vague: stop sending commands for 2 s")
    return ParameterFinding(TIMEOUT_NAME, "", value, value - half, value + half, before, told=True)


def _rate(
    config: RobotConfig, known: Identifiability, tracks: Sequence[BoardTrack]
) -> ParameterFinding:
    """The rate of feedback lines."""
    if not known.can(RATE_NAME):
        return unknown_finding(RATE_NAME, "", config.feedback_rate, known.missing[RATE_NAME, ""])
    found = feedback_lines.measure_line_rate(tracks)
    note = f"jitter {1e3 * found.jitter:.1f} ms"
    low, high = max(0.1 * found.rate, found.rate - found.half), found.rate + found.half
    if found.rate > config.firmware.loop_rate:
        return unknown_finding(
            RATE_NAME, "", config.feedback_rate, "more lines than the twin has loops"
        )
    return ParameterFinding(
        RATE_NAME, "", found.rate, low, high, config.feedback_rate, note, told=True
    )


def _quantum(
    estimate: MotorFit | None, config: RobotConfig, tracks: Sequence[BoardTrack]
) -> ParameterFinding:
    """The step of the printed speeds."""
    before = config.encoder.quantum
    speeds = np.concatenate([track.speeds for track in tracks]) if tracks else np.empty(0)
    found = estimate.quantum if estimate else feedback_lines.find_quantum(speeds)
    if found is None:
        why = "too few different speeds: record slow and fast driving"
        return unknown_finding(QUANTUM_NAME, "", before, why)
    if _counted(estimate, config, speeds):
        note = COUNTED_NOTE
    elif found.step <= feedback_lines.PRINTED_STEP:
        note = "finer than the two decimals of a line show"
    else:
        note = ""
    return ParameterFinding(
        QUANTUM_NAME, "", found.step, found.low, found.high, before, note, told=not note
    )


def _counted(estimate: MotorFit | None, config: RobotConfig, speeds: Floats) -> bool:
    """Whether the printed steps are no more than whole encoder counts."""
    if estimate is not None and estimate.counted and not estimate.printed.step:
        return True
    return feedback_lines.is_explained_by_counts(speeds, config, config.encoder.window, 0.0)


def sample_delays(estimate: MotorFit) -> tuple[float, ...]:
    """Quantiles of the delays of single steps, on top of the fitted one [s]; at least zero.

    Each block of the log has a delay of its own: the shift that explains its residuals best.
    """
    problem, solution = estimate.problem, estimate.solution
    rest = problem.residuals(solution.x, solution.deadbands)
    slope = problem.jacobian(solution.x, solution.deadbands)[:, -3]
    blocks = problem.blocks() % problem.blocks_of_wheel
    information = np.bincount(blocks, slope * slope)
    shifts = -np.bincount(blocks, slope * rest) / np.maximum(information, 1e-9)
    good = information > INFORMATIVE_SHARE * np.median(information[information > 0.0])
    extra = np.maximum(0.0, np.quantile(shifts[good], DELAY_QUANTILES))
    return tuple(round(float(one), 5) for one in extra)
