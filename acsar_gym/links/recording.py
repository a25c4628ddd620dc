"""Recordings of what went over a wire: one JSON line per event, readable with any text tool.

`{"reset": t}` begins an episode with the link's clock at t [s]; `{"sent": [...], "got": "...",
"t": t}` is one period: what was written in it, what arrived, and the clock at its end.
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
"""Of a recording: an hour at 100 Hz."""
MOST_LINES = 360_000
MOST_LINE = 100_000
"""Bytes of a line: what a fast wire carries in several seconds."""


@dataclass(frozen=True, slots=True)
class Period:
    """One period of a recording."""

    sent: bytes
    got: bytes
    stamp: float


@dataclass(frozen=True, slots=True)
class Episode:
    """The periods after one reset, and the clock at that reset [s]."""

    start: float
    periods: list[Period]


class RecordingLink:
    """Passes everything on to another link and writes it down. The file grows as it goes."""

    def __init__(self, link: Link, path: Path) -> None:
        self._link = link
        self._path = path
        self._file: IO[str] | None = None
        self._mode = "w"
        self._sent = b""
        self._now = 0.0

    def open(self) -> None:
        """Open the link and the file; what is recorded after a close is appended."""
        self._link.open()
        if self._file is None:
            try:
                self._file = opened(self._path, self._mode)
            except ConfigError:
                self._link.close()
                raise
            self._mode = "a"

    def reset(self, scene: Scene) -> None:
        """Begin an episode; what was written before belongs to its first period."""
        self._link.reset(scene)
        self._now = self._link.now()
        self._note({"reset": self._now})

    def write(self, data: bytes) -> None:
        """Pass on and remember."""
        self._link.write(data)
        self._sent += data

    def advance(self, period: float) -> bytes:
        """Pass on, and write the period down."""
        got = self._link.advance(period)
        self._now = self._link.now()
        sent, self._sent = self._sent.decode("latin-1"), b""
        self._note({"sent": sent, "got": got.decode("latin-1"), "t": self._now})
        return got

    def _note(self, event: dict[str, object]) -> None:
        if self._file is not None:
            written(self._file, json.dumps(event) + "\n")

    def now(self) -> float:
        """The link's clock at the last reset or period: the stamp that is written down."""
        return self._now

    @property
    def truth(self) -> GroundTruth | None:
        """The link's truth; it isn't recorded."""
        return self._link.truth

    @property
    def lateness(self) -> float | None:
        """The link's lateness."""
        return self._link.lateness

    @property
    def camera(self) -> Camera | None:
        """The link's camera."""
        return camera_of(self._link)

    def __reduce__(self) -> tuple[type[RecordingLink], tuple[Link, Path]]:
        """Copies record a link of their own."""
        return RecordingLink, (self._link, self._path)

    def close(self) -> None:
        """Close the link, then the file."""
        self._link.close()
        if self._file is not None:
            file, self._file = self._file, None
            closed(file)


def opened(path: Path, mode: str = "w") -> IO[str]:
    """A text file that is written line by line. Raises ConfigError where it can't be."""
    try:
        return open(path, mode, buffering=1, encoding="ascii", opener=bounded.opener)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be written: {bounded.reason(error)}") from None


def read(path: Path) -> list[Episode]:
    """All episodes of a recording of at most 40 MB. Raises ConfigError where the file isn't one."""
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
    data = bounded.read(path, MOST_BYTES)
    if data.count(b"\n") > MOST_LINES:
        raise ConfigError(f"{path}: has more than {MOST_LINES:,} lines: cut out a part of it")
    lines = io.BytesIO(data)
    yield from enumerate(iter(lambda: lines.readline(MOST_LINE), b""), start=1)


def _add(event: Any, episodes: list[Episode], newest: float) -> float:
    """Add what a line says, and return its stamp, which is no earlier than the one before."""
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
    """A finite number; text and truth values are none."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise TypeError
    return float(value)


def written(file: IO[str], line: str) -> None:
    """Write a line. Raises ConfigError where that can't be done, as on a full disk."""
    try:
        file.write(line)
    except OSError as error:
        closed(file)
        raise ConfigError(f"{file.name}: can't be written: {error.strerror}") from None


def closed(file: IO[str]) -> None:
    """Close a file; what can't be written any more is lost."""
    with contextlib.suppress(OSError):
        file.close()
