"""Reads the messages of ROS 2 bags: MCAP files, SQLite files (.db3), and folders of them.

Files are read one by one, by their suffix, with or without the metadata of their folder. So a bag
of a program that was killed is read as far as it goes. Everything that is unpacked has a limit.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import re
import shutil
import sqlite3
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import IO, Any, NamedTuple

from acsar_gym.errors import ConfigError, explain_error, require_extra
from acsar_gym.reading import open_file
from acsar_gym.recording.blocks import FREE_UNPACKED, MAGIC, MAX_BLOCK, MAX_RATIO, has_end

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
PIECE_BYTES = 1 << 20  # bytes that are unpacked at once
PACKED = ".zstd"  # suffix of a file that is packed as a whole
QUERY = (
    "SELECT topics.name, topics.type, messages.timestamp, messages.data FROM messages "
    "JOIN topics ON messages.topic_id = topics.id "
    "WHERE topics.serialization_format = 'cdr' ORDER BY messages.timestamp"
)


class BagMessage(NamedTuple):
    """One message of a bag."""

    topic: str
    kind: str
    """Type, such as "sensor_msgs/msg/JointState"."""
    time: int
    """When it was recorded [ns]."""
    data: bytes
    """In CDR."""


class BagFiles:
    """The files of a bag, in the order in which they were recorded.

    Args:
        path: A file, or a folder of rosbag2.
        folder: Folder for files that have to be unpacked before they can be read.

    Attributes:
        problems: What can't be read, a line each, in the order in which it was noticed.

    Raises:
        ConfigError: It is no bag, or a file can't be unpacked.
    """

    def __init__(self, path: Path, folder: Path) -> None:
        self.problems: dict[str, None] = {}
        self._sources = _find_files(path)
        self._paths = [_prepare(source, folder) for source in self._sources]

    def compute_hash(self) -> str:
        """Return the first 16 hex digits of a hash of all files."""
        digest = hashlib.sha256()
        for path in self._sources:
            with open_file(path) as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
        return digest.hexdigest()[:16]

    def read_messages(self) -> Iterator[BagMessage]:
        """Yield all messages. Raises ConfigError if a file can't be read."""
        for source, path in zip(self._sources, self._paths, strict=True):
            problems: list[str] = []
            is_database = path.suffix == ".db3"
            messages = _read_sqlite(path) if is_database else _read_mcap(path, problems)
            try:
                yield from map(_unpack_message, messages)
            except ConfigError as error:
                # The user knows the bag, not the copy of it that is read.
                problem = str(error).removeprefix(f"{path}: ")
                raise ConfigError(f"{source}: {problem}") from error
            self.problems |= dict.fromkeys(f"{source}: {problem}" for problem in problems)


def _find_files(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    suffixes = (".mcap", ".db3", f".mcap{PACKED}", f".db3{PACKED}")
    files = [file for file in path.iterdir() if file.name.endswith(suffixes)]
    if not files:
        raise ConfigError(f"{path}: holds no ROS 2 bag: no .mcap or .db3")

    def pad(file: Path) -> str:
        """The name with numbers of one length: "bag_10.mcap" follows "bag_9.mcap"."""
        return re.sub(r"\d+", lambda digits: digits[0].zfill(20), file.name)

    return sorted(files, key=pad)


def _prepare(source: Path, folder: Path) -> Path:
    """Return a file that can be read as it is: the source, or a copy of it in a folder."""
    log = source.with_name(f"{source.name}-wal")
    if source.suffix == PACKED:
        with open_file(source) as packed, (folder / source.stem).open("wb") as file:
            file.writelines(unpack(packed, FREE_UNPACKED + MAX_RATIO * source.stat().st_size))
        return folder / source.stem

    # What SQLite wrote last is in a second file, which only a writer can merge.
    if source.suffix == ".db3" and log.exists():
        try:
            for path in (source, log):
                shutil.copy(path, folder / path.name)
            with closing(sqlite3.connect(folder / source.name)) as database:
                database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        except (OSError, sqlite3.Error) as error:
            raise ConfigError(f"{source}: can't be read: {explain_error(error)}") from error
        return folder / source.name
    return source


def unpack(packed: IO[bytes], limit: int) -> Iterator[bytes]:
    """Yield what was packed by zstd, piece by piece. Raises ConfigError beyond a limit [bytes]."""
    with require_extra("reading a ROS 2 bag", "record"):
        import zstandard  # noqa: PLC0415 - optional

    try:
        with zstandard.ZstdDecompressor().stream_reader(packed) as stream:
            while piece := stream.read(PIECE_BYTES):
                limit -= len(piece)
                if limit < 0:
                    raise ConfigError("isn't read: it unpacks to more than a bag holds")
                yield piece
    except zstandard.ZstdError as error:
        raise ConfigError(f"can't be unpacked: {explain_error(error)}") from error


def _unpack_message(message: BagMessage) -> BagMessage:
    """Return a message, whose data may be packed by themselves, as they were before."""
    if not message.data.startswith(ZSTD_MAGIC):
        return message
    size = FREE_UNPACKED + MAX_RATIO * len(message.data)
    try:
        return message._replace(data=b"".join(unpack(io.BytesIO(message.data), size)))
    except ConfigError as error:
        raise ConfigError(f"{message.topic} {error}") from error


def _read_mcap(path: Path, problems: list[str]) -> Iterator[BagMessage]:
    """Read an MCAP file up to where it is cut or damaged."""
    with require_extra("reading a ROS 2 bag", "record"):
        from mcap.exceptions import McapError  # noqa: PLC0415 - optional
        from mcap.records import Channel, Message, Schema  # noqa: PLC0415 - optional
        from mcap.stream_reader import StreamReader  # noqa: PLC0415 - optional

    unpacked = 0
    kinds: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with open_file(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ConfigError("isn't a ROS 2 bag: not an MCAP file")
        stream = StreamReader(file, skip_magic=True, emit_chunks=True, record_size_limit=MAX_BLOCK)
        place = file.tell()
        try:
            for chunk in stream.records:
                place = file.tell()
                unpacked += getattr(chunk, "uncompressed_size", 0)
                if unpacked > FREE_UNPACKED + MAX_RATIO * place:
                    raise ConfigError("isn't read: it unpacks to more than a bag holds")
                for record in _open_chunk(chunk, problems):
                    if isinstance(record, Schema):
                        kinds[record.id] = record.name
                    elif isinstance(record, Channel) and record.message_encoding == "cdr":
                        channels[record.id] = (record.topic, kinds.get(record.schema_id, ""))
                    elif isinstance(record, Message) and record.channel_id in channels:
                        yield BagMessage(*channels[record.channel_id], record.log_time, record.data)
        # Lengths inside damaged records may be larger than the memory, or than any integer of C.
        except (McapError, UnicodeDecodeError, struct.error, MemoryError, OverflowError):
            problem = "the file is cut: what followed is missing"
            if has_end(file):
                problem = f"is damaged: left out all from byte {place:,} on; see mcap recover"
            problems.append(problem)


def _open_chunk(record: Any, problems: list[str]) -> Sequence[Any]:
    """Return the records of a chunk, or a record that is no chunk."""
    from lz4 import frame  # noqa: PLC0415 - optional
    from mcap.stream_reader import breakup_chunk  # noqa: PLC0415 - optional

    if type(record).__name__ != "Chunk":
        return [record]
    data = record.data
    size = record.uncompressed_size
    try:
        if record.compression == "lz4":
            data = bytes(frame.LZ4FrameDecompressor().decompress(data, size + 1))
        elif record.compression == "zstd":
            data = b"".join(unpack(io.BytesIO(data), size))
    except (RuntimeError, ConfigError):
        data = b""
    if len(data) != size or record.uncompressed_crc not in (0, zlib.crc32(data)):
        kept = f"left out a chunk of {len(record.data):,} bytes"
        problems.append(f"is damaged: {kept}; see mcap recover")
        return []
    return breakup_chunk(dataclasses.replace(record, compression="", data=data))


def _read_sqlite(path: Path) -> Iterator[BagMessage]:
    with open_file(path):  # only regular files
        pass
    try:
        address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as database:
            for topic, kind, time, data in database.execute(QUERY):
                yield BagMessage(str(topic), str(kind), int(time), bytes(data))
    except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: isn't a ROS 2 bag: {explain_error(error)}") from error
