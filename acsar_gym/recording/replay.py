"""Plays recordings again: a tape of what arrived, or the recorded commands through the twin."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.config.sections import WIRE_LETTERS
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.firmware import Firmware
from acsar_gym.recording.types import Episode, Floats, Recording, WireLog
from acsar_gym.truth import GroundTruth

PHASE_TOLERANCE = 0.0005
"""Phases that differ by less are the same [s]."""
JITTER_WINDOW = 50
"""Number of lines over which the board's clock is followed."""
JITTER_RANK = 2
"""How many earlier lines of a window may be late by more than half a period."""
PERIODIC_SHARE = 0.25
"""Lines count as periodic if half of them are late by less than this share of the period."""
ROBOT_LENGTHS = ("wheel_radius", "wheel_separation", "wheelbase")
LENGTH_TOLERANCE = 0.1
"""Lengths of one robot differ by less than this share: a calibration changes them a little."""


class Tape:
    """Plays the control periods of an episode.

    Args:
        episode: of a recording.

    Attributes: `now`, the time at the end of the newest period [s]; `first_period`, how long the
    first one lasts [s]; `echoes`, whether what arrived has echoes.
    """

    def __init__(self, episode: Episode) -> None:
        self._first_tick = float(episode.stamps[0]) if len(episode.stamps) else math.inf
        self._periods = periods = episode.exchanges
        self._wire, self._turns = episode.wire, episode.revolutions
        self.echoes = self._wire.echoes
        self._writes, self._pieces = (
            np.concatenate([[0], np.cumsum(np.maximum(counts, 0))])
            for counts in (periods.writes, periods.pieces)
        )
        self._next = 0
        self._written = 0
        self._revolution = -1
        self.now = episode.start
        self.first_period = float(periods.stamps[0]) - self.now if len(periods.stamps) else 0.0

    @property
    def place(self) -> str:
        """Where the tape is, for messages."""
        tick = self._next - int(np.searchsorted(self._periods.stamps, self._first_tick))
        return f"tick {tick}" if tick > 0 else f"period {self._next} of the reset"

    @property
    def is_over(self) -> bool:
        """Whether all periods have been played."""
        return self._next >= len(self._periods.stamps)

    @property
    def has_gap(self) -> bool:
        """Whether the recording lacks the next period, or bytes of it."""
        wire, number = self._wire, self._next
        lacks_sent = bool(self._writes[number + 1] > len(wire.sent))
        lacks_got = bool(self._pieces[number + 1] > len(wire.got))
        return lacks_sent or lacks_got or int(self._periods.numbers[number]) != number

    def wrote(self) -> None:
        """Move on to the time at which the next write was done, where time was real."""
        number = int(self._writes[self._next]) + self._written
        self._written += 1
        stamps = self._wire.sent_stamps
        if self.lateness is not None and number < len(stamps):
            self.now = max(self.now, float(stamps[number]))

    def next(self) -> tuple[bytes, bytes]:
        """Play a period; returns what was sent and what arrived in it."""
        number, wire = self._next, self._wire
        self._next += 1
        self._written = 0
        self.now = float(self._periods.stamps[number])
        sent = wire.sent[self._writes[number] : self._writes[number + 1]]
        got = wire.got[self._pieces[number] : self._pieces[number + 1]]
        return b"".join(sent), b"".join(got)

    @property
    def rest(self) -> bytes:
        """What was sent after the last period, such as the stop at the end."""
        return b"".join(self._wire.sent[self._writes[-1] :])

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth at the end of the newest period; None where it wasn't recorded."""
        if not len(self._periods.truth):
            return None
        x, y, theta, linear, angular, contact = self._periods.truth[max(self._next - 1, 0)].tolist()
        if math.isnan(x):
            return None
        return GroundTruth((x, y, theta), (linear, angular), bool(contact))

    @property
    def lateness(self) -> float | None:
        """Lateness of the newest period [s]; None where time was simulated."""
        if not len(self._periods.lateness):
            return None
        late = float(self._periods.lateness[max(self._next - 1, 0)])
        return None if math.isnan(late) else late

    @property
    def arrivals(self) -> list[tuple[float, bytes]]:
        """When the bytes of the newest period arrived [s]."""
        wire, number = self._wire, self._next
        span = slice(self._pieces[max(number - 1, 0)], self._pieces[number])
        return list(zip(wire.got_stamps[span].tolist(), wire.got[span], strict=True))

    def revolution(self) -> tuple[float, Floats] | None:
        """End [s] of the newest revolution of the LiDAR, and its bearings, distances and times.

        They are (3, n), as in `Revolutions.measured`; None where there is no revolution.
        """
        turns, place = self._turns, self._revolution
        while place + 1 < len(turns.stamps) and turns.exchanges[place + 1] < self._next:
            place += 1
        self._revolution = place
        return (float(turns.stamps[place]), turns.measured[place]) if place >= 0 else None

    def oldest_measurement(self) -> float:
        """Age that a measurement reaches while its revolution is the LiDAR's newest one [s]."""
        turns, ends = self._turns, self._periods.stamps
        if not (len(turns.stamps) and len(ends)):
            return 0.0
        followed = np.append(turns.exchanges[1:], len(ends) - 1)  # then the next one is read
        until: list[float] = ends[np.clip(followed, 0, len(ends) - 1)].tolist()
        ages = zip(until, turns.measured, strict=True)
        return max(end - float(measured[2].min(initial=end)) for end, measured in ages)


@dataclass(frozen=True, eq=False)
class TwinReplay:
    """What the twin did with recorded commands."""

    wire: WireLog
    """The recorded bytes to the board, and those that the twin answered."""
    poses: Floats
    """(n, 3): the twin's true pose at the times asked for: x [m], y [m], theta [rad, unwrapped];
    it begins at the origin."""


def replay_commands(
    config: RobotConfig, log: WireLog, stamps: Floats, *, body: str = "planar"
) -> TwinReplay:
    """Send recorded command bytes to a twin at their recorded times.

    The twin stands at the origin when the log begins. Its clock is set so that its feedback lines
    arrive at the same phase as the recorded ones: that phase is a matter of when a board was
    switched on, and no property of it.

    Args:
        config: of the twin.
        log: the recorded bytes.
        stamps: (n,) times at which the twin's pose is wanted [s], ascending.
        body: physics, such as "planar".

    Raises:
        ConfigError: the log holds no commands, or for another body.
    """
    if not len(log.sent_stamps):
        raise ConfigError("the log holds no commands to replay")
    robot = make_body(body, config)
    try:
        firmware = Firmware(config, robot)
        begin = now = _find_beginning(config, firmware, log)
        last = float(log.got_stamps[-1]) if len(log.got_stamps) else -math.inf
        pieces: list[tuple[float, bytes]] = []
        poses: list[tuple[float, float, float]] = []
        # At equal times the pose comes first: it ends a tick, and the command begins the next one.
        sent = zip(log.sent_stamps.tolist(), itertools.repeat(1), log.sent, strict=False)
        events: list[tuple[float, int, bytes | None]]
        events = [*((stamp, 0, None) for stamp in stamps.tolist()), *sent, (last, 2, b"")]
        for when, _, data in sorted(events, key=lambda event: event[:2]):
            if when > now:
                firmware.advance(when - now)
                pieces += [(begin + stamp, line) for stamp, line in firmware.arrived]
                now = when
            if data is None:
                poses.append(robot.truth.pose)
            else:
                firmware.receive(data)
    finally:
        robot.close()
    track = np.array(poses, np.float64).reshape(-1, 3)
    track[:, 2] = np.unwrap(track[:, 2])
    answered = np.array([stamp for stamp, _ in pieces]), tuple(data for _, data in pieces)
    return TwinReplay(WireLog(log.sent_stamps, log.sent, *answered, echoed=False), track)


def _find_beginning(config: RobotConfig, firmware: Firmware, log: WireLog) -> float:
    """Return the time of the log at which the twin's clock is zero [s].

    It is the latest one before the first command at which the phase of the twin's lines is that of
    the recorded ones.
    """
    period, first = 1.0 / config.feedback_rate, float(log.sent_stamps[0])
    recorded = log.feedback(config)[0]
    if len(recorded) < 2:
        return first
    firmware.advance(4.0 * period)
    own = np.array([stamp for stamp, _ in firmware.arrived])
    firmware.reset()
    if not len(own):
        return first
    phases = [
        float(np.angle(np.exp(2j * math.pi * stamps / period).mean())) / (2.0 * math.pi) * period
        for stamps in (remove_jitter(recorded, period), own)
    ]
    ahead = math.fmod(first - (phases[0] - phases[1]), period)
    ahead += period if ahead < 0.0 else 0.0
    return first if min(ahead, period - ahead) < PHASE_TOLERANCE else first - ahead


def remove_jitter(stamps: Floats, period: float) -> Floats:
    """Estimate when nearly periodic lines would have arrived without delays by the host.

    A board sends its lines by its own clock; its host's scheduler and adapter see them at that time
    or later. So within a window the phase of the earliest lines is that of the board's clock, and
    every line is late by what its phase is after it.

    Args:
        stamps: (k,) times of arrival [s], ascending.
        period: nominal period [s]; the board's own may differ by a few percent.

    Returns:
        (k,) times [s]; those given, if the lines aren't periodic or too few.
    """
    with require_extra("identification", "scipy"):
        from scipy.ndimage import rank_filter, uniform_filter1d  # noqa: PLC0415 - slow to import

    if len(stamps) < JITTER_WINDOW:
        return stamps
    step = float(np.median(np.diff(stamps)))
    if abs(step - period) > 0.1 * period:
        step = period
    half = JITTER_WINDOW // 2
    lasted = stamps[half:] - stamps[:-half]  # some of its lines may be lost
    step = float(np.median(lasted / np.maximum(1.0, np.rint(lasted / step))))
    turns = stamps / step
    waves = np.exp(2j * np.pi * turns)
    means = [
        uniform_filter1d(part, JITTER_WINDOW, mode="nearest") for part in (waves.real, waves.imag)
    ]
    phases = np.arctan2(means[1], means[0]) / (2.0 * np.pi)
    off = turns - phases
    off = (off - np.rint(off)) * step
    ranked = rank_filter(off, JITTER_RANK, JITTER_WINDOW, mode="nearest")
    late = off - uniform_filter1d(ranked, JITTER_WINDOW)
    late = np.where(late < -PERIODIC_SHARE * step, late + step, late)  # by more than half a period
    return stamps - late if float(np.median(late)) < PERIODIC_SHARE * step else stamps


def find_difference(
    one: RobotConfig, other: RobotConfig, *, wire: bool
) -> tuple[str, str, str] | None:
    """Return the first field in which two robots differ, and both values; None if they don't.

    Args:
        one: a robot.
        other: another one, or the same one before or after it was calibrated.
        wire: whether name, baud rate and wiring count, too.
    """
    for field in ROBOT_LENGTHS:
        first, second = getattr(one, field), getattr(other, field)
        if abs(first - second) > LENGTH_TOLERANCE * max(first, second):
            return field, f"{first:g} m", f"{second:g} m"
    if not wire:
        return None
    for field in ("name", "baud_rate"):
        first, second = getattr(one, field), getattr(other, field)
        if first != second:
            return field, repr(first), repr(second)
    for letter in WIRE_LETTERS:
        wheels = [getattr(config.wheels, letter) for config in (one, other)]
        wirings = [
            f"motor {'-' if wheel.motor_sign < 0 else ''}{wheel.motor}, "
            f"encoder {'-' if wheel.sign < 0 else ''}{wheel.encoder}"
            for wheel in wheels
        ]
        if wirings[0] != wirings[1]:
            return f"wheels.{letter}", wirings[0], wirings[1]
    return None


def check_same_robot(
    logs: Sequence[tuple[str, Recording]], doing: str, *, wire: bool = True
) -> None:
    """Check that recordings are of one robot.

    Args:
        logs: names and recordings.
        doing: verb for the message, such as "identify".
        wire: whether name, baud rate and wiring count, too.

    Raises:
        ConfigError: the message names the first file of another robot, and the field.
    """
    first_name, first = logs[0]
    for name, recording in logs[1:]:
        found = find_difference(recording.config, first.config, wire=wire)
        if found is not None:
            field, theirs, own = found
            raise ConfigError(
                f"{name}: is of another robot: {field} is {theirs}, but {own} in {first_name}; "
                f"{doing} one robot at a time"
            )
