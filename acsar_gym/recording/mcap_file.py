"""Writes messages to an MCAP file, as ROS 2's own recorder does."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.reading import bounded
from acsar_gym.recording import target, typesystem
from acsar_gym.recording.encoder import Message
from acsar_gym.recording.header import END, NAME, version
from acsar_gym.recording.topics import ENCODING, SCHEMA_ENCODING, TOPICS

CHUNK = 100_000
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
        typesystem.store()
        self._file: _Unbuffered | None = None
        try:
            self._file = _Unbuffered(path)
            self._writer: Any = Writer(self._file, chunk_size=CHUNK)  # type: ignore[arg-type]
            self._writer.start("ros2", f"acsar_gym {version()}")
            self._writer.add_metadata(NAME, {"header": json.dumps(header)})
            self._channels = self._registered()
            self.flush()
        except (OSError, ValueError) as error:
            self.abandon()
            raise ConfigError(f"{path}: can't be written: {bounded.reason(error)}") from None

    def _registered(self) -> dict[str, int]:
        """Register all topics; returns their channels."""
        writer, schemas = self._writer, {}
        for kind in dict.fromkeys(topic.kind for topic in TOPICS):
            text = typesystem.definition(kind)
            schemas[kind] = writer.register_schema(kind, SCHEMA_ENCODING, text)
        return {
            topic.name: writer.register_channel(
                topic.name, ENCODING, schemas[topic.kind], topic.metadata
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
            self._writer.add_metadata(END, {"end": json.dumps(end)})
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
        self._file = open(path, "wb", buffering=0, opener=target.opener)  # noqa: SIM115

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
            target.release(self._file.fileno())
        self._file.close()
