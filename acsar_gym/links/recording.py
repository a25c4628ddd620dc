"""Recordings of the bytes of a link: text files with one JSON line per event.

`{"reset": t}` starts an episode at time t [s] of the link's clock. `{"sent": [...], "got": "...",
"t": t}` is one period: bytes sent, bytes received, and time at its end.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from acsar_gym.bodies.base import Camera, GroundTruth
from acsar_gym.errors import ConfigError
from acsar_gym.links.base import Link, camera_of
from acsar_gym.reading import bounded, structured
from acsar_gym.worlds import Scene

MOST_BYTES = 40_000_000
"""Largest accepted file [bytes]; an hour at 100 Hz."""
MOST_LINES = 360_000
MOST_LINE = 100_000
"""Longest accepted line [bytes]; several seconds of a fast serial line."""


@dataclass(frozen=True, slots=True)
class Period:
    """One period of a recording: bytes sent and received, and the time at its end [s]."""

    sent: bytes
    got: bytes
    stamp: float


@dataclass(frozen=True, slots=True)
class Episode:
    """The periods after one reset, and the time of that reset [s]."""

    start: float
    periods: list[Period]


class RecordingLink:
    """Forwards to another link and records its bytes in a file, line by line.

    Args:
        link: the link to record.
        path: file to write.
    """

    def __init__(self, link: Link, path: Path) -> None:
        self._link = link
        self._path = path
        self._file: IO[str] | None = None
        self._mode = "w"
        self._sent = b""
        self._now = 0.0

    def open(self) -> None:
        """Open link and file; after a close, recording continues at the end of the file."""
        self._link.open()
        if self._file is None:
            try:
                self._file = opened(self._path, self._mode)
            except ConfigError:
                self._link.close()
                raise
            self._mode = "a"

    def reset(self, scene: Scene) -> None:
        """Start an episode; bytes written before the reset belong to its first period."""
        self._link.reset(scene)
        self._now = self._link.now()
        self._note({"reset": self._now})

    def write(self, data: bytes) -> None:
        """Send bytes to the link and record them."""
        self._link.write(data)
        self._sent += data

    def advance(self, period: float) -> bytes:
        """Advance the link and record the period."""
        got = self._link.advance(period)
        self._now = self._link.now()
        sent, self._sent = self._sent.decode("latin-1"), b""
        self._note({"sent": sent, "got": got.decode("latin-1"), "t": self._now})
        return got

    def _note(self, event: dict[str, object]) -> None:
        """Write an event to the file."""
        if self._file is not None:
            written(self._file, json.dumps(event) + "\n")

    def now(self) -> float:
        """Return the time of the last reset or period, as recorded [s]."""
        return self._now

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of the link; it isn't recorded."""
        return self._link.truth

    @property
    def lateness(self) -> float | None:
        """Lateness of the link [s]."""
        return self._link.lateness

    @property
    def camera(self) -> Camera | None:
        """Camera of the link."""
        return camera_of(self._link)

    def __reduce__(self) -> tuple[type[RecordingLink], tuple[Link, Path]]:
        """Copy with a copy of the link."""
        return RecordingLink, (self._link, self._path)

    def close(self) -> None:
        """Close the link, then the file."""
        self._link.close()
        if self._file is not None:
            file, self._file = self._file, None
            closed(file)


def opened(path: Path, mode: str = "w") -> IO[str]:
    """Open a text file for writing line by line; ConfigError if that fails."""
    try:
        return open(path, mode, buffering=1, encoding="ascii", opener=bounded.opener)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be written: {bounded.reason(error)}") from None


def read(path: Path) -> list[Episode]:
    """Read all episodes of a recording.

    Args:
        path: the file, at most 40 MB.

    Raises:
        ConfigError: the file can't be read, or isn't a recording.
    """
    episodes: list[Episode] = []
    newest = -math.inf
    for number, line in _lines(path):
        try:
            event = structured.from_json(line)
            newest = _add(event, episodes, newest)
        except (LookupError, TypeError, ValueError, AttributeError, ConfigError):
            raise ConfigError(f"{path}: line {number:,} isn't part of a recording") from None
    if not episodes:
        raise ConfigError(f"{path}: holds no episode")
    return episodes


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield the lines with their numbers."""
    data = bounded.read(path, MOST_BYTES)
    if data.count(b"\n") > MOST_LINES:
        raise ConfigError(f"{path}: has more than {MOST_LINES:,} lines: cut out a part of it")
    lines = io.BytesIO(data)
    yield from enumerate(iter(lambda: lines.readline(MOST_LINE), b""), start=1)


def _add(event: Any, episodes: list[Episode], newest: float) -> float:
    """Add one event to the episodes; returns its time, which must not go backwards."""
    if "reset" in event:
        stamp = _stamp(event["reset"])
        episodes.append(Episode(stamp, []))
        return stamp
    stamp = _stamp(event["t"])
    if stamp < newest:
        raise ValueError
    sent, got = event["sent"].encode("latin-1"), event["got"].encode("latin-1")
    episodes[-1].periods.append(Period(sent, got, stamp))
    return stamp


def _stamp(value: Any) -> float:
    """Return a finite number; strings and booleans are errors."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise TypeError
    return float(value)


def written(file: IO[str], line: str) -> None:
    """Write a line; ConfigError if that fails, as on a full disk."""
    try:
        file.write(line)
    except OSError as error:
        closed(file)
        raise ConfigError(f"{file.name}: can't be written: {error.strerror}") from None


def closed(file: IO[str]) -> None:
    """Close a file; ignore errors."""
    with contextlib.suppress(OSError):
        file.close()
