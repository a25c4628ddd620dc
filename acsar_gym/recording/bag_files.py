"""Reads the messages of ROS 2 bags: MCAP files, SQLite files (.db3), and folders of them.

Files are read one by one, by their suffix, with or without the metadata of their folder. So a bag
of a program that was killed is read as far as it goes. Everything that is unpacked has a limit.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import io
import re
import shutil
import sqlite3
import struct
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import IO, Any, NamedTuple

from acsar_gym.errors import (
    ConfigError,
    RecordingWarning,
    escape_unprintable,
    explain_error,
    require_extra,
)
from acsar_gym.reading import open_file
from acsar_gym.recording.blocks import FREE_UNPACKED, MAGIC, MAX_BLOCK, MAX_RATIO, has_end

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
COPIED_BYTES = 1 << 20  # bytes that are unpacked at once
PACKED = ".zstd"  # suffix of a file that is packed as a whole


class BagMessage(NamedTuple):
    """One message of a bag."""

    topic: str
    kind: str
    """Type, such as "sensor_msgs/msg/JointState"."""
    time: int
    """When it was recorded [ns]."""
    data: bytes
    """In CDR."""


Reader = Callable[[Path, Callable[[str], None]], Iterator[BagMessage]]


class BagFiles:
    """The files of a bag, in the order in which they were recorded.

    Args:
        path: A file, or a folder of rosbag2.
        folder: Folder for files that have to be unpacked or repaired before they can be read.

    Raises:
        ConfigError: It is no bag.
    """

    def __init__(self, path: Path, folder: Path) -> None:
        self._sources = _find_files(path)
        self._folder = folder
        self._prepared: list[tuple[Path, Path]] = []

    def compute_hash(self) -> str:
        """Return the first 16 hex digits of a hash of all files."""
        digest = hashlib.sha256()
        for path in self._sources:
            with open_file(path) as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        return digest.hexdigest()[:16]

    def read_messages(self) -> Iterator[BagMessage]:
        """Yield all messages. Warns once (RecordingWarning) of what can't be read.

        Raises:
            ConfigError: A file can't be read.
        """
        is_first = not self._prepared
        if is_first:
            self._prepared = [(source, self._prepare(source)) for source in self._sources]
        for source, path in self._prepared:

            def report(problem: str, source: Path = source) -> None:
                if is_first:
                    text = escape_unprintable(f"{source}: {problem}")
                    warnings.warn(text, RecordingWarning, stacklevel=4)

            read: Reader = _read_sqlite if path.suffix == ".db3" else _read_mcap
            for message in read(path, report):
                yield message._replace(data=unpack(message.data))

    def _prepare(self, source: Path) -> Path:
        """Return a file that can be read as it is: the source, or a copy of it."""
        path = source
        if source.suffix == PACKED:
            path = self._folder / source.stem
            with open_file(source) as packed, path.open("wb") as file:
                _unpack_file(packed, file)

        # What SQLite wrote last is in a second file, which only a writer can merge.
        log = source.with_name(f"{source.name}-wal")
        if source.suffix == ".db3" and log.exists() and log.stat().st_size:
            path = self._folder / source.name
            shutil.copy(source, path)
            shutil.copy(log, path.with_name(f"{path.name}-wal"))
            with closing(sqlite3.connect(path)) as database:
                database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        return path


def _find_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    patterns = ("*.mcap", "*.db3", f"*.mcap{PACKED}", f"*.db3{PACKED}")
    files = [file for pattern in patterns for file in path.glob(pattern)]
    if not files:
        raise ConfigError(f"{path}: holds no ROS 2 bag: no .mcap or .db3")
    return sorted(files, key=_find_number)


def _find_number(file: Path) -> int:
    """The number at the end of a name such as "bag_10.mcap.zstd"."""
    stem = Path(file.name.removesuffix(PACKED)).stem
    return int((re.findall(r"\d+$", stem) or ["0"])[0])


def unpack(data: bytes) -> bytes:
    """Unpack a message that is compressed by itself; ConfigError if it is too long."""
    if not data.startswith(ZSTD_MAGIC):
        return data
    unpacked = io.BytesIO()
    _unpack_file(io.BytesIO(data), unpacked)
    return unpacked.getvalue()


def _unpack_file(packed: IO[bytes], file: IO[bytes]) -> None:
    with require_extra("reading a ROS 2 bag", "record"):
        import zstandard  # noqa: PLC0415 - optional

    size = packed.seek(0, io.SEEK_END)
    packed.seek(0)
    try:
        with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            while data := stream.read(COPIED_BYTES):
                file.write(data)
                if file.tell() > FREE_UNPACKED + MAX_RATIO * size:
                    raise ConfigError("isn't read: it unpacks to more than a bag holds")
    except zstandard.ZstdError as error:
        raise ConfigError(f"can't be unpacked: {explain_error(error)}") from error


def _read_mcap(path: Path, report: Callable[[str], None]) -> Iterator[BagMessage]:
    """Read an MCAP file up to where it is cut or damaged."""
    schemas: dict[int, str] = {}
    channels: dict[int, Any] = {}
    for record in _read_records(path, report):
        kind = type(record).__name__
        if kind == "Schema":
            schemas[record.id] = record.name
        elif kind == "Channel" and record.message_encoding == "cdr":
            channels[record.id] = record
        elif kind == "Message" and record.channel_id in channels:
            channel = channels[record.channel_id]
            name = schemas.get(channel.schema_id, "")
            yield BagMessage(channel.topic, name, record.log_time, record.data)


def _read_records(path: Path, report: Callable[[str], None]) -> Iterator[Any]:
    """Yield the records of an MCAP file and of its chunks."""
    with require_extra("reading a ROS 2 bag", "record"):
        from mcap.exceptions import McapError  # noqa: PLC0415 - optional
        from mcap.stream_reader import StreamReader  # noqa: PLC0415 - optional

    unpacked = 0
    with open_file(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ConfigError("isn't a ROS 2 bag: not an MCAP file")
        stream = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=MAX_BLOCK)
        place = file.tell()
        try:
            for record in stream.records:
                place = file.tell()
                entries = _open_chunk(record, report)
                unpacked += sum(len(getattr(entry, "data", b"")) for entry in entries)
                if unpacked > FREE_UNPACKED + MAX_RATIO * place:
                    raise ConfigError("isn't read: it unpacks to more than a bag holds")
                yield from entries
        except (McapError, UnicodeDecodeError, struct.error):
            if has_end(file):
                report(f"is damaged: left out all from byte {place:,} on; see mcap recover")
            else:
                report("the file is cut: what followed is missing")


def _open_chunk(record: Any, report: Callable[[str], None]) -> Sequence[Any]:
    """Return the records of a chunk, or a record that is no chunk."""
    import zstandard  # noqa: PLC0415 - optional
    from lz4 import frame  # noqa: PLC0415 - optional
    from mcap.records import Chunk  # noqa: PLC0415 - optional
    from mcap.stream_reader import breakup_chunk  # noqa: PLC0415 - optional

    if not isinstance(record, Chunk):
        return [record]
    data = record.data
    limit = min(record.uncompressed_size, MAX_BLOCK) + 1
    with contextlib.suppress(RuntimeError, zstandard.ZstdError):
        if record.compression == "lz4":
            data = bytes(frame.LZ4FrameDecompressor().decompress(data, limit))
        elif record.compression == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(data) as stream:
                data = stream.read(limit)

    is_sound = record.uncompressed_crc in (0, zlib.crc32(data))
    if len(data) != record.uncompressed_size or not is_sound:
        report(f"is damaged: left out a chunk of {len(record.data):,} bytes; see mcap recover")
        return []
    return breakup_chunk(dataclasses.replace(record, compression="", data=data))


def _read_sqlite(path: Path, report: Callable[[str], None]) -> Iterator[BagMessage]:
    with open_file(path):  # only regular files
        pass
    query = (
        "SELECT topics.name, topics.type, messages.timestamp, messages.data FROM messages "
        "JOIN topics ON messages.topic_id = topics.id "
        "WHERE topics.serialization_format = 'cdr' ORDER BY messages.timestamp"
    )
    try:
        address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as database:
            for topic, kind, time, data in database.execute(query):
                yield BagMessage(str(topic), str(kind), int(time), bytes(data))
    except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: isn't a ROS 2 bag: {explain_error(error)}") from error
