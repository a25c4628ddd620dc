"""Writes a recording: blocks of exact data for this package, ROS messages for other programs."""

from __future__ import annotations

import contextlib
import itertools
import os
import time
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, explain_error, require_extra
from acsar_gym.recording.blocks import MAGIC, MEDIA_TYPE, NAME, pack_block
from acsar_gym.recording.events import Tables
from acsar_gym.recording.messages import (
    LATCHED,
    LATCHED_QOS,
    Publisher,
    define,
    package_version,
    prepare_messages,
)
from acsar_gym.recording.tabulator import Sink

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

MESSAGES_AT_ONCE = 32  # messages that are written before other threads may run
YIELD_TIME = 0.0002  # how long other threads may run: the control loop never waits longer [s]


def check_target(path: Path, source: Path | None = None) -> None:
    """Check that a recording may be written here. Writes nothing.

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


def open_exclusively(path: Path) -> IO[bytes]:
    """Open a file for one recorder only. An older recording is kept under a number.

    The file has no buffer, which a forked process would write a second time.
    """
    file = path.open("ab", buffering=0)
    try:
        lock(file)
        if not os.fstat(file.fileno()).st_size:
            return file
    except OSError:
        file.close()
        raise
    # The lock is on the older recording, so no other recorder writes it meanwhile.
    path.rename(next_number(path))
    file.close()
    return open_exclusively(path)


def lock(file: IO[bytes]) -> None:
    """Lock a file until it is closed. Raises OSError if another recorder holds it."""
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise OSError(0, "another recorder writes it: name a file for each") from error
    except OSError:  # a file system that can't lock
        pass


class RecordingFile:
    """The file of a recording, for mcap's writer.

    Attributes:
        checksum: CRC-32 of what was written since it was last set to 0.
    """

    def __init__(self, path: Path) -> None:
        self.raw = open_exclusively(path)
        self.tell = self.raw.tell
        self.checksum = 0

    def write(self, data: bytes) -> int:
        """Write all of the bytes."""
        self.checksum = zlib.crc32(data, self.checksum)
        remaining = memoryview(data)
        while remaining:
            remaining = remaining[self.raw.write(remaining) :]
        return len(data)

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def sync(self) -> None:
        """Make what was written safe from a crash of the computer."""
        with contextlib.suppress(OSError):  # not a regular file
            os.fdatasync(self.raw.fileno())

    def close(self) -> None:
        """Close the file, also for processes that were forked meanwhile."""
        with contextlib.suppress(OSError, ValueError), self.raw:
            if fcntl is not None:
                fcntl.flock(self.raw, fcntl.LOCK_UN)


class RecordingWriter(Sink):
    """A recording that is being written. Errors are OSError.

    Args:
        path: The file. An older recording of that name is kept under a number.
        config: Robot configuration.
        header: Header of the recording. See `recording.messages`.

    Raises:
        ConfigError: The file can't be written.
        MissingExtraError: mcap or rosbags isn't installed.
    """

    def __init__(self, path: Path, config: RobotConfig, header: Mapping[str, Any]) -> None:
        with require_extra("recording", "record"):
            from mcap.writer import Writer  # noqa: PLC0415 - optional

        prepare_messages()
        self._publisher = Publisher(config)
        self._header = header
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._newest = 0
        try:
            self._file = RecordingFile(path)
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: can't be written: {explain_error(error)}") from error
        try:
            self._writer: Any = Writer(self._file)  # type: ignore[arg-type]
            self._writer.start("ros2", f"acsar_gym {package_version()}")
            self._write_block({"header": header}, Tables())
        except OSError as error:
            self.abandon()
            raise ConfigError(f"{path}: can't be written: {explain_error(error)}") from error

    def write(self, head: Mapping[str, Any], tables: Tables) -> None:
        """Write a block: its messages, between which other threads may run, then its tables."""
        messages = self._publisher.make_messages(head, tables)
        for number, (series, stamp, data) in enumerate(messages):
            if series.topic not in self._channels:
                self._channels[series.topic] = self._register(series.topic, series.kind)
            self._writer.add_message(self._channels[series.topic], stamp, data, stamp)
            self._newest = max(self._newest, stamp)
            if number % MESSAGES_AT_ONCE == 0:
                time.sleep(YIELD_TIME)
        self._write_block(head, tables)

    def _register(self, topic: str, kind: str) -> int:
        """Write the type of a topic, and return the number of its channel."""
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", define(kind))
        quality = {"offered_qos_profiles": LATCHED_QOS if topic in LATCHED else ""}
        channel: int = self._writer.register_channel(topic, "cdr", self._schemas[kind], quality)
        return channel

    def flush(self) -> None:
        """Make what was written safe from a crash of the computer."""
        self._file.sync()

    def close(self, dropped: int) -> None:
        """Finish the file, which states the number of dropped events."""
        try:
            self._write_block({"header": self._header, "dropped": dropped}, Tables())
            self._writer.finish()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _write_block(self, head: Mapping[str, Any], tables: Tables) -> None:
        # All messages of the block must be in the file before their checksum is written.
        self._writer.flush()
        content = pack_block({"before": self._file.checksum, **head}, tables)
        self._writer.add_attachment(self._newest, self._newest, NAME, MEDIA_TYPE, content)
        self._file.checksum = 0
