"""Writes a recording: blocks of exact data for this package, ROS messages for other programs."""

from __future__ import annotations

import contextlib
import itertools
import os
import time
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, explain_error, require_extra
from acsar_gym.reading import open_nonblocking
from acsar_gym.recording.blocks import MAGIC, MEDIA_TYPE, NAME, pack_block
from acsar_gym.recording.events import Began, Event, Rows, Tables
from acsar_gym.recording.messages import (
    KINDS,
    LATCHED_QOS,
    Publisher,
    define,
    prepare_messages,
    to_plain_json,
)
from acsar_gym.resources import package_version

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

EPISODE_GAP = 1_000_000  # time between two episodes whose clocks both begin at zero [ns]
MESSAGES_AT_ONCE = 32  # messages that are written before other threads may run
YIELD_TIME = 0.0002  # how long other threads may run: the control loop never waits longer [s]


class Sink:
    """Gets the blocks of a recorder, in its own thread. An error ends what this sink gets."""

    def write(self, head: Mapping[str, Any], tables: Tables) -> None:
        """Take a block.

        Args:
            head: Fields of a `blocks.Head`. Those of an episode begin with the clock at its reset.
            tables: Its tables, of whole control periods.
        """

    def flush(self) -> None:
        """Make what was written safe. Called about twice a second."""

    def close(self, dropped: int) -> None:
        """Finish. `dropped` is the number of events that never became blocks."""

    def abandon(self) -> None:
        """Give up after an error."""


class Tabulator:
    """Makes blocks of the events of a drive, and hands them to sinks.

    A block is the tables of about half a second, with what is known of their episode.

    Args:
        sinks: What gets the blocks.
    """

    def __init__(self, sinks: Sequence[Sink]) -> None:
        self._sinks = sinks
        self._waiting: list[Rows] = []
        self._opening: dict[str, Any] = {}
        self._newest = -1

    def add(self, events: Iterable[Event], *, is_last: bool = False) -> None:
        """Take events, and hand on the blocks that are complete.

        The newest control period waits for more events, unless these are the last events.
        """
        for event in events:
            if not isinstance(event, Began):
                self._waiting.append(event)
                continue
            self._write_block(len(self._waiting))
            self._begin_episode(event)
            # A block for the reset alone marks the episode before as complete.
            self._waiting = [{"clocks": (event.stamp, event.wall)}]
            self._write_block(1)

        periods = [n for n, rows in enumerate(self._waiting) if "exchanges" in rows]
        is_waiting = periods and periods[-1] > 0 and not is_last
        self._write_block(periods[-1] if is_waiting else len(self._waiting))

    def _begin_episode(self, began: Began) -> None:
        """Note the opening of an episode. Its clock may have started again at zero."""
        start = round(began.stamp * 1e9)
        # Times of all episodes continue from the wall clock of the first reset.
        offset = self._opening.get("offset", began.wall - start)
        # Players sort by time: an episode must not start before the end of the last.
        if start + offset <= self._newest:
            offset = self._newest + EPISODE_GAP - start
        self._opening = {
            "episode": self._opening.get("episode", -1) + 1,
            "start": began.stamp,
            "offset": offset,
            "info": to_plain_json(dict(began.info)),
        }

    def _write_block(self, count: int) -> None:
        """Make a block of the oldest events, if there are any."""
        tables = Tables.of(self._waiting[:count])
        self._waiting = self._waiting[count:]
        if not tables or not self._opening:
            return

        # The head says which control periods these are, so that missing blocks are noticed.
        head = dict(self._opening)
        if "exchanges" in tables:
            numbers = tables["exchanges"]["number"]
            head["periods"] = (int(numbers[0]), int(numbers[-1]))
        # The reset's observation is no step, and has no outcome.
        if tables["steps"]["step"].any():
            head["outcome"] = tables["steps"][-1].tolist()[3:]
        newest = max(table["stamp"].max() for table in tables.values() if table.dtype.names)
        self._newest = max(self._newest, round(newest * 1e9) + head["offset"])
        for sink in self._sinks:
            sink.write(head, tables)


def check_target(path: Path, source: Path | None = None) -> None:
    """Check that a recording may be written here. Writes nothing.

    Args:
        path: The file.
        source: The recording that is replayed meanwhile.

    Raises:
        ConfigError: It may not.
    """
    problem = ""
    try:
        if path.is_dir() or not path.parent.is_dir():
            problem = "can't be written: must be a file in a folder of yours"
        elif source is not None and path.exists() and source.exists() and path.samefile(source):
            problem = "is being replayed: record to another file"
        elif path.is_file():
            with path.open("rb") as file:
                if file.read(len(MAGIC)) not in (b"", MAGIC):
                    problem = "isn't a recording, so it isn't replaced: name another file"
    except (OSError, ValueError) as error:
        problem = f"can't be written: {explain_error(error)}"
    if problem:
        raise ConfigError(f"{path}: {problem}")


def next_number(path: Path) -> Path:
    """Return the first name "drive.1.mcap", "drive.2.mcap" that no file has."""
    names = (path.with_suffix(f".{number}{path.suffix}") for number in itertools.count(1))
    return next(name for name in names if not name.exists())


def open_exclusively(path: Path) -> IO[bytes]:
    """Open a file for one recorder only. An older recording is kept under a number.

    The file has no buffer, which a forked process would write a second time.

    Raises:
        OSError: It can't be opened, or another recorder writes it.
    """
    file = open(path, "ab", buffering=0, opener=open_nonblocking)  # noqa: SIM115 - stays open
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
        # A file without a buffer may accept fewer bytes than it is given.
        while remaining:
            remaining = remaining[self.raw.write(remaining) :]
        return len(data)

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def close(self) -> None:
        """Close the file, also for processes that were forked meanwhile."""
        with contextlib.suppress(OSError, ValueError), self.raw:
            if fcntl is not None:
                # A forked process shares the lock, and would hold it for as long as it runs.
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
            with contextlib.ExitStack() as stack:
                stack.callback(self.abandon)
                self._writer: Any = Writer(self._file)  # type: ignore[arg-type]
                self._writer.start("ros2", f"acsar_gym {package_version()}")
                self._write_block({"header": header}, Tables())
                stack.pop_all()
        except (OSError, ValueError) as error:
            raise ConfigError(f"{path}: can't be written: {explain_error(error)}") from error

    def write(self, head: Mapping[str, Any], tables: Tables) -> None:
        """Write a block: its messages, between which other threads may run, then its tables."""
        messages = self._publisher.make_messages(head, tables)
        for number, (topic, stamp, data) in enumerate(messages):
            if topic not in self._channels:
                self._channels[topic] = self._register(topic)
            self._writer.add_message(self._channels[topic], stamp, data, stamp)
            self._newest = max(self._newest, stamp)
            if number % MESSAGES_AT_ONCE == 0:
                time.sleep(YIELD_TIME)
        self._write_block(head, tables)

    def _register(self, topic: str) -> int:
        """Write the type of a topic, and return the number of its channel."""
        kind = KINDS[topic]
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", define(kind))
        quality = {"offered_qos_profiles": LATCHED_QOS if topic == "/tf_static" else ""}
        channel: int = self._writer.register_channel(topic, "cdr", self._schemas[kind], quality)
        return channel

    def flush(self) -> None:
        """Make what was written safe from a crash of the computer."""
        with contextlib.suppress(OSError):  # not a regular file
            os.fdatasync(self._file.raw.fileno())

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
