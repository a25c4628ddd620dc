"""A log as the board saw it: commands when they arrived, lines when they were made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.kinematics import compute_sides, compute_twist
from acsar_gym.protocol import PRINTED_STEP, WHEELS, encode
from acsar_gym.recording.types import WireLog
from acsar_gym.tools.sysid.twin_replay import remove_jitter

Floats = NDArray[np.float64]


class Estimate(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float


PAUSE_GAP = 0.15
"""Time without a command that counts as a pause [s]."""
LATE_LINE = 0.006
"""Lines that this computer saw later than this after their time don't count [s]."""
LONGEST_GAP = 0.05
STALL_TIME = 0.5
"""A gap between lines that is longer than this and two periods is a stall, after which lines don't
count for a while, as commands were taken late [s]."""
FEWEST_CALM = 0.5
"""Stalls are ignored if fewer lines are left: then it is how the lines come."""
REST_LEAD = 0.5
"""Time at rest before the first command and reading; longer than encoders average [s]."""
HELD_OUT_BLOCK = 0.4
HELD_OUT_EVERY = 5
"""Length of the blocks [s] of which every fifth is held out: about a step of the manoeuvre."""
PAUSE_MARGIN = 0.3
"""Held-out blocks are this far from a pause, which is rare [s]."""
PIECE_TIME = 60.0
MOST_PIECES = 10
"""Longer logs are cut into pieces [s], and the most agitated are used: ten minutes tell everything,
and fit into memory."""
PIECE_LEAD = 2.0
"""A piece begins with so much time of commands without lines, in which older ones fade [s]."""
TURNING_SPEED = 1.0
"""Speed from which a wheel turns for sure [rad/s]."""
SAME_GEOMETRY = 1e-3
"""Geometries that differ by less than this share are one."""


@dataclass(frozen=True, eq=False)
class BoardTrack:
    """A part of a log as the board saw it, on the host's clock.

    Attributes:
        arrivals: When each command had arrived at the board and was processed, (n,) [s].
        commands: Speeds of the four wheels, (n, 4) [rad/s].
        stamps: When the board made each line, (m,) [s].
        speeds: Speeds of the four wheels, (m, 4) [rad/s].
        numbers: Place of each line among all that came, (m,); late lines are left out.
        held_out: Which lines a fit may not see, (m,).
        in_ros: Whether the board is a controller in ROS 2, with stamps of its own and no wire.
    """

    arrivals: Floats
    commands: Floats
    stamps: Floats
    speeds: Floats
    numbers: NDArray[np.intp]
    held_out: NDArray[np.bool_]
    in_ros: bool = False

    @property
    def duration(self) -> float:
        """Time that both commands and readings cover [s]."""
        end = min(self.stamps[-1], self.arrivals[-1])
        return max(0.0, float(end - max(self.stamps[0], self.arrivals[0])))

    @property
    def pauses(self) -> NDArray[np.intp]:
        """Indices of the last command before each pause."""
        return np.flatnonzero(np.diff(self.arrivals) > PAUSE_GAP)

    @property
    def longest_pause(self) -> float:
        """Longest time without commands while a wheel was to turn [s]."""
        turning = np.abs(self.commands[:-1]).max(axis=1) >= TURNING_SPEED
        return float(np.diff(self.arrivals)[turning].max(initial=0.0))

    def loop_edges(self, dt: float) -> Floats:
        """Begin of each firmware loop [s], for loops of `dt` [s]."""
        start = min(self.arrivals[0], self.stamps[0]) - REST_LEAD
        return np.asarray(start + dt * np.arange(int((self.stamps[-1] - start) / dt) + 2))

    def apply_timeout(self, timeout: float) -> tuple[Floats, Floats]:
        """Times of commands, and these, with zeros where the board's time-out [s] acts."""
        pauses = self.pauses
        pauses = pauses[np.diff(self.arrivals)[pauses] > timeout]
        arrivals = np.insert(self.arrivals, pauses + 1, self.arrivals[pauses] + timeout)
        return arrivals, np.insert(self.commands, pauses + 1, 0.0, axis=0)


def decode_tracks(logs: Sequence[WireLog], config: RobotConfig) -> list[BoardTrack]:
    """Decode the wire of one robot, one log for each episode.

    Returns:
        Tracks; of long logs, the parts in which most was commanded. None for logs without commands
        or readings.
    """
    tracks = [track for log in logs if (track := _decode_track(log, config)) is not None]
    if sum(track.duration for track in tracks) > MOST_PIECES * PIECE_TIME:
        pieces = [piece for track in tracks for piece in _cut_track(track)]
        pieces.sort(key=lambda piece: -np.abs(np.diff(piece.commands, axis=0)).sum())
        tracks = pieces[:MOST_PIECES]
    return [replace(track, held_out=_hold_out(track)) for track in tracks]


def _decode_track(log: WireLog, config: RobotConfig) -> BoardTrack | None:
    """Decode one episode of the wire; None if it holds no commands or no readings."""
    wire_time = 0.0 if log.stamped else config.wire_time
    sent, commands = log.commands(config)
    got, speeds = log.feedback(config)
    if len(sent) < 2 or len(got) < 2:
        return None

    # Of lines that came at once the newest counts, and none that this computer read late.
    chosen = np.append(np.diff(got) > 0.0, True)
    chosen &= got - remove_jitter(got, float(np.median(np.diff(got)))) < LATE_LINE
    stamps = got - wire_time
    arrivals = np.maximum.accumulate(sent) + wire_time
    chosen &= (stamps >= arrivals[0]) & (stamps <= arrivals[-1] + PAUSE_GAP)
    calm = chosen & ~_find_stalled(got)
    if calm.mean() > FEWEST_CALM:
        chosen = calm
    if chosen.sum() < 2:
        return None
    return BoardTrack(
        arrivals=arrivals,
        commands=commands,
        stamps=stamps[chosen],
        speeds=speeds[chosen],
        numbers=np.flatnonzero(chosen),
        held_out=np.zeros(int(chosen.sum()), np.bool_),
        in_ros=log.stamped,
    )


def _find_stalled(stamps: Floats) -> NDArray[np.bool_]:
    """Which lines came soon after a time without any: the computer, or the board, stood still."""
    gaps = np.diff(stamps)
    stalls = stamps[1:][gaps > LONGEST_GAP + 2.0 * float(np.median(gaps))]
    soon_after = np.searchsorted(stalls, stamps, side="right")
    return soon_after > np.searchsorted(stalls, stamps - STALL_TIME, side="right")


def _cut_track(track: BoardTrack) -> list[BoardTrack]:
    """Cut a track into pieces."""
    pieces = []
    for start in np.arange(track.stamps[0], track.stamps[-1], PIECE_TIME).tolist():
        lines = slice(*np.searchsorted(track.stamps, (start, start + PIECE_TIME)))
        sent = slice(*np.searchsorted(track.arrivals, (start - PIECE_LEAD, start + PIECE_TIME)))
        if lines.stop - lines.start < 2 or sent.stop - sent.start < 2:
            continue

        piece = replace(
            track,
            arrivals=track.arrivals[sent],
            commands=track.commands[sent],
            stamps=track.stamps[lines],
            speeds=track.speeds[lines],
            numbers=track.numbers[lines],
        )
        pieces.append(piece)
    return pieces


def _hold_out(track: BoardTrack) -> NDArray[np.bool_]:
    """Choose the lines that a fit may not see."""
    blocks = ((track.stamps - track.stamps[0]) / HELD_OUT_BLOCK).astype(int)
    held_out = blocks % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    for k in track.pauses:
        start = track.arrivals[k] - PAUSE_MARGIN
        end = track.arrivals[k + 1] + PAUSE_MARGIN
        held_out &= (track.stamps < start) | (track.stamps > end)
    return np.asarray(held_out)


def resend_twists(log: WireLog, sender: RobotConfig, robot: RobotConfig) -> WireLog:
    """Return a log of a robot in ROS with the commands that its controller made of the twists.

    Args:
        log: Log of the wire; that of a board stays as it is.
        sender: Robot by whose geometry commands were made into twists.
        robot: Robot by whose geometry its controller takes them.
    """
    if not log.stamped or robot.ros2.command == "wheel_speeds":
        return log
    if np.allclose(sender.twist_geometry, robot.twist_geometry, rtol=SAME_GEOMETRY, atol=0.0):
        return log

    stamps, speeds = log.commands(sender)
    letters = sender.wheels.motors
    lines = []
    for a, b, c, d in speeds.tolist():
        linear, angular = compute_twist(a, b, c, d, *sender.twist_geometry)
        sides = compute_sides(linear, angular, *robot.twist_geometry, np.inf)
        taken = (sides[0], sides[1], sides[1], sides[0])
        lines.append(encode(letters.to_wire(taken) if letters else taken))
    return replace(log, sent_stamps=stamps, sent=tuple(lines))


ANSWER_LAGS = np.arange(0.0, 0.5, 0.02)
"""Delays of an answer that are tried [s]."""
ANSWER_CORRELATION = 0.5
"""A wheel answers a command from this correlation on."""
ANSWER_ADVANTAGE = 0.3
"""By how much another wheel's command must explain it better than its own."""


def check_wheel_order(tracks: Sequence[BoardTrack]) -> None:
    """Check that no wheel is reversed or swapped; AcsarError names the first that is."""
    advice = "run 'acsar-gym doctor DEVICE --spin --out FILE' first, and give the file as --robot"
    if tracks[0].in_ros:
        advice = "name the joints in the order a, b, c, d in ros2.joints of the robot's file"
    advice += "; nothing was fitted"
    for wheel, name in enumerate(WHEELS):
        correlations = correlate_wheel(tracks, wheel)
        answer = correlations[wheel]
        best = int(np.argmax(np.abs(correlations)))
        if abs(correlations[best]) > max(ANSWER_CORRELATION, abs(answer) + ANSWER_ADVANTAGE):
            way = " backward" if correlations[best] < 0.0 else ""
            raise AcsarError(f"{name} answers {WHEELS[best]}'s command{way}: {advice}")
        if answer < -ANSWER_CORRELATION:
            raise AcsarError(f"{name} turns backward at forward commands: {advice}")


def correlate_wheel(tracks: Sequence[BoardTrack], wheel: int) -> Floats:
    """Correlation of a wheel's speed with each wheel's command, at its best delay, (4,)."""
    speeds = np.concatenate([track.speeds[:, wheel] for track in tracks])
    if np.abs(speeds).max() < TURNING_SPEED / 2.0:  # a dead wheel is named elsewhere
        return np.zeros(4)
    rows = []
    for lag in ANSWER_LAGS.tolist():
        parts = []
        for track in tracks:
            newest = np.searchsorted(track.arrivals, track.stamps - lag, side="right") - 1
            parts.append(np.where(newest[:, None] < 0, 0.0, track.commands[newest]))
        commands = np.concatenate(parts)
        norm = np.sqrt((commands**2).sum(0) * (speeds @ speeds))
        rows.append(speeds @ commands / np.maximum(norm, 1e-9))

    # Periodic commands are followed at one delay and opposed at another.
    high = np.max(rows, axis=0)
    low = np.min(rows, axis=0)
    return np.asarray(np.where(high >= -low - ANSWER_ADVANTAGE, high, low))


FINEST_STEP = 0.025
LARGEST_STEP = 2.0
"""Smallest step that two decimals show for sure, and largest that is looked for [rad/s]."""
FEWEST_SPEEDS = 20
"""Different speeds that tell a step."""
ROUNDING_SLACK = 0.001
"""Tolerance on top of the rounding to two decimals [rad/s]."""
DAMAGED_SHARE = 0.01
"""Share of numbers that may be off the steps: those of damaged lines."""


def find_quantum(speeds: Floats) -> Estimate | None:
    """Find the largest step of which all speeds are multiples, rounded or cut to two decimals.

    Args:
        speeds: Printed speeds [rad/s], any shape.

    Returns:
        The step; that of a line, and its interval from 0 on, if it is too fine to tell; None if too
        few different speeds were seen.
    """
    printed: Floats = np.asarray(np.round(np.abs(speeds[np.isfinite(speeds)]), 2), np.float64)
    values, counts = np.unique(printed[printed > 0.0], return_counts=True)
    if len(values) < 2:
        return None

    # Steps so dense that none is missed; most are excluded by a few numbers.
    largest = min(LARGEST_STEP, values.max() / 5.0)
    ratio = 2.0 * ROUNDING_SLACK / values.max()
    steps = np.exp(np.arange(np.log(2.0 * PRINTED_STEP), np.log(largest), ratio))
    few = values[np.linspace(0, len(values) - 1, 12).astype(int)]
    fits = np.zeros(len(steps), bool)
    for shift in (0.0, -PRINTED_STEP / 2.0):
        hopeful = np.flatnonzero(_find_misfits(few, steps, shift).sum(1) <= 2)
        misfits = _find_misfits(values, steps[hopeful], shift)
        fits[hopeful] |= misfits @ counts <= DAMAGED_SHARE * counts.sum()

    step = float(steps[fits][-1]) if fits.any() else PRINTED_STEP
    if len(values) < min(FEWEST_SPEEDS, values.max() / step / 2.0):
        return None
    if step < FINEST_STEP:
        return Estimate(PRINTED_STEP, 0.0, FINEST_STEP)
    near = steps[fits & (steps > 0.98 * step)]
    half = ROUNDING_SLACK / 2.0
    return Estimate(float(near.mean()), float(near[0]) - half, float(near[-1]) + half)


def _find_misfits(values: Floats, steps: Floats, shift: float) -> NDArray[np.bool_]:
    """Which values (columns), once shifted, are no multiple of each step (rows)."""
    shifted = values - shift
    away = shifted - steps[:, None] * np.round(shifted / steps[:, None])
    return np.asarray(np.abs(away) > PRINTED_STEP / 2.0 + ROUNDING_SLACK)
