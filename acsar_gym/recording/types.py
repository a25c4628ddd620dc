"""What a recording holds, as it is read back: episodes, and the bytes of the wire."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.sections import WheelLetters
from acsar_gym.errors import ConfigError
from acsar_gym.links.base import Arrivals
from acsar_gym.protocol import ZERO, Decoder, Reading
from acsar_gym.recording.events import TABLES, Tables

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WireLog:
    """What was written to a robot's wire and what arrived, on the link's clock."""

    sent_stamps: Floats
    """(n,): when each write was done [s]."""
    sent: Sequence[bytes]
    """The bytes of each write."""
    got_stamps: Floats
    """(m,): when each piece arrived, i.e. the time of its last byte [s]."""
    got: Sequence[bytes]
    """The bytes of each piece."""
    stamped: bool = False
    """Whether pieces are lines, at the times at which the robot measured them, and writes took no
    time on a wire. See `Link.stamped`."""

    @classmethod
    def of(cls, sent: Arrivals, got: Arrivals, *, stamped: bool = False) -> WireLog:
        """Make a log of stamped writes and pieces."""
        return cls(
            sent_stamps=np.array([stamp for stamp, _ in sent], np.float64),
            sent=tuple(data for _, data in sent),
            got_stamps=np.array([stamp for stamp, _ in got], np.float64),
            got=tuple(data for _, data in got),
            stamped=stamped,
        )

    def commands(self, config: RobotConfig) -> tuple[Floats, Floats]:
        """Decode what was sent.

        Args:
            config: of the robot.

        Returns:
            Stamps [s], (n,), and speeds [rad/s] of the logical wheels, (n, 4): one row for each
            complete line.
        """
        return _decode_lines(self.sent_stamps, self.sent, config.wheels.motors)

    def feedback(self, config: RobotConfig) -> tuple[Floats, Floats]:
        """Decode what arrived.

        Args:
            config: of the robot.

        Returns:
            Stamps of each line's last byte [s], (k,), and speeds [rad/s] of the logical wheels,
            (k, 4). A wheel that a line doesn't name keeps its last speed.
        """
        return _decode_lines(self.got_stamps, self.got, config.wheels.encoders)


def _decode_lines(
    stamps: Floats,
    pieces: Sequence[bytes],
    letters: WheelLetters | None,
) -> tuple[Floats, Floats]:
    """Decode pieces of a byte stream. Each line gets the stamp of the piece that ends it."""
    decoder = Decoder()
    speeds = ZERO
    times = array("d")
    values = array("d")
    for stamp, piece in zip(stamps.tolist(), pieces, strict=True):
        for line in decoder.feed(piece):
            reading = Reading(letters.to_wheels(line.speeds)) if letters else line
            speeds = reading.over(speeds)
            times.append(stamp)
            values.extend(speeds)
    return np.array(times), np.array(values).reshape(-1, 4)


@dataclass(frozen=True, eq=False)
class Scans:
    """The scans of a LiDAR during an episode."""

    stamps: Floats
    """(k,): when each was read, on the link's clock [s]."""
    ranges: Floats
    """(k, rays): ranges [m], counter-clockwise from -field_of_view / 2 of the robot's x axis, from
    where the robot was then."""
    exchanges: NDArray[np.int64]
    """(k,): number of the exchange after which each was read."""


@dataclass(frozen=True, eq=False)
class Revolutions:
    """The revolutions of a LiDAR of which an episode's scans are made."""

    stamps: Floats
    """(k,): when each ended, on the link's clock [s]."""
    measured: Sequence[Floats]
    """(3, n) each: bearings [rad], distances [m], 0 where nothing was measured, and times [s]."""
    exchanges: NDArray[np.int64]
    """(k,): number of the exchange after which each was read first."""

    @classmethod
    def of(cls, tables: Tables) -> Revolutions:
        """Take the revolutions of tables. Raises ConfigError if measurements are missing."""
        table = tables["revolutions"]
        measured = tables["measurements"]
        if table["size"].sum() != len(measured):
            raise ConfigError("is damaged: measurements of the LiDAR are missing")
        turns = np.split(measured, np.cumsum(table["size"]))[: len(table)]
        columns = [np.ascontiguousarray(turn.T) for turn in turns]
        return cls(table["stamp"], columns, table["exchange"])


@dataclass(frozen=True, eq=False)
class Movers:
    """What moved around a simulated robot during an episode, at the end of k control periods."""

    exchanges: NDArray[np.int64]
    """(k,): number of the exchange of each."""
    stamps: Floats
    """(k,): its end, on the link's clock [s]."""
    hits: Floats
    """(k,): who has run into whom until then, such as `worlds.crowd.ROBOT_HIT`."""
    intrusions: Floats
    """(k,): how often the robot had entered somebody's personal space."""
    states: Floats
    """(k, movers, 5): x, y [m], their rates [m/s], and radius [m], in the frame of the world."""

    @classmethod
    def of(cls, tables: Tables) -> Movers:
        """Take the movers of tables."""
        table = tables["movers"]
        return cls(
            exchanges=table["exchange"],
            stamps=table["stamp"],
            hits=table["hit"],
            intrusions=table["intrusions"],
            states=tables["mover_states"],
        )


@dataclass(frozen=True, eq=False)
class Episode:
    """One episode of a recording: from a reset to the next one. Angles in rad, n ticks.

    Ticks are those after the reset. The exchanges in which the reset waits for standstill are in
    the wire log only.
    """

    start: float
    """Time of the reset, on the link's clock [s]."""
    wire: WireLog
    """The bytes both ways, from the reset on."""
    stamps: Floats
    """(n,): end of each tick, on the link's clock [s]."""
    poses: Floats
    """(n, 3): x [m], y [m], theta [rad] by odometry."""
    twists: Floats
    """(n, 2): linear [m/s], angular [rad/s] by odometry."""
    speeds: Floats
    """(n, 4): newest wheel speeds [rad/s], wheels a to d."""
    asked: Floats
    """(n, 2): the twist that was asked for [m/s, rad/s]."""
    sent: Floats
    """(n, 2): the twist that was sent."""
    reasons: NDArray[np.int64]
    """(n,): `safety.rules.Reason` of each tick."""
    lateness: Floats
    """(n,): time from the tick's deadline to its end [s]. NaN in simulation."""
    truth: Floats
    """(n, 3): true pose in the frame of the world. NaN on hardware."""
    observations: NDArray[np.float32]
    """(steps + 1, size): the first is the reset's. (0, 0) where no env was recorded."""
    actions: NDArray[np.float32]
    """(steps, 2): actions of the policy, in [-1, 1]."""
    rewards: Floats
    """(steps,)."""
    scans: Scans
    """What the LiDAR's rays were."""
    info: Mapping[str, Any] = field(default_factory=dict)
    """Seed, goal, start and number of the episode, as far as they are known."""
    offset: int = 0
    """What to add to times of the link's clock for those of the file [ns]. Those begin with the
    wall clock at the first reset."""
    terminated: bool = False
    """Whether the episode ended by success or failure. It was cut short otherwise."""
    truncated: bool = False
    """Whether a fault ended it: the last step repeats the observation before."""
    step_stamps: Floats = field(default_factory=lambda: np.zeros(0))
    """(steps + 1,): when each observation was made, on the link's clock [s]."""
    exchanges: NDArray[Any] = field(default_factory=lambda: np.zeros(0, TABLES["exchanges"]))
    """The control periods of the wire, those of the reset included, for replay: a table whose
    columns are those of `recording.events.TABLES`. Missing numbers were dropped."""
    revolutions: Revolutions = field(default_factory=lambda: Revolutions.of(Tables()))
    """What the LiDAR measured."""
    movers: Movers = field(default_factory=lambda: Movers.of(Tables()))
    """What moved around the robot. Empty on hardware, and where nothing did."""
    success: bool | None = None
    """Whether the task was solved. None where no env was recorded."""
    tables: Tables = field(default_factory=Tables)
    """The tables of which all this is made, by name. See `recording.events.TABLES`."""

    def split(self) -> Iterator[Episode]:
        """Yield the episode in parts of moderate size, with some of the rows of each table."""
        yield self


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording, whose tables are read from the file when they are needed."""

    header: Mapping[str, Any]
    """Robot, env, task, policy, versions and clocks. See `recording.messages`."""
    sha256: str
    """First 16 hex digits of the file's SHA-256."""
    config: RobotConfig
    """The robot that was recorded."""
    episodes: tuple[Episode, ...]
    """What was recorded between a reset and the next one, each."""
    cut: bool = False
    """Whether the file's end is missing, because the program or the computer died."""
    dropped: int = 0
    """Events, such as ticks, that were dropped because the writer couldn't keep up."""
    damages: tuple[str, ...] = ()
    """A line for each damaged place of the file, which was left out."""
    missing: int = 0
    """Control periods that are missing where the file is damaged."""

    @property
    def sources(self) -> set[str]:
        """Hash of the file, and of the bag that it was made of."""
        source = self.header.get("source")
        return {self.sha256, *([source] if isinstance(source, str) else [])}

    def describe_damage(self) -> str:
        """Describe in one line what is missing of a damaged file. Empty if nothing is."""
        if not self.damages:
            return ""
        places = f"{len(self.damages)} damaged place{'s' * (len(self.damages) != 1)} left out"
        more = ", ..." if len(self.damages) > 2 else ""
        lost = f"; {self.missing:,} control periods are missing" if self.missing else ""
        return f"{places} ({', '.join(self.damages[:2])}{more}){lost}; see mcap recover"
