"""Reads a recording, and what is added to it while it is being written."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import IO, Any

from acsar_gym.config import RobotConfig
from acsar_gym.dashboard.episodes import Episode
from acsar_gym.errors import ConfigError
from acsar_gym.reading import bounded
from acsar_gym.recording import topics, typesystem
from acsar_gym.recording.parts import TAKERS, Part, Take
from acsar_gym.recording.reader import MOST_BYTES, Collector, records_of
from acsar_gym.recording.records import Cut

QUIET = 10.0
"""A file that hasn't grown for so long when it is opened isn't being written [s]."""
READ = topics.EPISODE, topics.TICKS, topics.EXCHANGES, topics.SCANS, topics.WIRE_SENT
FAULT = b"acsar: fault"
"""Name of the status that tells what ended an episode."""


class Tail:
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
        wanted: dict[str, Take] = {topic.name: TAKERS[topic.name] for topic in READ}
        self._collector = Collector(wanted | {topics.DIAGNOSTICS.name: self._fault})
        self._faults: list[tuple[Part, int, bytes]] = []
        self._place, self._size, self._damage = 0, -1, ""
        self.episodes: list[Episode] = []
        self.config = RobotConfig()
        self.header: dict[str, Any] = {}

    def poll(self) -> bool:
        """Read what was added; returns whether there is anything new.

        A file that isn't there, or whose beginning isn't written yet, may come: then the next call
        reads it. Damage stays until another file takes its place.

        Raises:
            ConfigError: as for the constructor.
        """
        with bounded.opened(self.path, MOST_BYTES) as file:
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
            records = records_of(file, _Nothing())
            records.wanted = collector.takers
            file.seek(self._place or file.tell())
            for opcode, content in records:
                collector.take(opcode, content)
                self._place = file.tell()
        except Cut:  # the rest of the record isn't written yet
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
        self.episodes += [Episode(part, self.config) for part in parts[known:]]
        faults, self._faults = self._faults, []
        for part, when, data in faults:
            self.episodes[parts.index(part)].fault(when, _told(data))
        changed = [episode.drain() for episode in self.episodes[max(known - 1, 0) :]]
        return any(changed) or len(parts) > known or bool(faults) or self.is_complete

    def _fault(self, part: Part, when: int, data: bytes) -> None:
        """Keep a diagnostic message if it tells what ended an episode."""
        if FAULT in data:
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
        return not self.is_complete and _runs(self.process)

    @property
    def process(self) -> int:
        """Id of the process that records; 0 where it isn't known."""
        found = self.header.get("process")
        return found if isinstance(found, int) and 0 < found < 2**31 else 0


class _Nothing:
    """Takes the place of a hash."""

    def update(self, data: bytes) -> None:
        """Do nothing."""


def _runs(process: int) -> bool:
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
        found: Any = typesystem.store().deserialize_cdr(data, topics.DIAGNOSTICS.kind)
        return str(next(s.message for s in found.status if s.name == FAULT.decode()))
    except Exception:  # noqa: BLE001 - a damaged file can make it raise anything
        return "an error that can't be read"
