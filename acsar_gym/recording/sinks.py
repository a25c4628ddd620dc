"""Where messages go: to an MCAP file, as ROS 2's own recorder writes it, and live to Foxglove."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acsar_gym import reading
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.reading import explain_error
from acsar_gym.recording import messages, target
from acsar_gym.recording.encoder import Message
from acsar_gym.recording.messages import (
    END_RECORD,
    HEADER_RECORD,
    MESSAGE_ENCODING,
    SCHEMA_ENCODING,
    TOPICS,
    package_version,
    type_definition,
)

LIVE_HOST = "127.0.0.1"
LIVE_PORT = 8765
"""The port that viewers try first; another free one where it is taken."""


class LiveView:
    """A server that viewers connect to; messages go to whoever is connected.

    Attributes: `url`, what viewers open.

    Args:
        port: to listen on; 0 for any free one.

    Raises:
        MissingExtraError: foxglove-sdk or rosbags isn't installed.
        ConfigError: the server can't be started.
    """

    def __init__(self, port: int = LIVE_PORT) -> None:
        try:
            import foxglove  # noqa: PLC0415 - optional
        except ImportError:
            raise MissingExtraError("a live view", "view") from None
        self._context = context = foxglove.Context()  # nothing else keeps it
        self._channels = {
            topic.name: foxglove.Channel(
                topic.name,
                schema=foxglove.Schema(
                    name=topic.kind, encoding=SCHEMA_ENCODING, data=type_definition(topic.kind)
                ),
                message_encoding=MESSAGE_ENCODING,
                context=context,
                metadata=topic.metadata,
            )
            for topic in TOPICS
        }
        self._latched: dict[str, Message] = {}
        self._server = _started(foxglove, context, port)
        self.url = f"ws://{LIVE_HOST}:{self._server.port}"

    def add(self, message: Message) -> None:
        """Send a message to the viewers."""
        if message.topic.latched:
            self._latched[message.topic.name] = message
        self._send(message)

    def flush(self) -> None:
        """Send again what viewers need that connected later."""
        for message in self._latched.values():
            self._send(message)

    def _send(self, message: Message) -> None:
        self._channels[message.topic.name].log(message.data, log_time=message.time)

    def close(self, end: Mapping[str, Any]) -> None:
        """Stop the server."""
        self.abandon()

    def abandon(self) -> None:
        """Stop the server."""
        with contextlib.suppress(Exception):
            self._server.stop()
            for channel in self._channels.values():
                channel.close()


def _started(foxglove: Any, context: Any, port: int) -> Any:
    """Start the server, on another port where this one is taken."""
    for number in dict.fromkeys((port, 0)):
        try:
            return foxglove.start_server(
                name="acsar_gym", host=LIVE_HOST, port=number, context=context
            )
        except Exception as error:  # noqa: BLE001 - whatever the SDK raises
            problem = error
    raise ConfigError(f"no live view: {explain_error(problem)}") from None


CHUNK_SIZE = 100_000
"""Size of a chunk before it is packed [bytes]; a cut file loses its last one."""


class McapFile:
    """A file that is being written. Errors are OSError, except in the constructor.

    Args:
        path: of the file; a recording that is there is replaced.
        header: of the recording.

    Raises:
        ConfigError: it can't be written.
        MissingExtraError: mcap or rosbags isn't installed.
    """

    def __init__(self, path: Path, header: Mapping[str, Any]) -> None:
        try:
            from mcap.writer import Writer  # noqa: PLC0415 - optional
        except ImportError:
            raise MissingExtraError("recording", "record") from None
        messages.load_typestore()
        self._file: _Unbuffered | None = None
        try:
            self._file = _Unbuffered(path)
            self._writer: Any = Writer(self._file, chunk_size=CHUNK_SIZE)  # type: ignore[arg-type]
            self._writer.start("ros2", f"acsar_gym {package_version()}")
            self._writer.add_metadata(HEADER_RECORD, {"header": json.dumps(header)})
            self._channels = self._registered()
            self.flush()
        except (OSError, ValueError) as error:
            self.abandon()
            raise ConfigError(f"{path}: can't be written: {reading.explain_error(error)}") from None

    def _registered(self) -> dict[str, int]:
        """Register all topics; returns their channels."""
        writer, schemas = self._writer, {}
        for kind in dict.fromkeys(topic.kind for topic in TOPICS):
            text = messages.type_definition(kind)
            schemas[kind] = writer.register_schema(kind, SCHEMA_ENCODING, text)
        return {
            topic.name: writer.register_channel(
                topic.name, MESSAGE_ENCODING, schemas[topic.kind], topic.metadata
            )
            for topic in TOPICS
        }

    def add(self, message: Message) -> None:
        """Add a message; it is in the file after the next `flush`."""
        channel = self._channels[message.topic.name]
        self._writer.add_message(channel, message.time, message.data, message.time)

    def flush(self) -> None:
        """Write what was added, so that it survives a crash of the program or the computer."""
        self._writer.flush()
        with contextlib.suppress(OSError):  # not a regular file
            if self._file is not None:
                self._file.sync()

    def close(self, end: Mapping[str, Any]) -> None:
        """Finish the file with its index, and what is only known at the end."""
        try:
            self._writer.flush()
            self._writer.add_metadata(END_RECORD, {"end": json.dumps(end)})
            self._writer.finish()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is."""
        with contextlib.suppress(OSError):
            if self._file is not None:
                self._file.close()


class _Unbuffered:
    """A file without a buffer, which a forked process would write a second time.

    Args:
        path: of the file.
    """

    def __init__(self, path: Path) -> None:
        self._file = open(path, "wb", buffering=0, opener=target.open_exclusively)  # noqa: SIM115

    def write(self, data: bytes) -> int:
        """Write all of the bytes."""
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) or 0 :]
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes so far."""
        return self._file.tell()

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def sync(self) -> None:
        """Wait until the disk has what was written."""
        os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Close the file, and let others write it."""
        if not self._file.closed:
            target.unlock_file(self._file.fileno())
        self._file.close()
