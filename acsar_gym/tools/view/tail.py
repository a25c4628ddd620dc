"""Reads a recording, and what is added to it while it is being written."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording import messages
from acsar_gym.recording.reader import (
    MAX_FILE,
    MESSAGE_TAKERS,
    EpisodeCollector,
    EpisodeParts,
    FileCut,
    MessageTaker,
    open_records,
)
from acsar_gym.recording.types import WireLog

Floats = NDArray[np.float64]
INITIAL_ROWS = 16
"""Rows for which there is room at first."""


class GrowingTable:
    """A table that grows; adding rows takes the same time however many there are.

    Args:
        width: numbers in a row.
        kind: of the numbers.
    """

    def __init__(self, width: int, kind: Any = np.float64) -> None:
        self._data = np.zeros((INITIAL_ROWS, width), kind)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def rows(self) -> NDArray[Any]:
        """All rows, (n, width); they stay as they are while others are added."""
        return self._data[: self._size]

    def add(self, rows: NDArray[Any]) -> None:
        """Add rows, (k, width)."""
        size = self._size + len(rows)
        if size > len(self._data):
            grown = np.zeros(
                (max(size, 2 * len(self._data)), self._data.shape[1]), self._data.dtype
            )
            grown[: self._size] = self.rows
            self._data = grown
        self._data[self._size : size] = rows
        self._size = size


def thin_keeping_peaks(values: Floats, most: int) -> NDArray[np.intp]:
    """Choose points of a line that is drawn, so that no peak is lost.

    Args:
        values: (n,) of the line; NaN is a gap.
        most: points at most.

    Returns:
        Their numbers, ascending: the least and the largest one of each of `most` / 2 stretches.
    """
    if len(values) <= most:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), most // 2 + 1).astype(np.intp)[:-1]
    size = int(np.diff(edges).max()) + 1
    places = np.minimum(
        edges[:, None] + np.arange(size), np.r_[edges[1:], len(values)][:, None] - 1
    )
    found = values[places]
    known = ~np.isnan(found)
    low = np.where(known, found, np.inf).argmin(axis=1)
    high = np.where(known, found, -np.inf).argmax(axis=1)
    rows = np.arange(len(edges))
    return np.unique(np.concatenate([places[rows, low], places[rows, high]]))


def thin_evenly(count: int, most: int) -> NDArray[np.intp]:
    """Choose at most `most` of `count` points, the first and the last one among them."""
    if count <= most:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, most).astype(np.intp))


TICK_PLACES = {name: place for place, name in enumerate(messages.TICK_COLUMNS)}
"""Columns of `Episode.ticks` by name; times are since the reset."""
MAX_COORDINATE = 1e6
"""Largest coordinate of goal and start, either sign [m]."""


class GrowingEpisode:
    """What was recorded from a reset to the next one. Times are since the reset [s].

    Attributes: `ticks`, the columns of `topics.TICK_COLUMNS`; `truth`, (m, 4) time, x [m], y [m],
    theta [rad] in the frame of the world, NaN on hardware; `sent`, (k, 5) time and the wheel
    speeds of each command on the wire [rad/s]; `scans`, (s, 1) times; `ranges`, (s, rays) [m],
    None without a LiDAR; `faults`, (time, text).

    Args:
        part: what was read of it; it is emptied here.
        config: of the robot.
    """

    def __init__(self, part: EpisodeParts, config: RobotConfig) -> None:
        self.info: dict[str, Any] = part.told["info"]
        self.ticks = GrowingTable(len(messages.TICK_COLUMNS))
        self.truth = GrowingTable(4)
        self.sent = GrowingTable(5)
        self.scans = GrowingTable(1)
        self.ranges: GrowingTable | None = None
        self.faults: list[tuple[float, str]] = []
        self._part = part
        self._config = config
        self._start = part.start

    def drain(self) -> bool:
        """Take what was read since the last call; returns whether there was anything.

        Raises:
            ConfigError: the recording is damaged.
        """
        sizes = self._sizes()
        self._ticked()
        self._sent()
        self._scanned()
        return self._sizes() != sizes

    def fault(self, time: int, text: str) -> None:
        """Take an error that ended the episode, at a time of the file [ns]."""
        self.faults.append(((time - self._part.offset) / 1e9 - self._start, text))

    @property
    def end(self) -> float:
        """Time of the newest tick or command [s]."""
        newest = [rows.rows[-1, place] for rows, place in self._clocks() if len(rows)]
        return max(0.0, *map(float, newest)) if newest else 0.0

    @property
    def is_simulated(self) -> bool:
        """Whether the truth is known."""
        return bool(len(self.truth)) and bool(np.isfinite(self.truth.rows[-1]).all())

    @property
    def goal(self) -> tuple[float, float] | None:
        """Goal in the odometry frame [m]; None where none is known."""
        found = _parse_numbers(self.info.get("goal"), 2)
        return None if found is None else (found[0], found[1])

    @property
    def start(self) -> tuple[float, float, float]:
        """Start in the frame of the world [m, m, rad]."""
        x, y, theta = _parse_numbers(self.info.get("start"), 3) or (0.0, 0.0, 0.0)
        return x, y, theta

    def column(self, name: str) -> Floats:
        """A column of the ticks, (n,)."""
        found: Floats = self.ticks.rows[:, TICK_PLACES[name]]
        return found

    def place(self, time: float) -> int:
        """Number of the newest tick at a time [s]; -1 before the first one."""
        return int(np.searchsorted(self.column("stamp"), time + 1e-9, "right")) - 1

    def asked(self, ticks: slice) -> Floats:
        """Wheel speeds that were asked for in some ticks, (n, 4) [rad/s]; NaN where none were."""
        rows = self.ticks.rows[ticks]
        linear, angular = (
            rows[:, TICK_PLACES["asked_linear"]],
            rows[:, TICK_PLACES["asked_angular"]],
        )
        left_radius, right_radius = self._config.wheel_radii
        turn = angular * self._config.effective_separation / 2.0
        right, left = (linear + turn) / right_radius, (linear - turn) / left_radius
        return np.stack([right, left, left, right], axis=1)

    def _clocks(self) -> tuple[tuple[GrowingTable, int], ...]:
        return (self.ticks, TICK_PLACES["stamp"]), (self.sent, 0)

    def _sizes(self) -> tuple[int, ...]:
        return len(self.ticks), len(self.truth), len(self.sent), len(self.scans), len(self.faults)

    def _ticked(self) -> None:
        """Take the tables."""
        ticks = self._table(messages.TICKS, "stamp")
        _check_ascending(self.ticks, ticks[:, TICK_PLACES["stamp"]], TICK_PLACES["stamp"])
        self.ticks.add(ticks)
        exchanges = self._table(messages.EXCHANGES, "stamp")
        truth = exchanges[:, [1, 5, 6, 7]]
        _check_ascending(self.truth, truth[:, 0], 0)
        self.truth.add(truth)

    def _table(self, topic: messages.Topic, clock: str) -> Floats:
        """The rows of a table since the last call."""
        data = self._part.tables[topic.name]
        rows = np.frombuffer(bytes(data), "<f8").reshape(-1, len(topic.columns)).copy()
        data.clear()
        rows[:, topic.columns.index(clock)] -= self._start
        return rows

    def _sent(self) -> None:
        """Take the commands on the wire."""
        part = self._part
        when = np.array([each - part.offset for each in part.sent_times]) / 1e9 - self._start
        log = WireLog(when, tuple(part.sent), np.zeros(0), ())
        part.sent_times, part.sent = [], []
        stamps, speeds = log.commands(self._config)
        stamps = np.maximum.accumulate(stamps) if len(stamps) else stamps
        self.sent.add(np.column_stack([stamps, speeds]))

    def _scanned(self) -> None:
        """Take the scans: exchange, stamp and ranges."""
        scans, self._part.scans = self._part.scans, []
        for row in (np.frombuffer(data, "<f8") for data in scans):
            rays = len(row) - 2
            if self.ranges is None and rays > 0:
                self.ranges = GrowingTable(rays, np.float32)
            if self.ranges is None or self.ranges.rows.shape[1] != rays:
                raise ConfigError("is damaged: scans of several lengths")
            stamp = np.array([row[1] - self._start])
            _check_ascending(self.scans, stamp, 0)
            self.scans.add(stamp[:, None])
            self.ranges.add(row[None, 2:].astype(np.float32))


def _parse_numbers(told: Any, count: int) -> tuple[float, ...] | None:
    """So many numbers of moderate size; None for anything else that a file may say."""
    try:
        found = tuple(map(float, told))
    except (TypeError, ValueError, OverflowError):
        return None
    return (
        found if len(found) == count and all(abs(one) < MAX_COORDINATE for one in found) else None
    )


def _check_ascending(known: GrowingTable, stamps: Floats, place: int) -> None:
    """Raise ConfigError for times that are no numbers, or go backwards."""
    before = known.rows[-1:, place]
    if not (np.isfinite(stamps).all() and (np.diff(np.r_[before, stamps]) >= 0.0).all()):
        raise ConfigError("is damaged: its times go backwards")


WRITING_TIMEOUT = 10.0
"""A file that hasn't grown for so long when it is opened isn't being written [s]."""
TAIL_TOPICS = (
    messages.EPISODE,
    messages.TICKS,
    messages.EXCHANGES,
    messages.SCANS,
    messages.WIRE_SENT,
)
FAULT_STATUS = b"acsar: fault"
"""Name of the status that tells what ended an episode."""


class RecordingTail:
    """A recording that may still be growing.

    A recorder that begins again under the same name replaces the file: then this begins again, too.

    Attributes: `path`; `episodes`; `config`, of the robot; `header`, of the recording.

    Args:
        path: the file.

    Raises:
        ConfigError: the file can't be read, isn't a recording, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._began: tuple[int, int] | None = None
        self._begin()
        self.poll()

    def _begin(self) -> None:
        """Forget everything."""
        wanted: dict[str, MessageTaker] = {
            topic.name: MESSAGE_TAKERS[topic.name] for topic in TAIL_TOPICS
        }
        self._collector = EpisodeCollector(wanted | {messages.DIAGNOSTICS.name: self._fault})
        self._faults: list[tuple[EpisodeParts, int, bytes]] = []
        self._place, self._size, self._damage = 0, -1, ""
        self.episodes: list[GrowingEpisode] = []
        self.config = RobotConfig()
        self.header: dict[str, Any] = {}

    def poll(self) -> bool:
        """Read what was added; returns whether there is anything new.

        A file that isn't there, or whose beginning isn't written yet, may come: then the next call
        reads it. Damage stays until another file takes its place.

        Raises:
            ConfigError: as for the constructor.
        """
        with reading.open_file(self.path, MAX_FILE) as file:
            status = os.fstat(file.fileno())
            is_other = self._began not in (None, (status.st_dev, status.st_ino))
            if is_other or status.st_size < self._size:
                self._begin()
            elif self._damage:
                raise ConfigError(self._damage)
            elif status.st_size == self._size and self.header:
                return False
            self._began, self._size = (status.st_dev, status.st_ino), status.st_size
            try:
                self._read(file)
                return self._drained() or is_other
            except ConfigError as error:
                self._damage = str(error) if self.header else ""
                raise

    def _read(self, file: IO[bytes]) -> None:
        """Read complete records from the place where the last call has ended."""
        collector = self._collector
        try:
            records = open_records(file, _Nothing())
            records.wanted = collector.takers
            file.seek(self._place or file.tell())
            for opcode, content in records:
                collector.take(opcode, content)
                self._place = file.tell()
        except FileCut:  # the rest of the record isn't written yet
            pass
        collector.kept = 0
        if collector.header is None:
            raise ConfigError("isn't a recording of acsar_gym")
        if not self.header:
            self.config = RobotConfig.model_validate(collector.header["config"])
            self.header = collector.header

    def _drained(self) -> bool:
        """Pass on to the episodes what was read; returns whether there was anything."""
        known, parts = len(self.episodes), self._collector.parts
        self.episodes += [GrowingEpisode(part, self.config) for part in parts[known:]]
        faults, self._faults = self._faults, []
        for part, when, data in faults:
            self.episodes[parts.index(part)].fault(when, _told(data))
        changed = [episode.drain() for episode in self.episodes[max(known - 1, 0) :]]
        return any(changed) or len(parts) > known or bool(faults) or self.is_complete

    def _fault(self, part: EpisodeParts, when: int, data: bytes) -> None:
        """Keep a diagnostic message if it tells what ended an episode."""
        if FAULT_STATUS in data:
            self._faults.append((part, when, data))

    @property
    def is_complete(self) -> bool:
        """Whether the recording was ended in order."""
        return self._collector.end is not None

    @property
    def age(self) -> float:
        """Time since the file has grown [s]."""
        try:
            return max(0.0, time.time() - self.path.stat().st_mtime)
        except OSError:
            return float("inf")

    @property
    def is_open(self) -> bool:
        """Whether it wasn't ended, and the process that records runs on this computer."""
        return not self.is_complete and _process_exists(self.process)

    @property
    def process(self) -> int:
        """Id of the process that records; 0 where it isn't known."""
        found = self.header.get("process")
        return found if isinstance(found, int) and 0 < found < 2**31 else 0


class _Nothing:
    """Takes the place of a hash."""

    def update(self, data: bytes) -> None:
        """Do nothing."""


def _process_exists(process: int) -> bool:
    """Whether a process exists."""
    try:
        os.kill(process, 0)
    except PermissionError:
        return True
    except (OSError, OverflowError):
        return False
    return process > 0


def _told(data: bytes) -> str:
    """The error in a diagnostic message."""
    try:
        found: Any = messages.load_typestore().deserialize_cdr(data, messages.DIAGNOSTICS.kind)
        return str(next(s.message for s in found.status if s.name == FAULT_STATUS.decode()))
    except Exception:  # noqa: BLE001 - a damaged file can make it raise anything
        return "an error that can't be read"
