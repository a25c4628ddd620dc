"""Reads the records of an MCAP file one after the other, in bounded time and memory.

The library mcap reads channels and metadata. Its stream reader could read the rest, too, but makes
objects of all messages of a chunk at once, wanted or not, and takes six times as long.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Container, Iterator
from typing import IO, Any

from acsar_gym.errors import ConfigError, MissingExtraError

MAGIC = b"\x89MCAP0\r\n"
CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 4, 5, 6, 12, 15
KNOWN = range(1, 16)
DESCRIPTIONS = CHANNEL, METADATA
READ = MESSAGE, *DESCRIPTIONS
"""What is read of a chunk."""
MOST_RECORD = 8_000_000
"""Longest accepted record, and chunk once it is unpacked [bytes]."""
MOST_UNPACKED = 2_000_000_000
"""Most bytes of all chunks once they are unpacked; two hours at 100 Hz."""
MOST_RATIO = 32
"""Most unpacked bytes for each byte of the file, beyond MOST_RECORD; a robot that stands has 10."""
MOST_DESCRIBED = 4_000_000
"""Most bytes of channels and metadata, which are slow to read; a recording's are 30,000."""
MOST_RECORDS = 4_500_000
"""Most records; an hour at 100 Hz has 4 million."""
TOO_MUCH = "holds too much: cut out a part of it"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")


class Cut(Exception):  # noqa: N818 - not an error
    """The file ends in the middle of a record, or before its last one."""


class Records:
    """The records of a file, chunks unpacked.

    Args:
        file: of an MCAP file.
        digest: is fed all bytes that are read.

    Attributes: `wanted`, the channels whose messages are of interest; None for all.
    """

    def __init__(self, file: IO[bytes], digest: Any) -> None:
        self._file = file
        self._digest = digest
        self.wanted: Container[int] | None = None
        self._packed = 0
        self._unpacked = 0
        self._described = 0
        self._count = 0
        if self._read(len(MAGIC)) != MAGIC:
            raise ConfigError("isn't a recording: not an MCAP file")

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Yield opcode and content of every record up to the end of the data.

        Raises:
            Cut: the file's end is missing.
            ConfigError: the file is damaged or too large.
        """
        while True:
            opcode, content = self._record()
            if opcode == CHUNK:
                yield from self._chunk(content)
            else:
                self._weigh(opcode, len(content))
                yield opcode, content
            if opcode == DATA_END:
                self._rest()
                return

    def _record(self) -> tuple[int, bytes]:
        """Read the next record."""
        head = self._whole(_RECORD.size)
        opcode, length = _RECORD.unpack(head)
        if not any(head):  # a computer that lost its power may leave zeros
            raise Cut
        if opcode not in KNOWN or length > MOST_RECORD:
            raise ConfigError("is damaged: a record of unknown kind or length")
        self._counted()
        return opcode, self._whole(length)

    def _chunk(self, content: bytes) -> Iterator[tuple[int, bytes]]:
        """Unpack a chunk."""
        try:
            _, _, size, crc, length = _CHUNK.unpack_from(content)
            kind = content[_CHUNK.size : _CHUNK.size + length].decode()
            data = content[_CHUNK.size + length + 8 :]
        except (struct.error, UnicodeDecodeError):
            raise ConfigError("is damaged: a broken chunk") from None
        self._packed += len(content)
        self._unpacked += size
        most = min(MOST_UNPACKED, MOST_RECORD + MOST_RATIO * self._packed)
        if size > MOST_RECORD or self._unpacked > most:
            raise ConfigError(TOO_MUCH)
        unpacked = _unpacked(kind, data, size)
        if len(unpacked) != size or (crc and zlib.crc32(unpacked) != crc):
            raise ConfigError("is damaged: a chunk with a wrong checksum")
        yield from self._inside(unpacked)

    def _inside(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield the records of a chunk."""
        place, end, unpack, head = 0, len(data) - _RECORD.size, _RECORD.unpack_from, _RECORD.size
        wanted = () if self.wanted is None else self.wanted
        most, before = MOST_RECORDS - self._count, 0
        while place <= end and before < most:
            opcode, length = unpack(data, place)
            first = place + head
            place = first + length
            before += 1
            is_one = opcode == MESSAGE and length > 1 and self.wanted is not None
            if is_one and data[first] | data[first + 1] << 8 not in wanted:
                continue
            if place > len(data) or opcode not in KNOWN:
                raise ConfigError("is damaged: a broken record in a chunk")
            if opcode in READ:
                self._weigh(opcode, length)
                yield opcode, data[first:place]
        self._counted(before)

    def _weigh(self, opcode: int, length: int) -> None:
        """Count the bytes of descriptions; ConfigError for too many."""
        if opcode in DESCRIPTIONS:
            self._described += _RECORD.size + length
            if self._described > MOST_DESCRIBED:
                raise ConfigError(TOO_MUCH)

    def _counted(self, records: int = 1) -> None:
        """Count records; ConfigError for too many."""
        self._count += records
        if self._count >= MOST_RECORDS:
            raise ConfigError(TOO_MUCH)

    def _rest(self) -> None:
        """Read what follows the data, an index; Cut where it isn't whole."""
        newest = b""
        while piece := self._read(1 << 20):
            newest = (newest + piece)[-len(MAGIC) :]
        if newest != MAGIC:
            raise Cut

    def _whole(self, size: int) -> bytes:
        data = self._read(size)
        if len(data) < size:
            raise Cut
        return data

    def _read(self, size: int) -> bytes:
        data = self._file.read(size)
        self._digest.update(data)
        return data


def _unpacked(kind: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk, but no more than `size` bytes."""
    if not kind:
        return data
    try:
        if kind == "zstd":
            import zstandard  # noqa: PLC0415 - optional

            with zstandard.ZstdDecompressor().stream_reader(data) as stream:
                return bytes(stream.read(size + 1))
        if kind == "lz4":
            from lz4 import frame  # noqa: PLC0415 - optional

            return bytes(frame.LZ4FrameDecompressor().decompress(data, size + 1))
    except ImportError:
        raise MissingExtraError("reading a recording", "record") from None
    except Exception as error:  # noqa: BLE001 - each library has its own
        raise ConfigError(f"is damaged: {error}") from None
    raise ConfigError(f"has chunks packed as {kind[:20]!r}, which isn't known")


def described(opcode: int, content: bytes) -> Any:
    """Parse the record of a channel or of metadata, as the library has it."""
    try:
        from mcap.data_stream import ReadDataStream  # noqa: PLC0415 - optional
        from mcap.exceptions import McapError  # noqa: PLC0415
        from mcap.records import Channel, Metadata  # noqa: PLC0415
    except ImportError:
        raise MissingExtraError("reading a recording", "record") from None
    kind = Channel if opcode == CHANNEL else Metadata
    try:
        return kind.read(ReadDataStream(io.BytesIO(content)))
    except (McapError, struct.error, UnicodeDecodeError):
        raise ConfigError(f"is damaged: broken {kind.__name__.lower()}") from None
