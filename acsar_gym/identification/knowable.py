"""What a log can tell, judged from its commands before anything is fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from acsar_gym.identification.tracks import GAP, Track
from acsar_gym.protocol import MOTORS

Floats = NDArray[np.float64]

SHORTEST = 4.0
"""Log that is needed for anything but the lines themselves [s]."""
JUMP = 2.0
"""Change of a command that counts as a step [rad/s]."""
SUDDEN = 0.25
"""Time within which it must happen [s]."""
APART = 0.2
"""Steps are at least this far from each other [s]."""
FEWEST_STEPS = 4
RAMP_JUMP = 4.0
"""Change within two ticks that shows a ramp [rad/s]."""
TURNING = 1.0
"""Speed from which a wheel turns for sure [rad/s]."""
STEADY = 1.0
"""Time above TURNING that a gain needs [s]."""
BIN = 0.1
MOST_SLOW = 3.0
BIN_TIME = 0.06
"""Slow commands must cover each 0.1 rad/s for so long [s], up to the largest deadband."""
LEAST_SLOW = 0.3
"""Smallest such range [rad/s]."""
LONG_PAUSE = 2.0
"""A board that keeps turning so long without commands has no time-out [s]."""
FEWEST_LINES = 20
HANGS = "hangs on the lag, which this log can't tell: command sudden changes of 2 rad/s or more"
NEVER_TURNED = "this wheel never turned"


@dataclass
class Knowable:
    """What a log can tell, and why not the rest.

    Attributes:
        missing: parameter (such as "motor.deadband") and wheel ("a" to "d", or "") of what can't
            be told, with the reason and the manoeuvre that is missing.
        slowest: range of slow commands that shows a deadband, for each wheel [rad/s].
    """

    missing: dict[tuple[str, str], str] = field(default_factory=dict)
    slowest: list[float] = field(default_factory=lambda: [0.0] * 4)

    def can(self, name: str, wheel: str = "") -> bool:
        """Whether the log can tell a parameter."""
        return (name, wheel) not in self.missing


PER_WHEEL = ("motor.time_constant", "motor.gain", "motor.acceleration", "motor.deadband")
SHARED = ("firmware.command_delay", "encoder.window", "firmware.command_timeout")


def judged(tracks: Sequence[Track]) -> Knowable:
    """Judge what the tracks of one robot can tell."""
    known = Knowable()
    duration = sum(track.duration for track in tracks)
    for k, letter in enumerate(MOTORS):
        known.slowest[k] = _slow_range(tracks, k)
        for name, reason in _wheel(tracks, k, known.slowest[k]).items():
            known.missing[name, letter] = reason
    if duration < SHORTEST:
        short = f"{duration:.1f} s of log: needs {SHORTEST:g} s or more"
        known.missing |= {(name, letter): short for name in PER_WHEEL for letter in MOTORS}
        known.missing |= {(name, ""): short for name in SHARED}
    _hide_delays(known)
    if not any(_active(track, k) for track in tracks for k in track.pauses):
        reason = "no pause: stop sending commands for 2 s while wheels turn"
        known.missing.setdefault(("firmware.command_timeout", ""), reason)
    if sum(len(track.stamps) for track in tracks) < FEWEST_LINES or duration < 1.0:
        known.missing["firmware.feedback_rate", ""] = "too few lines of feedback"
    return known


def _hide_delays(known: Knowable) -> None:
    """Note that delays can't be told where no wheel's lag or ramp can: slow answers hide them."""
    for name in ("motor.time_constant", "motor.acceleration"):
        if not any(known.can(name, letter) for letter in MOTORS):
            for shared in SHARED[:2]:
                known.missing.setdefault((shared, ""), known.missing[name, "a"])


def _wheel(tracks: Sequence[Track], k: int, slow: float) -> dict[str, str]:
    """What the log can't tell of one wheel."""
    if not any((np.abs(track.speeds[:, k]) > TURNING / 2.0).any() for track in tracks):
        return dict.fromkeys(PER_WHEEL, NEVER_TURNED)
    missing = {}
    if sum(_steps(track, k, JUMP, SUDDEN) for track in tracks) < FEWEST_STEPS:
        missing["motor.time_constant"] = "no steps: command sudden changes of 2 rad/s or more"
    if sum(_steps(track, k, RAMP_JUMP, 2.5 * _tick(track)) for track in tracks) < FEWEST_STEPS:
        missing["motor.acceleration"] = "no large steps: jump by 4 rad/s or more in one tick"
    if sum(_time_above(track, k) for track in tracks) < STEADY:
        missing["motor.gain"] = "no steady turning: hold 1 rad/s or more for a second"
    both = min(
        max(float((sign * track.commands[:, k]).max()) for track in tracks) for sign in (1.0, -1.0)
    )
    if both < LEAST_SLOW:
        missing["motor.deadband"] = "no reversal: command both directions, slowly through zero"
    elif slow < LEAST_SLOW:
        missing["motor.deadband"] = "no staircase: command slow speeds, through zero and back"
    elif "motor.time_constant" in missing:  # a lag delays what a deadband does, too
        missing["motor.deadband"] = HANGS
    return missing


def _tick(track: Track) -> float:
    return float(np.median(np.diff(track.arrivals)))


def _steps(track: Track, k: int, jump: float, within: float) -> int:
    """Number of sudden changes of a wheel's command."""
    times, values = track.arrivals, track.commands[:, k]
    later = np.searchsorted(times, times + within, side="right") - 1
    big = np.flatnonzero(np.abs(values[later] - values) >= jump)
    count, last = 0, -np.inf
    for time in times[big]:
        if time - last > APART:
            count, last = count + 1, time
    return count


def _time_above(track: Track, k: int) -> float:
    """Time for which a wheel was commanded to turn [s]."""
    held = np.minimum(np.diff(track.arrivals), GAP)
    return float(held[np.abs(track.commands[:-1, k]) >= TURNING].sum())


def _slow_range(tracks: Sequence[Track], k: int) -> float:
    """Top of the slow commands that are covered without a hole, in both directions [rad/s]."""
    edges = np.arange(0.0, MOST_SLOW + BIN / 2.0, BIN)
    tops = []
    for sign in (1.0, -1.0):
        covered = np.zeros(len(edges) - 1)
        for track in tracks:
            held = np.minimum(np.diff(track.arrivals), GAP)
            slow = sign * track.commands[:-1, k]
            covered += np.histogram(slow[slow > 0.0], edges, weights=held[slow > 0.0])[0]
        holes = np.flatnonzero(covered < BIN_TIME)
        tops.append(edges[holes[0]] if len(holes) else MOST_SLOW)
    return float(min(tops))


def _active(track: Track, k: int) -> bool:
    """Whether wheels were commanded to turn before a pause."""
    return bool(np.abs(track.commands[k]).max() >= TURNING)
