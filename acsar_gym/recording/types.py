"""What a recording holds, as it is read back: episodes, and the bytes of the wire."""

# ruff: noqa: RUF009 - the fields of an episode are descriptors, not defaults

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.sections import WheelLetters
from acsar_gym.errors import ConfigError
from acsar_gym.links.base import Arrivals
from acsar_gym.protocol import ZERO, Decoder, Reading
from acsar_gym.recording.blocks import Head
from acsar_gym.recording.events import Table, Tables

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
            np.array([stamp for stamp, _ in sent], np.float64),
            tuple(data for _, data in sent),
            np.array([stamp for stamp, _ in got], np.float64),
            tuple(data for _, data in got),
            stamped=stamped,
        )

    def commands(self, config: RobotConfig) -> tuple[Floats, Floats]:
        """Decode what was sent.

        Args:
            config: Robot configuration.

        Returns:
            Stamps [s], (n,), and speeds [rad/s] of the logical wheels, (n, 4): one row for each
            complete line.
        """
        return _decode_lines(self.sent_stamps, self.sent, config.wheels.motors)

    def feedback(self, config: RobotConfig) -> tuple[Floats, Floats]:
        """Decode what arrived.

        Args:
            config: Robot configuration.

        Returns:
            Stamps of each line's last byte [s], (k,), and speeds [rad/s] of the logical wheels,
            (k, 4). A wheel that a line doesn't name keeps its last speed.
        """
        return _decode_lines(self.got_stamps, self.got, config.wheels.encoders)


def _decode_lines(
    stamps: Floats, pieces: Sequence[bytes], letters: WheelLetters | None
) -> tuple[Floats, Floats]:
    """Decode pieces of a byte stream. Each line gets the stamp of the piece that ends it."""
    # The driver's own decoder, so that refused lines are refused here as well.
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


class Scans(NamedTuple):
    """The scans of a LiDAR during an episode."""

    stamps: Floats
    """(k,): when each was read, on the link's clock [s]."""
    ranges: Floats
    """(k, rays): ranges [m], counter-clockwise from -field_of_view / 2 of the robot's x axis, from
    where the robot was then."""
    exchanges: NDArray[np.int64]
    """(k,): number of the exchange after which each was read."""


class Revolutions(NamedTuple):
    """The revolutions of a LiDAR of which an episode's scans are made."""

    stamps: Floats
    """(k,): when each ended, on the link's clock [s]."""
    measured: Sequence[Floats]
    """(3, n) each: bearings [rad], distances [m], 0 where nothing was measured, and times [s]."""
    exchanges: NDArray[np.int64]
    """(k,): number of the exchange after which each was read first."""


class Movers(NamedTuple):
    """What moved around a simulated robot during an episode, at the end of k control periods."""

    exchanges: NDArray[np.int64]
    """(k,): number of the exchange of each."""
    stamps: Floats
    """(k,): its end, on the link's clock [s]."""
    hits: Floats
    """(k,): who has run into whom until then, such as `worlds.crowd.ROBOT_HIT`."""
    intrusions: Floats
    """(k,): how often the robot had entered a person's personal space."""
    states: Floats
    """(k, movers, 5): x, y [m], their rates [m/s], and radius [m], in the frame of the world."""


def split_pieces(tables: Tables, name: str) -> tuple[bytes, ...]:
    """Return the pieces of bytes of two tables. Raises ConfigError if some bytes are missing."""
    data = tables[f"{name}_bytes"].tobytes()
    # Lengths and bytes are separate tables, which a foreign file may fill differently.
    ends = np.cumsum(tables[name]["size"]).tolist()
    if sum(ends[-1:]) != len(data):
        raise ConfigError(f"is damaged: some bytes of {name} are missing")
    return tuple(data[first:end] for first, end in pairwise([0, *ends]))


def _make_wire(episode: Episode) -> WireLog:
    tables = episode.tables
    return WireLog(
        tables["sent"]["stamp"],
        split_pieces(tables, "sent"),
        tables["received"]["stamp"],
        split_pieces(tables, "received"),
        stamped=bool(episode.info.get("stamped")),
    )


def _join_truth(episode: Episode) -> Floats:
    """The true poses at the ends of the exchanges of ticks."""
    exchanges = episode.exchanges
    wanted = episode.tables["ticks"]["exchange"]
    if not len(exchanges):
        return np.full((len(wanted), 3), np.nan)
    # A dropped exchange has no truth, and its ticks get NaN.
    places = np.searchsorted(exchanges["number"][:-1], wanted)
    is_recorded = exchanges["number"][places] == wanted
    return np.where(is_recorded[:, None], exchanges["pose"][places], np.nan)


def _split_revolutions(episode: Episode) -> Revolutions:
    table = episode.tables["revolutions"]
    measured = episode.tables["measurements"]
    if table["size"].sum() != len(measured):
        raise ConfigError("is damaged: measurements of the LiDAR are missing")
    # Each revolution has its own number of measurements.
    turns = np.split(measured, np.cumsum(table["size"]))[: len(table)]
    columns = [np.ascontiguousarray(turn.T) for turn in turns]
    return Revolutions(table["stamp"], columns, table["exchange"])


def _after_reset(episode: Episode, values: Table) -> Table:
    """The rows of steps, but for a reset's."""
    # A reset has an observation, but neither an action nor a reward.
    rows: Table = values[episode.tables["steps"]["step"] > 0]
    return rows


def _list_scans(episode: Episode) -> Scans:
    scans = episode.tables["scans"]
    return Scans(scans["stamp"], episode.tables["ranges"], scans["exchange"])


def _list_movers(episode: Episode) -> Movers:
    table = episode.tables["movers"]
    states = episode.tables["mover_states"]
    return Movers(table["exchange"], table["stamp"], table["hit"], table["intrusions"], states)


def _made(make: Callable[[Episode], Any]) -> Any:
    """A field that is made when it is used for the first time."""
    return cached_property(make)


def _column(table: str, column: str) -> Any:
    """A field that is a column of a table."""
    return _made(lambda episode: episode.tables[table][column])


@dataclass(init=False, repr=False, eq=False)
class Episode:
    """One episode of a recording: from a reset to the next one. Angles in rad, n ticks.

    Ticks are those after the reset. The exchanges in which the reset waits for standstill are in
    the wire log only. Fields are read from the file when they are used for the first time.

    Args:
        head: How the episode began, and what its newest step was.
        tables: Its tables, or a part of each.
        fields: Fields that aren't made of these, as `dataclasses.replace` passes them.
    """

    head: Head
    """How it began, and what its newest step was."""
    tables: Tables
    """The tables by name. See `recording.events.TABLES`."""
    start: float
    """Time of the reset, on the link's clock [s]."""
    offset: int
    """What to add to times of the link's clock for those of the file [ns]. Those begin with the
    wall clock at the first reset."""
    info: Mapping[str, Any]
    """Seed, goal, start and number of the episode, as far as they are known."""
    terminated: bool
    """Whether it ended by success or failure. It was cut short otherwise."""
    truncated: bool
    """Whether a fault ended it: the last step repeats the observation before."""
    success: bool | None
    """Whether the task was solved. None if no env was recorded."""
    wire: WireLog = _made(_make_wire)
    """The bytes both ways, from the reset on."""
    stamps: Floats = _column("ticks", "stamp")
    """(n,): end of each tick, on the link's clock [s]."""
    poses: Floats = _column("ticks", "pose")
    """(n, 3): x [m], y [m], theta [rad] by odometry."""
    twists: Floats = _column("ticks", "twist")
    """(n, 2): linear [m/s], angular [rad/s] by odometry."""
    speeds: Floats = _column("ticks", "speeds")
    """(n, 4): newest wheel speeds [rad/s], wheels a to d."""
    asked: Floats = _column("ticks", "asked")
    """(n, 2): the twist that was asked for [m/s, rad/s]."""
    sent: Floats = _column("ticks", "sent")
    """(n, 2): the twist that was sent."""
    reasons: NDArray[np.int64] = _column("ticks", "reason")
    """(n,): `safety.rules.Reason` of each tick."""
    lateness: Floats = _column("ticks", "lateness")
    """(n,): time from the tick's deadline to its end [s]. NaN in simulation."""
    truth: Floats = _made(_join_truth)
    """(n, 3): true pose in the frame of the world. NaN on hardware."""
    observations: NDArray[np.float32] = _made(lambda episode: episode.tables["observations"])
    """(steps + 1, size): the first is the reset's. (0, 0) if no env was recorded."""
    actions: NDArray[np.float32] = _made(
        lambda episode: _after_reset(episode, episode.tables["actions"])
    )
    """(steps, 2): actions of the policy, in [-1, 1]."""
    rewards: Floats = _made(
        lambda episode: _after_reset(episode, episode.tables["steps"]["reward"])
    )
    """(steps,)."""
    scans: Scans = _made(_list_scans)
    """What the LiDAR's rays were."""
    step_stamps: Floats = _column("steps", "stamp")
    """(steps + 1,): when each observation was made, on the link's clock [s]."""
    exchanges: Table = _made(lambda episode: episode.tables["exchanges"])
    """The control periods of the wire, those of the reset included, for replay. Missing numbers
    were dropped."""
    revolutions: Revolutions = _made(_split_revolutions)
    """What the LiDAR measured."""
    movers: Movers = _made(_list_movers)
    """What moved around the robot. Empty on hardware, and if nothing did."""

    def __init__(self, head: Head, tables: Tables, **fields: Any) -> None:
        self.head = head
        self.tables = tables
        self.start = head.start
        self.offset = head.offset
        self.info = head.info
        # Without a step, no env was recorded.
        self.terminated, self.truncated, self.success = head.outcome or (False, False, None)
        # A field of the instance hides the descriptor that would make it.
        vars(self).update(fields)

    def split(self) -> Iterator[Episode]:
        """Yield the episode in parts of moderate size, with some of the rows of each table."""
        for tables in self.tables.split():
            yield Episode(self.head, tables)


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
    def is_incomplete(self) -> bool:
        """Whether the last episode is incomplete, because the file is cut."""
        return self.cut and not self.episodes[-1].terminated

    @property
    def sources(self) -> set[str]:
        """Hash of the file, and of the bag that it was made of."""
        # A bag is another file each time it is converted, but has one hash.
        source = self.header.get("source")
        return {self.sha256, *([source] if isinstance(source, str) else [])}

    def describe_damage(self) -> str:
        """Describe in one line what is missing of a damaged file. Empty if nothing is."""
        if not self.damages:
            return ""
        count = len(self.damages)
        # The first two places are enough to look at the file.
        places = ", ".join(self.damages[:2]) + ", ..." * (count > 2)
        lost = f"; {self.missing:,} control periods are missing" if self.missing else ""
        return (
            f"{count} damaged place{'s' * (count != 1)} left out ({places}){lost}; see mcap recover"
        )
