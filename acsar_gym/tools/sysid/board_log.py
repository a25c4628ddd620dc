"""A log as the board saw it, and what it can tell, judged before anything is fitted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.protocol import MOTORS, PRINTED_STEP, WHEELS
from acsar_gym.recording.twin_replay import remove_jitter
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.board import measure_rate

Floats = NDArray[np.float64]


class Estimate(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def around(cls, value: float, half: float) -> Estimate:
        """The number with an interval of value - half to value + half."""
        return cls(value, value - half, value + half)


PAUSE_GAP = 0.15
"""Time without a command that counts as a pause [s]."""
HELD_OUT_BLOCK = 1.0
"""Length of the blocks of which some are held out [s]."""
HELD_OUT_EVERY = 5
"""One block of so many is held out."""
LATE_LINE = 0.006
"""Lines that this computer saw later than this after their time don't count [s]."""
LONGEST_GAP = 0.05
"""See `BoardTrack.stalls` [s]."""
REST_LEAD = 0.5
"""Time at rest before the first command and reading; longer than encoders average [s]."""
PAUSE_MARGIN = 0.3
"""Held-out blocks are this far from a pause [s]."""


@dataclass(frozen=True, eq=False)
class BoardTrack:
    """One episode of a log as the board saw it, on the host's clock.

    Attributes:
        arrivals: when each command had arrived at the board and was processed, (n,) [s].
        commands: of the four wheels, (n, 4) [rad/s].
        stamps: when the board made each line, (m,) [s].
        speeds: of the four wheels, (m, 4) [rad/s].
        held_out: which lines a fit may not see, (m,).
        numbers: of these lines among all that came, (m,); late ones are left out.
        stalls: when lines came again after none did for longer than `LONGEST_GAP` and two periods,
            (k,) [s]: the computer, or an emulated board, stood still.
        in_ros: whether the board is a controller in ROS 2, which gets commands within its limits of
            acceleration, over no wire.
    """

    arrivals: Floats
    commands: Floats
    stamps: Floats
    speeds: Floats
    held_out: NDArray[np.bool_]
    numbers: NDArray[np.intp]
    stalls: Floats = field(default_factory=lambda: np.empty(0))
    in_ros: bool = False

    @property
    def takes_sides(self) -> bool:
        """Whether all commands were the same for both wheels of each side."""
        return np.array_equal(self.commands[:, :2], self.commands[:, [3, 2]])

    @property
    def duration(self) -> float:
        """Time that both commands and readings cover [s]."""
        if len(self.stamps) < 2 or len(self.arrivals) < 2:
            return 0.0
        end = min(self.stamps[-1], self.arrivals[-1])
        return max(0.0, float(end - max(self.stamps[0], self.arrivals[0])))

    @property
    def pauses(self) -> NDArray[np.intp]:
        """Indices of the last command before each pause."""
        return np.flatnonzero(np.diff(self.arrivals) > PAUSE_GAP)

    def loop_edges(self, dt: float) -> Floats:
        """Begin of each firmware loop [s], for loops of `dt` [s]."""
        begin = min(self.arrivals[0], self.stamps[0]) - REST_LEAD
        return np.asarray(begin + dt * np.arange(int((self.stamps[-1] - begin) / dt) + 2))

    def apply_timeout(self, timeout: float) -> tuple[Floats, Floats]:
        """Commands and their times, with zeros where the board's time-out [s] acts."""
        pauses = self.pauses
        pauses = pauses[np.diff(self.arrivals)[pauses] > timeout]
        if not len(pauses):
            return self.arrivals, self.commands
        arrivals = np.insert(self.arrivals, pauses + 1, self.arrivals[pauses] + timeout)
        return arrivals, np.insert(self.commands, pauses + 1, 0.0, axis=0)


def decode_track(log: WireLog, config: RobotConfig) -> BoardTrack | None:
    """Decode one episode of the wire; None where it holds no commands or no readings."""
    took = 0.0 if log.stamped else config.wire_time
    sent, commands = log.commands(config)
    got, speeds = log.feedback(config)
    if len(sent) < 2 or len(got) < 2:
        return None
    last = np.append(np.diff(got) > 0.0, True)  # of lines that came at once, the newest
    last &= got - remove_jitter(got, float(np.median(np.diff(got)))) < LATE_LINE
    stamps, speeds, numbers = got[last] - took, speeds[last], np.flatnonzero(last)
    arrivals = np.maximum.accumulate(sent) + took
    seen = (stamps >= arrivals[0]) & (stamps <= arrivals[-1] + PAUSE_GAP)
    if not seen.any():
        return None
    stamps, speeds = stamps[seen], speeds[seen]
    block = ((stamps - stamps[0]) / HELD_OUT_BLOCK).astype(int)
    held_out = block % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    for k in np.flatnonzero(np.diff(arrivals) > PAUSE_GAP):
        begin, end = arrivals[k] - PAUSE_MARGIN, arrivals[k + 1] + PAUSE_MARGIN
        held_out &= (stamps < begin) | (stamps > end)
    stalls = got[1:][np.diff(got) > LONGEST_GAP + 2.0 * float(np.median(np.diff(got)))]
    numbers, in_ros = numbers[seen], log.stamped
    return BoardTrack(arrivals, commands, stamps, speeds, held_out, numbers, stalls, in_ros)


SHORTEST_LOG = 4.0
"""Log that is needed for anything but the lines themselves [s]."""
STEP_JUMP = 2.0
"""Change of a command that counts as a step [rad/s]."""
STEP_TIME = 0.25
"""Time within which it must happen [s]."""
STEP_DISTANCE = 0.2
"""Steps are at least this far from each other [s]."""
FEWEST_STEPS = 4
RAMP_JUMP = 4.0
"""Change within two ticks that shows a ramp [rad/s]."""
TURNING_SPEED = 1.0
"""Speed from which a wheel turns for sure [rad/s]."""
STEADY_TIME = 1.0
"""Time above TURNING_SPEED that a gain needs [s]."""
SLOW_BIN = 0.1
LARGEST_SLOW_RANGE = 3.0
SLOW_BIN_TIME = 0.06
"""Slow commands must cover each 0.1 rad/s for so long [s], up to the largest deadband."""
SMALLEST_SLOW_RANGE = 0.3
"""Smallest such range [rad/s]."""
LONG_PAUSE = 2.0
"""A board that keeps turning so long without commands has no time-out [s]."""
FEWEST_LINES = 20
HANGS_ON_LAG = (
    "hangs on the lag, which this log can't tell: command sudden changes of 2 rad/s or more"
)
NEVER_TURNED = "this wheel never turned"
WHEEL_PARAMETERS = ("motor.time_constant", "motor.gain", "motor.acceleration", "motor.deadband")
SHARED_PARAMETERS = ("firmware.command_delay", "encoder.window", "firmware.command_timeout")

ANSWER_LAGS = np.arange(0.0, 0.5, 0.02)
"""Delays of an answer that are tried [s]."""
DEAD_SPEED = 0.5
"""A wheel that never exceeds this is dead; that is said elsewhere [rad/s]."""
ANSWER_CORRELATION = 0.5
"""A wheel answers a command from this correlation on."""
ANSWER_ADVANTAGE = 0.3
"""By how much another wheel's command must explain it better than its own."""


@dataclass
class Identifiability:
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


def check_identifiability(tracks: Sequence[BoardTrack]) -> Identifiability:
    """Judge what the tracks of one robot can tell."""
    slowest = [_find_slow_range(tracks, k) for k in range(4)]
    missing = {
        (name, letter): reason
        for k, letter in enumerate(MOTORS)
        for name, reason in _explain_wheel(tracks, k, slowest[k]).items()
    }
    duration = sum(track.duration for track in tracks)
    if duration < SHORTEST_LOG:
        short = f"{duration:.1f} s of log: needs {SHORTEST_LOG:g} s or more"
        missing |= {(name, letter): short for name in WHEEL_PARAMETERS for letter in MOTORS}
        missing |= {(name, ""): short for name in SHARED_PARAMETERS}
    for name in ("motor.time_constant", "motor.acceleration"):  # slow answers hide delays
        if name == "motor.acceleration" and takes_twists(tracks):
            continue  # it got no faster ramps than its own
        if all((name, letter) in missing for letter in MOTORS):
            for shared in SHARED_PARAMETERS[:2]:
                missing.setdefault((shared, ""), missing[name, "a"])
    if not any(
        np.abs(track.commands[k]).max() >= TURNING_SPEED for track in tracks for k in track.pauses
    ):
        reason = "no pause: stop sending commands for 2 s while wheels turn"
        missing.setdefault(("firmware.command_timeout", ""), reason)
    if sum(len(track.stamps) for track in tracks) < FEWEST_LINES or duration < 1.0:
        missing["firmware.feedback_rate", ""] = "too few lines of feedback"
    return Identifiability(missing, slowest)


def takes_twists(tracks: Sequence[BoardTrack]) -> bool:
    """Return whether these are twists for a controller in ROS, within its own limits."""
    return all(track.in_ros and track.takes_sides for track in tracks)


def _explain_wheel(tracks: Sequence[BoardTrack], k: int, slow: float) -> dict[str, str]:
    """What the log can't tell of one wheel, and why."""
    if not any((np.abs(track.speeds[:, k]) > TURNING_SPEED / 2.0).any() for track in tracks):
        return dict.fromkeys(WHEEL_PARAMETERS, NEVER_TURNED)
    missing, steps, ramps, steady = {}, 0, 0, 0.0
    for track in tracks:
        intervals = np.diff(track.arrivals)
        steps += _count_steps(track, k, STEP_JUMP, STEP_TIME)
        ramps += _count_steps(track, k, RAMP_JUMP, 2.5 * float(np.median(intervals)))
        turning = np.abs(track.commands[:-1, k]) >= TURNING_SPEED
        steady += float(np.minimum(intervals, PAUSE_GAP)[turning].sum())
    if steps < FEWEST_STEPS:
        missing["motor.time_constant"] = "no steps: command sudden changes of 2 rad/s or more"
    if ramps < FEWEST_STEPS:
        missing["motor.acceleration"] = "no large steps: jump by 4 rad/s or more in one tick"
    if steady < STEADY_TIME:
        missing["motor.gain"] = "no steady turning: hold 1 rad/s or more for a second"
    both = min(
        max(float((sign * track.commands[:, k]).max()) for track in tracks) for sign in (1.0, -1.0)
    )
    if both < SMALLEST_SLOW_RANGE:
        missing["motor.deadband"] = "no reversal: command both directions, slowly through zero"
    elif slow < SMALLEST_SLOW_RANGE:
        missing["motor.deadband"] = "no staircase: command slow speeds, through zero and back"
    elif "motor.time_constant" in missing:  # a lag delays what a deadband does, too
        missing["motor.deadband"] = HANGS_ON_LAG
    return missing


def _count_steps(track: BoardTrack, k: int, jump: float, within: float) -> int:
    """Number of sudden changes of a wheel's command."""
    times, values = track.arrivals, track.commands[:, k]
    later = np.searchsorted(times, times + within, side="right") - 1
    big = np.flatnonzero(np.abs(values[later] - values) >= jump)
    count, last = 0, -np.inf
    for time in times[big]:
        if time - last > STEP_DISTANCE:
            count, last = count + 1, time
    return count


def _find_slow_range(tracks: Sequence[BoardTrack], k: int) -> float:
    """Top of the slow commands that are covered without a hole, in both directions [rad/s]."""
    edges = np.arange(0.0, LARGEST_SLOW_RANGE + SLOW_BIN / 2.0, SLOW_BIN)
    tops = []
    for sign in (1.0, -1.0):
        covered = np.zeros(len(edges) - 1)
        for track in tracks:
            held = np.minimum(np.diff(track.arrivals), PAUSE_GAP)
            slow = sign * track.commands[:-1, k]
            covered += np.histogram(slow[slow > 0.0], edges, weights=held[slow > 0.0])[0]
        holes = np.flatnonzero(covered < SLOW_BIN_TIME)
        tops.append(edges[holes[0]] if len(holes) else LARGEST_SLOW_RANGE)
    return float(min(tops))


def check_wheel_order(tracks: Sequence[BoardTrack]) -> None:
    """Check that no wheel is reversed or swapped; AcsarError names the first that is.

    Short logs, from which nothing is fitted, aren't checked.
    """
    if sum(track.duration for track in tracks) < SHORTEST_LOG:
        return
    advice = "run 'acsar-gym doctor DEVICE --spin --out FILE' first, and give the file as --robot"
    if tracks[0].in_ros:
        advice = "name the joints in the order a, b, c, d in ros2.joints of the robot's file"
    advice += "; nothing was fitted"
    for wheel, name in enumerate(WHEELS):
        found = correlate_wheel(tracks, wheel)
        best = int(np.argmax(np.abs(found)))
        if abs(found[best]) > max(ANSWER_CORRELATION, abs(found[wheel]) + ANSWER_ADVANTAGE):
            way = " backward" if found[best] < 0.0 else ""
            raise AcsarError(f"{name} answers {WHEELS[best]}'s command{way}: {advice}")
        if found[wheel] < -ANSWER_CORRELATION:
            raise AcsarError(f"{name} turns backward at forward commands: {advice}")


def correlate_wheel(tracks: Sequence[BoardTrack], wheel: int) -> Floats:
    """Correlation of a wheel's speed with each wheel's command, at its best delay, (4,)."""
    speeds = np.concatenate([track.speeds[:, wheel] for track in tracks])
    if np.abs(speeds).max() < DEAD_SPEED:
        return np.zeros(4)
    rows = []
    for lag in ANSWER_LAGS.tolist():
        parts = []
        for track in tracks:  # what was commanded this long before each line; first of all zero
            newest = np.searchsorted(track.arrivals, track.stamps - lag, side="right") - 1
            parts.append(np.where(newest[:, None] < 0, 0.0, track.commands[newest]))
        commands = np.concatenate(parts)
        norm = np.sqrt((commands**2).sum(0) * (speeds @ speeds))
        rows.append(speeds @ commands / np.maximum(norm, 1e-9))
    high, low = np.max(rows, 0), np.min(rows, 0)
    # Periodic commands have both signs.
    return np.asarray(np.where(high >= -low - ANSWER_ADVANTAGE, high, low))


# What the lines show by themselves: their rate and jitter, and the step of printed speeds

LEAST_RATE_SHARE = 0.002
"""Least half width of the rate's interval, as a share: clocks differ by that much."""
FINEST_QUANTUM = 0.025
"""Smallest step that two decimals show for sure [rad/s]."""
LARGEST_QUANTUM = 2.0
"""Largest step that is looked for [rad/s]."""
FEWEST_SPEEDS = 20
"""Different speeds that are needed, unless fewer can't be multiples of a step by chance."""
ROUNDING_SLACK = 0.001
"""Tolerance on top of the rounding to two decimals [rad/s]."""
SAME_QUANTUM = 0.01
"""Steps that differ by less than this share are one."""
CHANCE_LIMIT = 1e-6
"""Probability below which an explanation isn't luck."""
OUTLIER_SHARE = 0.01
"""Share of numbers that may be off the steps: damaged lines."""


class LineRate(NamedTuple):
    """Rate of feedback lines [Hz], half width of its interval, and their jitter [s]."""

    rate: float
    half: float
    jitter: float


def measure_line_rate(tracks: Sequence[BoardTrack]) -> LineRate:
    """Measure the lines, where a stalled host may have read some late and in bursts.

    The rate is measured as `doctor` measures it, see `measure_rate`.
    """
    slopes, spans = [], []
    for track in tracks:
        if len(track.stamps) > 1:
            slopes.append(measure_rate(track.stamps.tolist(), track.numbers.tolist()))
            spans.append(float(np.ptp(track.stamps)))
    rate = float(np.average(slopes, weights=spans))
    gaps = np.concatenate([np.diff(track.stamps) for track in tracks])
    steps = np.maximum(1.0, np.round(gaps * rate))
    jitter = float(np.std(gaps - steps / rate))
    half = rate * max(LEAST_RATE_SHARE, 2.0 * jitter * rate / max(1.0, len(gaps) - 1.0))
    return LineRate(rate, half, jitter)


def find_quantum(speeds: Floats) -> Estimate | None:
    """Find the largest step of which all speeds are multiples, rounded or cut to two decimals.

    Args:
        speeds: printed [rad/s], any shape.

    Returns:
        The step; None where too few different speeds were seen to tell.
    """
    printed: Floats = np.asarray(np.round(np.abs(speeds[np.isfinite(speeds)]), 2), np.float64)
    values, counts = np.unique(printed[printed > 0.0], return_counts=True)
    if len(values) < 2:
        return None
    shares = counts / counts.sum()
    largest = min(LARGEST_QUANTUM, values.max() / 5.0)
    ratio = 2.0 * ROUNDING_SLACK / values.max()  # so dense that no step is missed
    steps = np.exp(np.arange(math.log(2.0 * PRINTED_STEP), math.log(largest), ratio))
    few = values[np.linspace(0, len(values) - 1, 12).astype(int)]
    fits = np.zeros(len(steps), bool)
    for low, high in ((-PRINTED_STEP / 2.0, PRINTED_STEP / 2.0), (-PRINTED_STEP, 0.0)):
        hopeful = np.flatnonzero(_find_misfits(few, steps, low, high).sum(1) <= 2)
        misfits = _find_misfits(values, steps[hopeful], low, high)
        fits[hopeful] |= misfits @ shares <= OUTLIER_SHARE
    fitting = steps[fits]
    step = float(fitting[-1]) if len(fitting) else PRINTED_STEP
    if len(values) < FEWEST_SPEEDS:
        chance = (PRINTED_STEP + 2.0 * ROUNDING_SLACK) / step  # that a number is a multiple
        if 2.0 * len(steps) * chance ** len(values) > CHANCE_LIMIT:
            return None
    if step < FINEST_QUANTUM:
        return Estimate(PRINTED_STEP, 0.0, FINEST_QUANTUM)
    near = fitting[fitting > 0.98 * step]
    half = ROUNDING_SLACK / 2.0
    return Estimate(float(near.mean()), float(near[0]) - half, float(near[-1]) + half)


def _find_misfits(values: Floats, steps: Floats, low: float, high: float) -> NDArray[np.bool_]:
    """Which values (columns) lie further than low to high from a multiple of each step (rows)."""
    middle, half = (low + high) / 2.0, (high - low) / 2.0 + ROUNDING_SLACK
    shifted = values - middle
    away = shifted - steps[:, None] * np.round(shifted / steps[:, None])
    return np.asarray(np.abs(away) > half)


def count_speed(config: RobotConfig, window: float) -> float:
    """Speed of one encoder count in the averaging window [rad/s]."""
    return 2.0 * math.pi / (config.encoder.counts_per_revolution * window)


def is_explained_by_counts(speeds: Floats, config: RobotConfig, window: float, step: float) -> bool:
    """Whether only whole encoder counts, as configured, explain which numbers were printed.

    Args:
        speeds: printed [rad/s], any shape.
        config: of the robot; tells counts_per_revolution.
        window: averaging time of the encoders [s].
        step: to which the board rounds [rad/s].

    Returns:
        False also where any numbers would be explained, as where counts are finer than the step.
    """
    values = np.unique(np.round(np.abs(speeds[np.isfinite(speeds)]), 2))
    counts = count_speed(config, window)
    near = np.round(values / counts) + np.array([[-1.0], [0.0], [1.0]])
    possible = _round_to_step(near * counts, step)
    hit = np.abs(possible - values).min(0) <= PRINTED_STEP / 2.0 + ROUNDING_SLACK
    chance = min(1.0, max(step, PRINTED_STEP) / counts)
    return bool(hit.mean() >= 1.0 - OUTLIER_SHARE and chance ** len(values) < CHANCE_LIMIT)


def mean_printed_speeds(speeds: Floats, counts: float, step: float, cut: float = 0.0) -> Floats:
    """Mean of what is printed for true speeds, given the encoder's counts and the step.

    Args:
        speeds: true mean speeds of windows [rad/s].
        counts: speed of one encoder count [rad/s]; 0 for an encoder without counts.
        step: of the printed numbers [rad/s]; 0 for none.
        cut: step to which speeds are cut towards zero, which `add_cut_half` mends [rad/s]; 0 for
            none.
    """
    if cut > 0.0:
        return add_cut_half(np.trunc(speeds / cut) * cut, cut)
    if counts <= 0.0:
        return _round_to_step(speeds, step)
    whole = np.floor(speeds / counts)
    share = speeds / counts - whole
    low, high = _round_to_step(whole * counts, step), _round_to_step((whole + 1.0) * counts, step)
    return (1.0 - share) * low + share * high


def add_cut_half(speeds: Floats, cut: float) -> Floats:
    """Add the half step that a board which cuts speeds to whole steps loses on average [rad/s]."""
    return speeds + np.sign(speeds) * cut / 2.0


def _round_to_step(speeds: Floats, step: float) -> Floats:
    return step * np.round(speeds / step) if step > 0.0 else speeds
