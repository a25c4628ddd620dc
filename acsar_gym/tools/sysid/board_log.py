"""A log as the board saw it: commands when they arrived, lines when they were made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.kinematics import compute_sides, compute_twist
from acsar_gym.protocol import PRINTED_STEP, encode
from acsar_gym.recording.types import Floats, WireLog
from acsar_gym.tools.sysid.tracks import remove_jitter

Bools = NDArray[np.bool_]


class Estimate(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    @classmethod
    def around(cls, value: float, half: float) -> Estimate:
        """Return a value with the interval from value - half to value + half."""
        return cls(value, value - half, value + half)


PAUSE_GAP = 0.15
"""Time without a command that counts as a pause [s]."""
LATE_LINE = 0.006
"""Lines that this computer read later than this after their time don't count [s]."""
STALL_GAP = 0.05
"""A gap between lines that exceeds two periods by this is a stall of computer or board [s]."""
STALL_TIME = 0.5
"""Lines don't count for this time after a stall, since commands were taken late [s]."""
FEWEST_CALM = 0.5
"""Stalls are ignored if they leave a smaller share of lines: then all lines come like that."""
REST_LEAD = 0.5
"""Time at rest before the first command and line [s]. It is longer than encoders average."""
HELD_OUT_BLOCK = 0.4
"""Length of the blocks of which every fifth is held out [s]: about a step of the manoeuvre."""
HELD_OUT_EVERY = 5
PAUSE_MARGIN = 0.3
"""Distance of held-out blocks from a pause, which is rare and needed for the fit [s]."""
PIECE_TIME = 60.0
MOST_PIECES = 10
"""Longer logs are cut into pieces [s], and the most agitated are used. Ten minutes are enough, and
fit into memory."""
PIECE_LEAD = 2.0
"""Time of commands without lines at the start of a piece, in which earlier commands fade [s]."""
TURNING_SPEED = 1.0
"""Speed from which a wheel certainly turns [rad/s]."""
SAME_GEOMETRY = 1e-3
"""Geometries that differ by less than this share are the same."""
FINEST_STEP = 0.025
"""Smallest step that two decimals show [rad/s]."""
LARGEST_STEP = 2.0
"""Largest step that is looked for [rad/s]."""
FEWEST_SPEEDS = 20
"""Number of different speeds that show a step."""
ROUNDING_SLACK = 0.001
"""Tolerance on top of the rounding to two decimals [rad/s]."""
DAMAGED_SHARE = 0.01
"""Share of numbers that may be off the steps: those of damaged lines."""


@dataclass(frozen=True, eq=False)
class BoardTrack:
    """A part of a log as the board saw it, on the host's clock."""

    arrivals: Floats
    """Times at which commands had arrived at the board and were processed, (n,) [s]."""
    commands: Floats
    """Commanded speeds of the four wheels, (n, 4) [rad/s]."""
    stamps: Floats
    """Times at which the board made its lines, (m,) [s]."""
    speeds: Floats
    """Speeds of the four wheels, (m, 4) [rad/s]."""
    numbers: NDArray[np.intp]
    """Places of the lines among all that arrived, (m,). Late lines are left out."""
    in_ros: bool = False
    """Whether the board is a controller in ROS 2, with its own stamps and no wire."""

    @property
    def duration(self) -> float:
        """Time that both commands and lines cover [s]."""
        # Lines without commands show nothing, and neither do commands without lines.
        end = min(self.stamps[-1], self.arrivals[-1])
        return max(0.0, float(end - max(self.stamps[0], self.arrivals[0])))

    @property
    def pauses(self) -> NDArray[np.intp]:
        """Indices of the last command before each pause."""
        return np.flatnonzero(np.diff(self.arrivals) > PAUSE_GAP)

    @property
    def longest_pause(self) -> float:
        """Longest time without commands while a wheel was commanded to turn [s]."""
        # Wheels at rest don't show whether a board has a time-out.
        is_turning = np.abs(self.commands[:-1]).max(axis=1) >= TURNING_SPEED
        return float(np.diff(self.arrivals)[is_turning].max(initial=0.0))

    @property
    def held_out(self) -> Bools:
        """Whether a fit may not see a line, (m,)."""
        # Whole blocks, since neighbouring lines are almost copies of each other.
        blocks = ((self.stamps - self.stamps[0]) / HELD_OUT_BLOCK).astype(int)
        held_out = blocks % HELD_OUT_EVERY == HELD_OUT_EVERY - 1

        # A log has one pause or two, which the fit of the time-out needs.
        for k in self.pauses:
            start = self.arrivals[k] - PAUSE_MARGIN
            end = self.arrivals[k + 1] + PAUSE_MARGIN
            held_out &= (self.stamps < start) | (self.stamps > end)
        return np.asarray(held_out)

    def loop_edges(self, dt: float) -> Floats:
        """Start of each firmware loop [s], for loops of `dt` [s]."""
        # The wheels are at rest before the log, and the first window needs loops to average over.
        start = min(self.arrivals[0], self.stamps[0]) - REST_LEAD
        return np.asarray(start + dt * np.arange(int((self.stamps[-1] - start) / dt) + 2))

    def apply_timeout(self, timeout: float) -> tuple[Floats, Floats]:
        """Return times and commands, with zeros from the moments when a time-out [s] acts."""
        pauses = self.pauses
        pauses = pauses[np.diff(self.arrivals)[pauses] > timeout]

        # A zero command at the time-out has the same effect as the time-out itself.
        arrivals = np.insert(self.arrivals, pauses + 1, self.arrivals[pauses] + timeout)
        return arrivals, np.insert(self.commands, pauses + 1, 0.0, axis=0)

    def cut_piece(self, start: float) -> BoardTrack:
        """Return the piece from a time [s] on."""
        # Commands from before the piece still act on its first lines.
        end = start + PIECE_TIME
        lines = slice(*np.searchsorted(self.stamps, (start, end)))
        sent = slice(*np.searchsorted(self.arrivals, (start - PIECE_LEAD, end)))
        return replace(
            self,
            arrivals=self.arrivals[sent],
            commands=self.commands[sent],
            stamps=self.stamps[lines],
            speeds=self.speeds[lines],
            numbers=self.numbers[lines],
        )


def decode_tracks(logs: Sequence[WireLog], config: RobotConfig) -> list[BoardTrack]:
    """Decode the wire of one robot.

    Args:
        logs: Logs of the wire, one for each episode.
        config: Robot configuration.

    Returns:
        Tracks. Logs without commands or lines have none, and of long logs only the parts in which
        most was commanded are returned.
    """
    tracks = [track for log in logs if (track := _decode_track(log, config)) is not None]
    # Hours of driving straight ahead show less than a minute of manoeuvres.
    if sum(track.duration for track in tracks) > MOST_PIECES * PIECE_TIME:
        pieces = [
            track.cut_piece(start)
            for track in tracks
            for start in np.arange(track.stamps[0], track.stamps[-1], PIECE_TIME).tolist()
        ]
        pieces = [piece for piece in pieces if min(len(piece.stamps), len(piece.arrivals)) > 1]

        # The sum of all changes of the commands is how much a piece shows.
        pieces.sort(key=lambda piece: -np.abs(np.diff(piece.commands, axis=0)).sum())
        tracks = pieces[:MOST_PIECES]
    return tracks


def _decode_track(log: WireLog, config: RobotConfig) -> BoardTrack | None:
    """Decode one episode of the wire. None if it contains no commands or no lines."""
    # Topics of ROS have stamps of their own, and no wire.
    wire_time = 0.0 if log.stamped else config.wire_time
    # A fit needs at least an interval of both.
    sent, commands = log.commands(config)
    got, speeds = log.feedback(config)
    if len(sent) < 2 or len(got) < 2:
        return None

    # Of lines that arrived at once the newest counts, and none that this computer read late.
    gaps = np.diff(got)
    period = float(np.median(gaps))
    chosen = np.append(gaps > 0.0, True)
    chosen &= got - remove_jitter(got, period) < LATE_LINE
    stamps = got - wire_time
    arrivals = np.maximum.accumulate(sent) + wire_time
    chosen &= (stamps >= arrivals[0]) & (stamps <= arrivals[-1] + PAUSE_GAP)

    # Nor do those soon after a stall of the computer or the board.
    stalls = got[1:][gaps > STALL_GAP + 2.0 * period]
    soon_after = np.searchsorted(stalls, got, side="right")
    calm = chosen & (soon_after == np.searchsorted(stalls, got - STALL_TIME, side="right"))
    if calm.mean() > FEWEST_CALM:
        chosen = calm
    numbers = np.flatnonzero(chosen)
    if len(numbers) < 2:
        return None
    return BoardTrack(
        arrivals=arrivals,
        commands=commands,
        stamps=stamps[chosen],
        speeds=speeds[chosen],
        numbers=numbers,
        in_ros=log.stamped,
    )


def resend_twists(log: WireLog, sender: RobotConfig, robot: RobotConfig) -> WireLog:
    """Return a log of a robot in ROS with the commands that its controller made of the twists.

    Args:
        log: Log of the wire. That of a board is returned as it is.
        sender: Robot by whose geometry commands were made into twists.
        robot: Robot by whose geometry its controller takes them.
    """
    # Only a controller that takes twists converts them by its own geometry.
    if not log.stamped or robot.ros2.command == "wheel_speeds":
        return log
    if np.allclose(sender.twist_geometry, robot.twist_geometry, rtol=SAME_GEOMETRY, atol=0.0):
        return log

    # Back to the twists that were sent, then to the wheel speeds that the controller made.
    stamps, speeds = log.commands(sender)
    letters = sender.wheels.motors
    lines = []
    for a, b, c, d in speeds.tolist():
        linear, angular = compute_twist(a, b, c, d, *sender.twist_geometry)
        sides = compute_sides(linear, angular, *robot.twist_geometry, np.inf)
        taken = (sides[0], sides[1], sides[1], sides[0])
        lines.append(encode(letters.to_wire(taken) if letters else taken))
    return replace(log, sent_stamps=stamps, sent=tuple(lines))


def find_quantum(speeds: Floats) -> Estimate | None:
    """Find the largest step of which all speeds are multiples, rounded or cut to two decimals.

    Args:
        speeds: Printed speeds [rad/s], any shape.

    Returns:
        The step. If it is too fine to be seen, the step of two decimals with an interval from 0
        on. None if there are too few different speeds.
    """
    printed: Floats = np.asarray(np.round(np.abs(speeds), 2), np.float64)
    # A quantized encoder prints few different numbers, many times.
    values, counts = np.unique(printed[printed > 0.0], return_counts=True)
    if len(values) < 2:
        return None

    # The tried steps are so dense that none is missed. A few numbers exclude most of them.
    largest = min(LARGEST_STEP, values.max() / 5.0)
    ratio = 2.0 * ROUNDING_SLACK / values.max()
    steps = np.exp(np.arange(np.log(2.0 * PRINTED_STEP), np.log(largest), ratio))
    few = values[np.linspace(0, len(values) - 1, 12).astype(int)]
    fits = np.zeros(len(steps), bool)
    # Without a shift if numbers were rounded, with half a digit if they were cut.
    for shift in (0.0, -PRINTED_STEP / 2.0):
        hopeful = np.flatnonzero(_find_misfits(few - shift, steps).sum(axis=1) <= 2)
        misfits = _find_misfits(values - shift, steps[hopeful])
        fits[hopeful] |= misfits @ counts <= DAMAGED_SHARE * counts.sum()

    step = float(steps[fits][-1]) if fits.any() else PRINTED_STEP
    if len(values) < min(FEWEST_SPEEDS, values.max() / step / 2.0):
        return None

    # Any fine step explains numbers with two decimals.
    if step < FINEST_STEP:
        return Estimate(PRINTED_STEP, 0.0, FINEST_STEP)

    # Steps next to each other fit equally well: they are the interval.
    near = steps[fits & (steps > 0.98 * step)]
    half = ROUNDING_SLACK / 2.0
    return Estimate(float(near.mean()), float(near[0]) - half, float(near[-1]) + half)


def _find_misfits(values: Floats, steps: Floats) -> Bools:
    """Return whether each value (columns) isn't a multiple of each step (rows)."""
    away = values - steps[:, None] * np.round(values / steps[:, None])
    return np.asarray(np.abs(away) > PRINTED_STEP / 2.0 + ROUNDING_SLACK)
