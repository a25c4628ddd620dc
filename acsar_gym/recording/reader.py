"""Reads recordings back."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.reading import bounded
from acsar_gym.recording import records
from acsar_gym.recording.header import END, FORMAT, NAME
from acsar_gym.recording.parts import (
    TABLES,
    TAKERS,
    Part,
    Take,
    begin,
    made,
    mapping,
    missing,
    opening,
)
from acsar_gym.recording.records import Cut, Records
from acsar_gym.recording.types import Recording

MOST_BYTES = 1_000_000_000
"""Largest accepted file [bytes]."""
MOST_KEPT = 300_000_000
"""Most bytes of a recording that are kept in memory."""
COST = 100
"""What each message costs beside its content [bytes]; rows of tables cost nothing."""
MOST_EPISODES = 5_000
"""Most episodes; an empty one takes 7 kB of memory."""
MOST_OPENINGS = 10_000_000
"""Most bytes of what begins the episodes; of JSON, which takes 25 times the memory."""
HEADER = {"config_sha256": str, "versions": dict, "created": dict, "about": dict}
"""What a header must have besides format and config, and its kind."""
_MESSAGE = struct.Struct("<HIQQ")


class Collector:
    """Collects the episodes of a file.

    Attributes: `header` and `end`, None until they were read; `parts`, the episodes; `takers`, by
    the numbers of the channels that are wanted; `kept`, bytes that were kept so far.

    Args:
        wanted: what takes the messages of each topic that is wanted.

    Raises:
        ConfigError: by `take`, for a record that is damaged or of another version.
    """

    def __init__(self, wanted: Mapping[str, Take] = TAKERS) -> None:
        self.header: dict[str, Any] | None = None
        self._wanted = wanted
        self.end: dict[str, Any] | None = None
        self.parts: list[Part] = []
        self.kept = 0
        self._openings = 0
        self._tables: set[int] = set()
        self.takers: dict[int, Take] = {}

    def take(self, opcode: int, content: bytes) -> None:
        """Take a record."""
        if opcode == records.MESSAGE:
            self._message(content)
        elif opcode in records.DESCRIPTIONS:
            found = records.described(opcode, content)
            if opcode == records.CHANNEL:
                self._channel(found.id, found.topic, found.metadata)
            elif found.name == NAME and self.header is None:
                self.header = mapping(found.metadata.get("header", ""))
                _check_format(self.header)
            elif found.name == END and self.end is None:
                self.end = mapping(found.metadata.get("end", ""))

    def _channel(self, number: int, name: str, told: Mapping[str, str]) -> None:
        """Take note of a channel, if its topic is one that is read back."""
        columns = {topic.name: topic.columns for topic in TABLES}
        if name in columns and told.get("columns", "").split(",") != list(columns[name]):
            raise ConfigError(f"{name} has other columns: it was recorded by another version")
        if name in columns:
            self._tables.add(number)
        if name in self._wanted:
            self.takers[number] = self._wanted[name]

    def _message(self, content: bytes) -> None:
        """Take a message."""
        try:
            number, _, time, _ = _MESSAGE.unpack_from(content)
        except struct.error:
            raise ConfigError("is damaged: a broken message") from None
        taker = self.takers.get(number)
        if taker is None:
            return
        self.kept += len(content) + (0 if number in self._tables else COST)
        if self.kept > MOST_KEPT:
            raise ConfigError(records.TOO_MUCH)
        data = content[_MESSAGE.size :]
        if taker is begin:
            self._openings += len(data)
            if len(self.parts) >= MOST_EPISODES or self._openings > MOST_OPENINGS:
                raise ConfigError(records.TOO_MUCH)
            self.parts.append(Part(opening(data)))
        elif self.parts:
            taker(self.parts[-1], time, data)


def read(path: str | Path) -> Recording:
    """Read a recording.

    Args:
        path: the file, at most 1 GB.

    Returns:
        All of it. Where the end of the file is missing, what there is, and `cut` is true.

    Raises:
        ConfigError: the file can't be read, isn't a recording, or is damaged.
    """
    reader, digest, cut = Collector(), hashlib.sha256(), False
    path = Path(path)
    with bounded.opened(path, MOST_BYTES) as file:
        try:
            found = records_of(file, digest)
            found.wanted = reader.takers
            for opcode, content in found:
                reader.take(opcode, content)
        except Cut:
            cut = True
        if reader.header is None:
            raise ConfigError("isn't a recording of acsar_gym")
        config = RobotConfig.model_validate(reader.header["config"])
        episodes = tuple(made(part) for part in reader.parts)
        if not episodes:
            raise ConfigError("holds no episode")
    told = (reader.end or {}).get("dropped", 0)
    dropped = told if isinstance(told, int) and told > 0 else sum(map(missing, reader.parts))
    cut = cut or reader.end is None
    return Recording(
        reader.header, digest.hexdigest()[:16], config, episodes, cut=cut, dropped=dropped
    )


def records_of(file: IO[bytes], digest: Any) -> Records:
    """Return the records of a file; ConfigError for recordings of older versions."""
    if file.read(1) == b"{":
        raise ConfigError("is a recording of an older version, in JSON: record again")
    file.seek(0)
    return Records(file, digest)


def _check_format(header: dict[str, Any]) -> None:
    """Raise ConfigError for a header of another version."""
    if header.get("format") != FORMAT or not isinstance(header.get("config"), dict):
        found = str(header.get("format"))[:20]
        raise ConfigError(f"is a recording of format {found}: this version reads format {FORMAT}")
    for name, kind in HEADER.items():
        if not isinstance(header.get(name), kind):
            raise ConfigError(f"is damaged: its header has no {name!r}")
