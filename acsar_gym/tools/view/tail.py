"""Reads a recording, and what is added to it while it is being written."""

from __future__ import annotations

import os
import time
from collections.abc import Sized
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.reading import open_file
from acsar_gym.recording import messages
from acsar_gym.recording.episodes import EpisodeCollector, EpisodeParts
from acsar_gym.recording.messages import (
    DIAGNOSTICS,
    EXCHANGES,
    SCANS,
    STEP_COLUMNS,
    STEPS,
    TICK_COLUMNS,
    TICKS,
    WIRE_SENT,
    Topic,
)
from acsar_gym.recording.stream import FileCut, RecordStream
from acsar_gym.recording.types import Floats, WireLog

WRITING_TIMEOUT = 10.0
"""A file that hasn't grown for so long when it is opened isn't being written [s]."""
TAIL_TOPICS = TICKS, EXCHANGES, STEPS, SCANS, WIRE_SENT, DIAGNOSTICS
FAULT_STATUS = b"acsar: fault"
"""Name of the status that tells what ended an episode."""
TICK_PLACES = {name: place for place, name in enumerate(TICK_COLUMNS)}
"""Columns of `GrowingEpisode.ticks` by name; times are since the reset."""
MAX_COORDINATE = 1e6
"""Largest coordinate of goal and start, either sign [m]."""
DRAINED_BYTES = 20_000_000
"""So many bytes are read at once."""
INITIAL_ROWS = 16
"""Rows of a table for which there is room at first."""


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

    def add(self, rows: NDArray[Any], clock: int | None = None) -> None:
        """Add rows, (k, width), whose column `clock` holds ascending times.

        Raises:
            ConfigError: the times are no numbers, or go backwards.
        """
        if clock is not None:
            stamps = np.r_[self.rows[-1:, clock], rows[:, clock]]
            if not (np.isfinite(stamps).all() and (np.diff(stamps) >= 0.0).all()):
                raise ConfigError("is damaged: its times go backwards")
        size = self._size + len(rows)
        if size > len(self._data):
            room = max(size, 2 * len(self._data)), self._data.shape[1]
            grown = np.zeros(room, self._data.dtype)
            grown[: self._size] = self.rows
            self._data = grown
        self._data[self._size : size] = rows
        self._size = size


class GrowingEpisode:
    """What was recorded from a reset to the next one. Times are since the reset [s].

    Attributes: `ticks` and `steps`, the columns of `messages.TICK_COLUMNS` and `STEP_COLUMNS`;
    `truth`, (m, 5) time, x [m], y [m], theta [rad] in the frame of the world, and whether there was
    contact, NaN on hardware; `sent`, (k, 5) time and the wheel
    speeds of each command on the wire [rad/s]; `scans`, (s, 1) times; `ranges`, (s, rays) [m],
    None without a LiDAR; `faults`, (time, text).

    Args:
        parts: what was read of it; it is emptied here.
        config: of the robot.
    """

    def __init__(self, parts: EpisodeParts, config: RobotConfig) -> None:
        self.info = parts.info
        self.ticks = GrowingTable(len(TICK_COLUMNS))
        self.steps = GrowingTable(len(STEP_COLUMNS))
        self.truth = GrowingTable(5)
        self.sent = GrowingTable(5)
        self.scans = GrowingTable(1)
        self.ranges: GrowingTable | None = None
        self.faults: list[tuple[float, str]] = []
        self._parts = parts
        self._config = config

    def drain(self) -> bool:
        """Take what was read since the last call; returns whether there was anything.

        Raises:
            ConfigError: the recording is damaged.
        """
        before = self._count_rows()
        self.ticks.add(self._take_table(TICKS), TICK_PLACES["stamp"])
        self.steps.add(self._take_table(STEPS), STEP_COLUMNS.index("stamp"))
        self.truth.add(self._take_table(EXCHANGES)[:, [1, 5, 6, 7, 10]], 0)
        stamps, sent = self._take_list(WIRE_SENT)
        log = WireLog(stamps, tuple(sent), np.zeros(0), ())
        stamps, speeds = log.commands(self._config)
        self.sent.add(np.column_stack([np.maximum.accumulate(stamps), speeds]))
        for data in self._take_list(SCANS)[1]:
            row = np.frombuffer(data, "<f8")
            rays = len(row) - 2
            if self.ranges is None and rays > 0:
                self.ranges = GrowingTable(rays, np.float32)
            if self.ranges is None or self.ranges.rows.shape[1] != rays:
                raise ConfigError("is damaged: scans of several lengths")
            self.scans.add(row[None, 1:2] - self._parts.start, 0)
            self.ranges.add(row[None, 2:].astype(np.float32))
        for stamp, data in zip(*self._take_list(DIAGNOSTICS), strict=True):
            if FAULT_STATUS in data:
                self.faults.append((float(stamp), _parse_fault(data)))
        return self._count_rows() != before

    def _count_rows(self) -> list[int]:
        tables: list[Sized] = [
            self.ticks,
            self.truth,
            self.sent,
            self.scans,
            self.faults,
            self.steps,
        ]
        return [len(table) for table in tables]

    def _take_table(self, topic: Topic) -> Floats:
        """The rows of a table since the last call; their column `stamp` is since the reset."""
        rows = self._parts.take_table(topic).copy()
        rows[:, topic.columns.index("stamp")] -= self._parts.start
        return rows

    def _take_list(self, topic: Topic) -> tuple[Floats, list[bytes]]:
        """Times since the reset [s], and messages, since the last call."""
        times, data = self._parts.take_list(topic)
        stamps = np.array([time - self._parts.offset for time in times], np.float64) / 1e9
        return stamps - self._parts.start, data

    @property
    def end(self) -> float:
        """Time of the newest tick or command [s]."""
        newest = [self.column("stamp")[-1:], self.sent.rows[-1:, 0]]
        return float(np.max(np.concatenate(newest), initial=0.0))

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

    @property
    def poses(self) -> Floats:
        """Poses by odometry at each tick, (n, 3): x [m], y [m], theta [rad]."""
        found: Floats = self.ticks.rows[:, TICK_PLACES["x"] : TICK_PLACES["theta"] + 1]
        return found

    @property
    def measured(self) -> Floats:
        """Newest wheel speeds at each tick, (n, 4) [rad/s]."""
        first = TICK_PLACES["speed_a"]
        found: Floats = self.ticks.rows[:, first : first + 4]
        return found

    def pose(self, time: float) -> tuple[float, float, float]:
        """Pose by odometry at a time [s], that of the newest tick; zero before the first one."""
        place = self.place(time)
        x, y, theta = self.poses[place].tolist() if place >= 0 else (0.0, 0.0, 0.0)
        return x, y, theta

    def place(self, time: float) -> int:
        """Number of the newest tick at a time [s]; -1 before the first one."""
        return int(np.searchsorted(self.column("stamp"), time + 1e-9, "right")) - 1

    def count_truth(self, time: float) -> int:
        """How many true poses there are until a time [s]."""
        return int(np.searchsorted(self.truth.rows[:, 0], time + 1e-9, "right"))

    def asked(self, ticks: slice) -> Floats:
        """Wheel speeds that were asked for in some ticks, (n, 4) [rad/s]; NaN where none were."""
        rows = self.ticks.rows[ticks]
        linear, angular = (rows[:, TICK_PLACES[f"asked_{name}"]] for name in ("linear", "angular"))
        left_radius, right_radius = self._config.wheel_radii
        turn = angular * self._config.effective_separation / 2.0
        right, left = (linear + turn) / right_radius, (linear - turn) / left_radius
        return np.stack([right, left, left, right], axis=1)


def _parse_numbers(value: Any, count: int) -> tuple[float, ...] | None:
    """So many numbers of moderate size; None for anything else that a file may say."""
    try:
        found = tuple(map(float, value))
    except (TypeError, ValueError, OverflowError):
        return None
    moderate = all(abs(one) < MAX_COORDINATE for one in found)
    return found if len(found) == count and moderate else None


def _parse_fault(data: bytes) -> str:
    """The error in a diagnostic message."""
    try:
        found: Any = messages.load_typestore().deserialize_cdr(data, DIAGNOSTICS.kind)
        return str(next(s.message for s in found.status if s.name == FAULT_STATUS.decode()))
    except Exception:  # noqa: BLE001 - a damaged file can make it raise anything
        return "an error that can't be read"


class RecordingTail:
    """A recording that may still be growing.

    A recorder that begins again under the same name replaces the file: then this begins again, too.

    Attributes: `path`; `episodes`; `config`, of the robot; `header`, of the recording; `damages`, a
    line for each damaged place, which was left out.

    Args:
        path: the file.

    Raises:
        ConfigError: the file can't be read, isn't a recording, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: tuple[int, int] | None = None
        self._restart()
        self.poll()

    def _restart(self) -> None:
        self._collector = EpisodeCollector(TAIL_TOPICS)
        self._place, self._size, self._damage = 0, -1, ""
        self.damages: list[str] = []
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
        with open_file(self.path, None) as file:
            status = os.fstat(file.fileno())
            same = status.st_dev, status.st_ino
            is_other = self._file not in (None, same)
            if is_other or status.st_size < self._size:
                self._restart()
            elif self._damage:
                raise ConfigError(self._damage)
            elif status.st_size == self._size and self.header:
                return False
            self._file, self._size = same, status.st_size
            try:
                return self._read(file) or is_other
            except ConfigError as error:
                self._damage = str(error) if self.header else ""
                raise

    def _read(self, file: Any) -> bool:
        """Read complete records from where the last call has ended; whether there was anything."""
        collector = self._collector
        records, changed = RecordStream(file, collector.topics), False
        records.place = self._place or records.place
        try:
            for opcode, content in records:
                collector.take(opcode, content)
                if collector.kept > DRAINED_BYTES and collector.header is not None:
                    changed |= self._drain()
        except FileCut as cut:  # the rest of the record isn't written yet
            if cut.damaged:
                raise ConfigError("is damaged: what follows is no record") from cut
        self._place = records.place
        self.damages += records.damages
        if collector.header is None:
            raise ConfigError("isn't a recording of acsar_gym")
        return self._drain() or changed or self.is_complete

    def _drain(self) -> bool:
        """Hand what was read over to the episodes; whether there was anything."""
        collector = self._collector
        collector.kept = 0
        if not self.header and collector.header is not None:
            self.config = RobotConfig.model_validate(collector.header["config"])
            self.header = collector.header
        known = len(self.episodes)
        self.episodes += [GrowingEpisode(one, self.config) for one in collector.parts[known:]]
        changed = [episode.drain() for episode in self.episodes[max(known - 1, 0) :]]
        return any(changed) or len(self.episodes) > known

    @property
    def is_complete(self) -> bool:
        """Whether the recording was ended in order."""
        return self._collector.end is not None

    @property
    def dropped(self) -> int:
        """Events that were dropped because the writer couldn't keep up; 0 where it isn't told."""
        found = (self._collector.end or {}).get("dropped")
        return found if isinstance(found, int) else 0

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
        if self.is_complete or not self.process:
            return False
        try:
            os.kill(self.process, 0)
        except PermissionError:
            return True
        except (OSError, OverflowError):
            return False
        return True

    @property
    def process(self) -> int:
        """Id of the process that records; 0 where it isn't known."""
        found = self.header.get("process")
        return found if isinstance(found, int) and 0 < found < 2**31 else 0
