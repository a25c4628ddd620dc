"""Findings of the board: delay, averaging time, time-out, resolution, and its lines."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.identification import lines, pauses, quantum
from acsar_gym.identification.estimation import Estimate
from acsar_gym.identification.finding import Finding, unknown
from acsar_gym.identification.knowable import HANGS, LONG_PAUSE, Knowable
from acsar_gym.identification.motors import INFLATED, Z95
from acsar_gym.identification.solving import DELAY_BOUNDS, LONGEST_WINDOW
from acsar_gym.identification.tracks import Track

Floats = NDArray[np.float64]

VAGUE = 0.03
"""Half width above which a time isn't told [s]."""
SLACK = 0.01
"""A delay that is negative by more than this contradicts the baud rate [s]."""
QUANTILES = np.linspace(0.05, 0.95, 10)
"""Of the delays of single steps."""
INFORMATIVE = 0.2
"""A block tells a delay if it has this share of the median block's information."""
DELAY, WINDOW, TIMEOUT = "firmware.command_delay", "encoder.window", "firmware.command_timeout"
COUNTED = "whole encoder counts, as counts_per_revolution says"
RATE, QUANTUM = "firmware.feedback_rate", "encoder.quantum"


def of_board(
    estimate: Estimate | None, config: RobotConfig, known: Knowable, tracks: Sequence[Track]
) -> list[Finding]:
    """Findings of the board, in the order of the table."""
    return [
        _delay(estimate, config, known),
        _timeout(estimate, config, known, tracks),
        _rate(config, known, tracks),
        _window(estimate, config, known),
        _quantum(estimate, config, tracks),
    ]


def _half(estimate: Estimate, *weights: tuple[int, float]) -> float:
    """Half width of a sum of clock parameters, counted from the last one."""
    n = len(estimate.solution.x)
    row = np.zeros(n)
    for index, weight in weights:
        row[n + index] = weight
    fitted = Z95 * INFLATED * math.sqrt(max(0.0, float(row @ estimate.spread @ row)))
    return fitted + float(np.abs(row) @ estimate.slack)


def _delay(estimate: Estimate | None, config: RobotConfig, known: Knowable) -> Finding:
    """The delay of commands; the phase of the board's loops adds up to one to its interval."""
    before = config.firmware.command_delay
    if estimate is None or not known.can(DELAY):
        return unknown(DELAY, "", before, known.missing.get((DELAY, ""), "no wheel turned"))
    value = estimate.clock.delay
    half = _half(estimate, (-3, 1.0), (-2, -0.5)) + estimate.problem.dt
    if not DELAY_BOUNDS[0] * 0.9 < value < DELAY_BOUNDS[1] * 0.9:
        return unknown(DELAY, "", before, "the fit ended at its bound")
    if value + half < -SLACK:
        why = "less than the wire alone takes: check baud_rate and firmware.processing_time"
        return unknown(DELAY, "", before, why)
    if half > VAGUE:
        return unknown(DELAY, "", before, "too vague: record more steps")
    low, high = max(0.0, value - half), max(half, value + half)
    note = "on top of wire and processing_time; the board's loops blur it"
    return Finding(DELAY, "", max(0.0, value), low, high, before, note, told=True)


def _window(estimate: Estimate | None, config: RobotConfig, known: Knowable) -> Finding:
    """The averaging time of the encoders, in whole loops of the twin."""
    before = config.encoder.window
    if estimate is None or not known.can(WINDOW) or not known.can(DELAY):
        return unknown(WINDOW, "", before, known.missing.get((WINDOW, ""), "no wheel turned"))
    dt, value = estimate.problem.dt, estimate.clock.window
    half = _half(estimate, (-2, 1.0))
    if value > 0.95 * LONGEST_WINDOW:
        return unknown(WINDOW, "", before, "the fit ended at its bound")
    if not estimate.solution.free[-2] and not estimate.counted:
        return unknown(WINDOW, "", before, "too vague: record more steps at a higher line rate")
    if half > VAGUE:
        return unknown(WINDOW, "", before, "too vague: record more steps")
    whole = max(1, round(value / dt)) * dt
    low, high = max(dt, value - half - dt), value + half + dt
    note = "by encoder counts" if estimate.counted else ""
    return Finding(WINDOW, "", whole, min(low, whole), max(high, whole), before, note, told=True)


def _timeout(
    estimate: Estimate | None, config: RobotConfig, known: Knowable, tracks: Sequence[Track]
) -> Finding:
    """The command time-out, or that there is none."""
    before = config.firmware.command_timeout
    longest = pauses.longest(tracks)
    if estimate is None or not known.can(TIMEOUT):
        return unknown(TIMEOUT, "", before, known.missing.get((TIMEOUT, ""), "no wheel turned"))
    if not estimate.solution.free[-1]:
        if longest >= LONG_PAUSE:
            note = f"none: the wheels kept turning for {longest:.1f} s without commands"
            return Finding(TIMEOUT, "", None, None, None, before, note, told=True)
        why = f"above {longest:.2f} s, the longest pause: stop sending commands for 2 s"
        return unknown(TIMEOUT, "", before, why)
    value = estimate.clock.timeout - estimate.problem.dt / 2.0  # a board looks once a loop
    half = _half(estimate, (-1, 1.0)) + 3.0 * estimate.problem.dt
    if estimate.slack[-1] > VAGUE:
        return unknown(TIMEOUT, "", before, HANGS)
    if half > 2.0 * VAGUE or value >= longest:
        return unknown(TIMEOUT, "", before, "too vague: stop sending commands for 2 s")
    return Finding(TIMEOUT, "", value, value - half, value + half, before, told=True)


def _rate(config: RobotConfig, known: Knowable, tracks: Sequence[Track]) -> Finding:
    """The rate of feedback lines."""
    if not known.can(RATE):
        return unknown(RATE, "", config.feedback_rate, known.missing[RATE, ""])
    found = lines.measured(tracks)
    note = f"jitter {1e3 * found.jitter:.1f} ms"
    low, high = max(0.1 * found.rate, found.rate - found.half), found.rate + found.half
    if found.rate > config.firmware.loop_rate:
        return unknown(RATE, "", config.feedback_rate, "more lines than the twin has loops")
    return Finding(RATE, "", found.rate, low, high, config.feedback_rate, note, told=True)


def _quantum(estimate: Estimate | None, config: RobotConfig, tracks: Sequence[Track]) -> Finding:
    """The step of the printed speeds."""
    before = config.encoder.quantum
    speeds = np.concatenate([track.speeds for track in tracks]) if tracks else np.empty(0)
    found = estimate.quantum if estimate else quantum.found(speeds)
    if found is None:
        why = "too few different speeds: record slow and fast driving"
        return unknown(QUANTUM, "", before, why)
    if _counted(estimate, config, speeds):
        note = COUNTED
    elif found.step <= quantum.PRINTED:
        note = "finer than the two decimals of a line show"
    else:
        note = ""
    return Finding(QUANTUM, "", found.step, found.low, found.high, before, note, told=not note)


def _counted(estimate: Estimate | None, config: RobotConfig, speeds: Floats) -> bool:
    """Whether the printed steps are no more than whole encoder counts."""
    if estimate is not None and estimate.counted and not estimate.printed.step:
        return True
    return quantum.explained_by_counts(speeds, config, config.encoder.window, 0.0)


def delay_samples(estimate: Estimate) -> tuple[float, ...]:
    """Quantiles of the delays of single steps, on top of the fitted one [s]; at least zero.

    Each block of the log has a delay of its own: the shift that explains its residuals best.
    """
    problem, solution = estimate.problem, estimate.solution
    rest = problem.residuals(solution.x, solution.deadbands)
    slope = problem.jacobian(solution.x, solution.deadbands)[:, -3]
    blocks = problem.blocks() % problem.blocks_of_wheel
    information = np.bincount(blocks, slope * slope)
    shifts = -np.bincount(blocks, slope * rest) / np.maximum(information, 1e-9)
    good = information > INFORMATIVE * np.median(information[information > 0.0])
    extra = np.maximum(0.0, np.quantile(shifts[good], QUANTILES))
    return tuple(round(float(one), 5) for one in extra)
