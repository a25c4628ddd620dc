"""Writes a recording: blocks of exact data for this package, ROS messages for other programs."""

from __future__ import annotations

import contextlib
import itertools
import os
import time
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, explain_error, require_extra
from acsar_gym.recording.blocks import MAGIC, MEDIA_TYPE, NAME, pack_block
from acsar_gym.recording.events import Began, Clock, Event, Exchange, Tables, Tabulator
from acsar_gym.recording.messages import Publisher, define, package_version, to_plain_json

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

EPISODE_GAP = 1_000_000  # time between two episodes whose clocks both begin at zero [ns]
MESSAGES_AT_ONCE = 32  # messages that are written before other threads may run
YIELD_TIME = 0.0002  # how long other threads may run: the control loop never waits longer [s]


def check_target(path: Path, source: Path | None = None) -> None:
    """Check that a recording may be written here; writes nothing.

    Args:
        path: The file.
        source: The recording that is replayed meanwhile.

    Raises:
        ConfigError: It may not.
    """
    try:
        if path.is_dir() or not path.parent.is_dir():
            raise ConfigError(f"{path}: can't be written: must be a file in a folder of yours")
        if source is not None and path.exists() and source.exists() and path.samefile(source):
            raise ConfigError(f"{path}: is being replayed: record to another file")
        if path.is_file():
            with path.open("rb") as file:
                if file.read(len(MAGIC)) not in (b"", MAGIC):
                    raise ConfigError(
                        f"{path}: isn't a recording, so it isn't replaced: name another file"
                    )
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be written: {explain_error(error)}") from error


def next_number(path: Path) -> Path:
    """Return the first name "drive.1.mcap", "drive.2.mcap" that no file has."""
    numbered = (path.with_suffix(f".{n}{path.suffix}") for n in itertools.count(1))
    return next(name for name in numbered if not name.exists())


def open_exclusively(path: str, flags: int) -> int:
    """Open a file for one recorder only, for `open(opener=...)`; an older recording is kept."""
    file = _open_locked(path, flags)
    if not os.fstat(file).st_size:
        return file
    try:
        Path(path).rename(next_number(Path(path)))
        return _open_locked(path, flags)
    finally:
        os.close(file)


def _open_locked(path: str, flags: int) -> int:
    """Open a file, which isn't emptied; OSError if another recorder holds it."""
    file = os.open(path, flags & ~os.O_TRUNC, 0o666)
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            os.close(file)
            raise OSError(0, "another recorder writes it: name a file for each") from error
        except OSError:  # a file system that can't lock
            pass
    return file


class UnbufferedFile:
    """A file without a buffer, which a forked process would write a second time.

    Attributes:
        checksum: CRC-32 of what was written since it was last set to 0.
    """

    def __init__(self, path: Path) -> None:
        self.raw = open(path, "wb", buffering=0, opener=open_exclusively)  # noqa: SIM115
        self.tell = self.raw.tell
        self.checksum = 0

    def write(self, data: bytes) -> int:
        """Write all of the bytes."""
        self.checksum = zlib.crc32(data, self.checksum)
        remaining = memoryview(data)
        while remaining:
            remaining = remaining[self.raw.write(remaining) or 0 :]
        return len(data)

    def flush(self) -> None:
        """Do nothing: there is no buffer."""


class RecordingWriter:
    """A recording that is being written. Errors are OSError.

    Args:
        path: The file. An older recording of that name is kept under a number.
        config: Robot configuration.
        header: Header of the recording; see `recording.messages`.

    Attributes:
        written: Number of messages and blocks that were written.

    Raises:
        ConfigError: The file can't be written.
        MissingExtraError: mcap or rosbags isn't installed.
    """

    def __init__(self, path: Path, config: RobotConfig, header: Mapping[str, Any]) -> None:
        with require_extra("recording", "record"):
            from mcap.writer import Writer  # noqa: PLC0415 - optional

        self.written = 0
        self._publisher = Publisher(config)
        self._header = header
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._file: UnbufferedFile | None = None

        self._events: list[Event] = []
        self._tabulator = Tabulator()
        self._opening: dict[str, Any] = {}
        self._start: Sequence[float] = (0.0, 0.0, 0.0)
        self._episode = self._newest = -1
        self._offset = 0
        try:
            self._file = UnbufferedFile(path)
            self._writer: Any = Writer(self._file)  # type: ignore[arg-type]
            self._writer.start("ros2", f"acsar_gym {package_version()}")
            self._write_block({"header": header}, {})
        except (OSError, ValueError) as error:
            self.abandon()
            raise ConfigError(f"{path}: can't be written: {explain_error(error)}") from error

    def add(self, events: Iterable[Event]) -> None:
        """Take events; those before a reset are written."""
        for event in events:
            if isinstance(event, Began):
                self._write_events(self._events)
                self._events = []
                self._begin_episode(event)
            else:
                self._events.append(event)

    def write_block(self) -> None:
        """Write all complete control periods.

        The newest period may still get events, so it waits, unless nothing came after it.
        """
        numbers = [n for n, event in enumerate(self._events) if isinstance(event, Exchange)]
        end = numbers[-1] if numbers and numbers[-1] > 0 else len(self._events)
        self._write_events(self._events[:end])
        self._events = self._events[end:]

    def flush(self) -> None:
        """Make what was written safe from a crash of the computer."""
        with contextlib.suppress(OSError):  # not a regular file
            if self._file is not None:
                os.fdatasync(self._file.raw.fileno())

    def close(self, dropped: int) -> None:
        """Finish the file; so many events were dropped."""
        try:
            self._write_events(self._events)
            self._write_block({"header": self._header, "dropped": dropped}, {})
            self._writer.finish()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._file is not None and not self._file.raw.closed:
            with contextlib.suppress(OSError):
                if fcntl is not None:  # also for processes that were forked meanwhile
                    fcntl.flock(self._file.raw.fileno(), fcntl.LOCK_UN)
            with contextlib.suppress(OSError):
                self._file.raw.close()

    def _begin_episode(self, began: Began) -> None:
        """Write the block that begins an episode; its clock may have started again at zero."""
        start = round(began.stamp * 1e9)
        if self._newest < 0:
            self._offset = began.wall - start
        elif start + self._offset <= self._newest:
            self._offset = self._newest + EPISODE_GAP - start

        self._episode += 1
        self._tabulator = Tabulator()
        info = to_plain_json(dict(began.info))
        self._start = info.get("start", (0.0, 0.0, 0.0))
        self._opening = {
            "episode": self._episode,
            "start": began.stamp,
            "offset": self._offset,
            "info": info,
        }
        tables = self._tabulator.make_tables([Clock(began.stamp, began.wall)])
        self._publish({**tables, "resets": tables["clocks"]})
        self._write_block(self._opening, tables)

    def _write_events(self, events: Sequence[Event]) -> None:
        """Write events of one episode: their messages, then their tables."""
        if not events or self._episode < 0:
            return
        tables = self._tabulator.make_tables(events)
        self._publish(tables)
        head = dict(self._opening)
        if "exchanges" in tables:
            numbers = tables["exchanges"]["number"]
            head["periods"] = (int(numbers[0]), int(numbers[-1]))
        if "steps" in tables:
            head["outcome"] = tables["steps"][-1].tolist()[3:]
        self._write_block(head, tables)

    def _publish(self, tables: Tables) -> None:
        """Write the messages of tables. Other threads may run in between."""
        messages = self._publisher.make_messages(tables, self._start, self._offset)
        for number, (topic, stamp, data) in enumerate(messages):
            if topic.name not in self._channels:
                if topic.kind not in self._schemas:
                    schema = (topic.kind, "ros2msg", define(topic.kind))
                    self._schemas[topic.kind] = self._writer.register_schema(*schema)
                channel = (topic.name, "cdr", self._schemas[topic.kind], topic.metadata)
                self._channels[topic.name] = self._writer.register_channel(*channel)
            self._writer.add_message(self._channels[topic.name], stamp, data, stamp)
            self._newest = max(self._newest, stamp)
            self.written += 1
            if number % MESSAGES_AT_ONCE == 0:
                time.sleep(YIELD_TIME)

    def _write_block(self, head: Mapping[str, Any], tables: Tables) -> None:
        if self._file is None:
            return
        self._writer.flush()
        content = pack_block({"before": self._file.checksum, **head}, tables)
        stamp = max(self._newest, 0)
        self._writer.add_attachment(stamp, stamp, NAME, MEDIA_TYPE, content)
        self._file.checksum = 0
        self.written += 1
