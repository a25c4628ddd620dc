"""Reads a recording block by block, also while it is being written."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.reading import open_file
from acsar_gym.recording import messages
from acsar_gym.recording.episodes import (
    MOVER_HEAD,
    EpisodeCollector,
    EpisodeParts,
    PieceBuffer,
    parse_movers,
)
from acsar_gym.recording.messages import (
    DIAGNOSTICS,
    EXCHANGES,
    MOVERS,
    SCANS,
    STEPS,
    TICK_COLUMNS,
    TICKS,
    WIRE_SENT,
    Topic,
)
from acsar_gym.recording.stream import FileCut, RecordStream
from acsar_gym.recording.types import Floats, Movers, WireLog

VIEWED_TOPICS = TICKS, EXCHANGES, STEPS, SCANS, MOVERS, WIRE_SENT, DIAGNOSTICS
FAULT_STATUS = "acsar: fault"
"""Name of the status that tells what ended an episode."""
BLOCK_BYTES = 20_000_000
"""About so many bytes of a recording are in memory at once."""


@dataclass(frozen=True, eq=False)
class Block:
    """What was read of one episode at once. Times are since its reset [s].

    Attributes: `episode`, its number from 0; `info`, seed, goal, start and world, as far as they
    are known; `ticks`, (n,) each, the columns of `messages.TICK_COLUMNS`; `truth`, (m, 5) time, x
    [m], y [m], theta [rad] in the frame of the world, and contact, NaN on hardware; `sent`, (k, 5)
    time and wheel speeds of each command on the wire [rad/s]; `scan_times`, (s,), and `ranges`,
    (s, rays) [m]; `movers`, in the frame of the world; `steps`, rows of `messages.STEP_COLUMNS`;
    `faults`, (time, text).
    """

    episode: int
    info: Mapping[str, Any]
    ticks: Mapping[str, Floats]
    truth: Floats
    sent: Floats
    scan_times: Floats
    ranges: Floats
    movers: Movers
    steps: Floats
    faults: list[tuple[float, str]]

    def numbers(self, name: str, count: int) -> tuple[float, ...] | None:
        """So many numbers of `info`; None where they aren't there, or no numbers."""
        try:
            numbers = tuple(map(float, self.info[name]))
        except (KeyError, TypeError, ValueError, OverflowError):
            return None
        return numbers if len(numbers) == count and np.isfinite(numbers).all() else None

    @property
    def is_simulated(self) -> bool:
        """Whether the truth is known."""
        return bool(np.isfinite(self.truth[:, 1]).any())

    @property
    def start(self) -> tuple[float, float, float]:
        """Start in the frame of the world [m, m, rad]."""
        x, y, theta = self.numbers("start", 3) or (0.0, 0.0, 0.0)
        return x, y, theta

    @property
    def poses(self) -> Floats:
        """Poses by odometry at each tick, (n, 3): x [m], y [m], theta [rad]."""
        return np.stack([self.ticks[name] for name in ("x", "y", "theta")], axis=1)


class RecordingTail:
    """A recording that may still be growing.

    A recorder that begins again under the same name replaces the file: then this begins again, too,
    and `run` is one more. ConfigError where it can't be read, or isn't a recording.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.run = 0
        self._file: tuple[int, int] | None = None
        self._begin()
        with open_file(path) as file:
            for _ in self._read(file, only_header=True):
                pass
        self._begin()

    def _begin(self) -> None:
        self._collector = EpisodeCollector(VIEWED_TOPICS)
        self._place = self._size = self._newest = 0
        self.damages: list[str] = []

    def read(self) -> Iterator[Block]:
        """Yield what was added since the last call, in blocks."""
        with open_file(self.path) as file:
            status = os.fstat(file.fileno())
            identity = status.st_dev, status.st_ino
            if self._file not in (None, identity) or status.st_size < self._size:
                self._begin()
                self.run += 1
            self._file, self._size = identity, status.st_size
            yield from self._read(file)

    def _read(self, file: Any, *, only_header: bool = False) -> Iterator[Block]:
        collector = self._collector
        stream = RecordStream(file, collector.topics)
        stream.place = self._place or stream.place
        try:
            for opcode, content in stream:
                collector.take(opcode, content)
                if only_header and collector.header is not None:
                    break
                if collector.kept > BLOCK_BYTES:
                    yield from self._take_blocks()
        except FileCut as cut:
            if cut.damaged:
                raise ConfigError(f"{self.path}: is damaged: what follows is no record") from cut
        self._place = stream.place
        self.damages += stream.damages
        if collector.header is None:
            raise ConfigError(f"{self.path}: isn't a recording of acsar_gym")
        self.header = collector.header
        self.config = RobotConfig.model_validate(collector.header["config"])
        yield from self._take_blocks()

    def _take_blocks(self) -> Iterator[Block]:
        self._collector.kept = 0
        all_parts = self._collector.parts
        for number in range(self._newest, len(all_parts)):
            block = self._make_block(number, all_parts[number])
            if block is not None:
                yield block
        self._newest = max(len(all_parts) - 1, 0)

    def _make_block(self, number: int, parts: EpisodeParts) -> Block | None:
        """What was read of an episode since the last time; None for nothing."""
        take_table = partial(_take_table, parts)
        ticks, exchanges, steps = (take_table(topic) for topic in (TICKS, EXCHANGES, STEPS))
        sent_times, sent = _take_list(parts, WIRE_SENT)
        scans = [np.frombuffer(data, "<f8") for data in _take_list(parts, SCANS)[1]]
        buffer = parts.buffers.pop(MOVERS.name, PieceBuffer())
        movers = parse_movers(buffer.rows("<f8", MOVER_HEAD))
        diagnostics = zip(*_take_list(parts, DIAGNOSTICS), strict=True)
        faults = [
            (float(time), _parse_fault(data))
            for time, data in diagnostics
            if FAULT_STATUS.encode() in data
        ]
        if not (len(ticks) or len(exchanges) or len(sent) or scans or faults or len(steps)):
            return None
        if len({len(scan) for scan in scans}) > 1:
            raise ConfigError(f"{self.path}: is damaged: scans of several lengths")
        log = WireLog(sent_times, tuple(sent), np.zeros(0), ())
        times, speeds = log.commands(self.config)
        rows = np.array(scans, np.float64) if scans else np.zeros((0, 2))
        return Block(
            number,
            parts.info,
            dict(zip(TICK_COLUMNS, ticks.T, strict=True)),
            exchanges[:, [1, 5, 6, 7, 10]],
            np.column_stack([times, speeds]),
            rows[:, 1] - parts.start,
            rows[:, 2:],
            replace(movers, stamps=movers.stamps - parts.start),
            steps,
            faults,
        )

    @property
    def is_complete(self) -> bool:
        """Whether the recording was ended in order."""
        return self._collector.end is not None

    def describe_end(self) -> str:
        """Tell how a recording that isn't written any more has ended."""
        if self.damages:
            return f"the recording ends; left out, damaged: {', '.join(self.damages[:2])}"
        if self._collector.end is None:
            return "the recording's end is missing"
        dropped = self._collector.end.get("dropped")
        lost = f"; {dropped:,} events were dropped" if isinstance(dropped, int) and dropped else ""
        return f"the recording ends{lost}"


def _take_table(parts: EpisodeParts, topic: Topic) -> Floats:
    """The rows of a table since the last call; their column `stamp` is since the reset."""
    rows = parts.take_table(topic).copy()
    stamps = rows[:, topic.columns.index("stamp")]
    stamps -= parts.start
    if not (np.isfinite(stamps).all() and (np.diff(stamps) >= 0.0).all()):
        raise ConfigError("is damaged: its times go backwards")
    return rows


def _take_list(parts: EpisodeParts, topic: Topic) -> tuple[Floats, list[bytes]]:
    """Times since the reset [s], and messages, since the last call."""
    times, data = parts.take_list(topic)
    stamps = np.array([time - parts.offset for time in times], np.float64) / 1e9
    return stamps - parts.start, data


def _parse_fault(data: bytes) -> str:
    """The error in a diagnostic message."""
    try:
        message: Any = messages.load_typestore().deserialize_cdr(data, DIAGNOSTICS.kind)
        return str(next(s.message for s in message.status if s.name == FAULT_STATUS))
    except Exception:  # noqa: BLE001 - a damaged file can make it raise anything
        return "an error that can't be read"
