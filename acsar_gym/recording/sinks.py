"""Where messages go: to an MCAP file, as ROS 2's own recorder writes it, and live to Foxglove."""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from acsar_gym.errors import ConfigError, explain_error, require_extra
from acsar_gym.recording import messages
from acsar_gym.recording.encoder import Message
from acsar_gym.recording.messages import (
    MCAP_MAGIC,
    MESSAGE_ENCODING,
    SCHEMA_ENCODING,
    TOPICS,
    Topic,
)

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

CHUNK_SIZE = 100_000
"""Size of a chunk before it is packed [bytes]; a cut file loses its last one."""
LIVE_HOST = "127.0.0.1"
LIVE_PORT = 8765
"""The port that viewers try first; another free one where it is taken."""


class Sink(Protocol):
    """Something that takes messages: a file, or viewers."""

    def add(self, message: Message) -> None:
        """Take a message."""

    def flush(self) -> None:
        """Pass on what was added."""

    def close(self, dropped: int) -> None:
        """End; so many events were dropped."""

    def abandon(self) -> None:
        """End after an error; raises nothing."""


def check_target(path: Path, source: Path | None = None) -> None:
    """Check that a recording may be written here; writes nothing."""
    try:
        if path.is_dir() or not path.parent.is_dir():
            raise ConfigError(f"{path}: can't be written: must be a file in a folder of yours")
        if source is not None and path.exists() and source.exists() and path.samefile(source):
            raise ConfigError(f"{path}: is being replayed: record to another file")
        if path.is_file():
            with path.open("rb") as file:
                if file.read(len(MCAP_MAGIC)) not in (b"", MCAP_MAGIC):
                    raise ConfigError(
                        f"{path}: isn't a recording, so it isn't replaced: name another file"
                    )
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be written: {explain_error(error)}") from error


def next_number(path: Path) -> Path:
    """The first name "drive.1.mcap", "drive.2.mcap" that no file has."""
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
    """Open a file, which isn't emptied; OSError where another recorder holds it."""
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


class McapFile:
    """A recording that is written, in one file, or in FILE.mcap, FILE-2.mcap and so on.

    Errors are OSError, and ConfigError for a file that can't begin. Messages tell their episode in
    their field `sequence`, and the header stands at both ends: what is whole of a damaged file can
    be told apart.
    """

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        self._path, self._about = path, header
        self._number, self._dropped = 1, 0
        self._open(path, header)

    def _open(self, path: Path, header: Mapping[str, Any]) -> None:
        with require_extra("recording", "record"):
            from mcap.writer import Writer  # noqa: PLC0415 - optional
        messages.load_typestore()
        self._file: UnbufferedFile | None = None
        try:
            self._file = UnbufferedFile(path)
            self._writer: Any = Writer(self._file, chunk_size=CHUNK_SIZE)  # type: ignore[arg-type]
            self._writer.start("ros2", f"acsar_gym {messages.package_version()}")
            self._header = messages.seal_text("header", header)
            self._episode = 0
            self._writer.add_metadata(messages.HEADER_RECORD, self._header)
            usual = [topic for topic in TOPICS if not topic.optional]
            self._schemas: dict[str, int] = {}
            self._channels: dict[str, int] = {}
            for kind in dict.fromkeys(topic.kind for topic in usual):
                self._register_schema(kind)
            for topic in usual:
                self._register_channel(topic)
            self.flush()
        except (OSError, ValueError) as error:
            self.abandon()
            raise ConfigError(f"{path}: can't be written: {explain_error(error)}") from error

    def _register_schema(self, kind: str) -> None:
        definition = messages.type_definition(kind)
        self._schemas[kind] = self._writer.register_schema(kind, SCHEMA_ENCODING, definition)

    def _register_channel(self, topic: Topic) -> None:
        if topic.kind not in self._schemas:
            self._register_schema(topic.kind)
        schema = self._schemas[topic.kind]
        channel = self._writer.register_channel(
            topic.name, MESSAGE_ENCODING, schema, topic.metadata
        )
        self._channels[topic.name] = channel

    def add(self, message: Message) -> None:
        """Add a message; it is in the file after the next `flush`."""
        self._episode += message.topic is messages.EPISODE
        if message.topic.name not in self._channels:
            self._register_channel(message.topic)
        channel = self._channels[message.topic.name]
        time = message.time
        self._writer.add_message(channel, time, message.data, time, self._episode)

    def flush(self) -> None:
        """Write what was added, so that it survives a crash of the program or the computer."""
        self._writer.flush()
        with contextlib.suppress(OSError):  # not a regular file
            if self._file is not None:
                os.fdatasync(self._file.raw.fileno())

    def begin_file(self, dropped: int) -> None:
        """Finish the file and begin the next one."""
        self.close(dropped)
        self._number, self._dropped = self._number + 1, dropped
        path = self._path.with_stem(f"{self._path.stem}-{self._number}")
        self._open(path, {**self._about, "cut": {"file": self._number}})

    def close(self, dropped: int) -> None:
        """Finish the file with its index, and what is only known at the end."""
        end = messages.seal_text("end", {"dropped": dropped - self._dropped})
        try:
            self._writer.flush()
            self._writer.add_metadata(messages.HEADER_RECORD, self._header)
            self._writer.add_metadata(messages.END_RECORD, end)
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


class UnbufferedFile:
    """A file without a buffer, which a forked process would write a second time."""

    def __init__(self, path: Path) -> None:
        self.raw = open(path, "wb", buffering=0, opener=open_exclusively)  # noqa: SIM115
        self.tell = self.raw.tell

    def write(self, data: bytes) -> int:
        """Write all of the bytes."""
        rest = memoryview(data)
        while rest:
            rest = rest[self.raw.write(rest) or 0 :]
        return len(data)

    def flush(self) -> None:
        """Do nothing: there is no buffer."""


class LiveView:
    """A server on this computer that Foxglove connects to; messages go to whoever is connected."""

    def __init__(self, port: int = LIVE_PORT) -> None:
        with require_extra("a live view", "view"):
            import foxglove  # noqa: PLC0415 - optional
        self._context = context = foxglove.Context()  # nothing else keeps it
        self._channels = {
            topic.name: foxglove.Channel(
                topic.name,
                schema=foxglove.Schema(
                    name=topic.kind,
                    encoding=SCHEMA_ENCODING,
                    data=messages.type_definition(topic.kind),
                ),
                message_encoding=MESSAGE_ENCODING,
                context=context,
                metadata=topic.metadata,
            )
            for topic in TOPICS
        }
        self._latched: dict[str, Message] = {}
        server: Any = None
        for number in dict.fromkeys((port, 0)):
            try:
                server = foxglove.start_server(
                    name="acsar_gym", host=LIVE_HOST, port=number, context=context
                )
                break
            except Exception as error:  # noqa: BLE001 - whatever the SDK raises
                problem = error
        if server is None:
            raise ConfigError(f"no live view: {explain_error(problem)}")
        self._server = server
        self.url = f"ws://{LIVE_HOST}:{server.port}"

    def add(self, message: Message) -> None:
        """Send a message to the viewers."""
        if message.topic.latched:
            self._latched[message.topic.name] = message
        self._channels[message.topic.name].log(message.data, log_time=message.time)

    def flush(self) -> None:
        """Send again what viewers need that connected later."""
        for message in self._latched.values():
            self.add(message)

    def close(self, dropped: int) -> None:
        """Stop the server."""
        self.abandon()

    def abandon(self) -> None:
        """Stop the server."""
        with contextlib.suppress(Exception):
            self._server.stop()
            for channel in self._channels.values():
                channel.close()
