"""The blocks of a recording: attachments of an MCAP file, which hold the exact data.

A block holds the tables of about half a second of one episode: a line of JSON, then each table,
compressed. The line repeats how the episode began, so that a block can be read without others. The
attachment has a checksum. The line has a second checksum, of all bytes of the file since the block
before: those are the messages for other programs.

The first and the last block hold the header of the recording.
"""

from __future__ import annotations

import io
import json
import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from typing import IO, Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.lidar.scan import MAX_STAMP
from acsar_gym.reading import parse_json
from acsar_gym.recording.events import TABLES, Tables

MAGIC = b"\x89MCAP0\r\n"  # the first and last bytes of an MCAP file
NAME = "acsar_gym"
MEDIA_TYPE = "application/x-acsar-gym-block"
FORMAT = 2

MAX_BLOCK = 2**26  # longest accepted block, packed or not [bytes]
MAX_RATIO = 100  # most unpacked bytes for each byte of the file; a robot at rest has 30
FREE_UNPACKED = 2**26  # bytes that may be unpacked from a file of any size
MAX_DAMAGES = 100  # most damaged places of a file that is read
MAX_OFFSET = 2**62  # largest offset of an episode, either sign [ns]; its times then fit 64 bits
SEARCH_BYTES = 2**16  # bytes that are searched at once for the next block

ATTACHMENT = 9  # opcode
MARKER = b"".join(struct.pack("<I", len(text)) + text.encode() for text in (NAME, MEDIA_TYPE))
_RECORD = struct.Struct("<BQ")  # opcode and length
_TIMES = struct.Struct("<QQ")  # of an attachment [ns]
_SIZE = struct.Struct("<Q")
_CHECKSUM = struct.Struct("<I")
_DATA_END = _RECORD.pack(15, 4) + bytes(4)
_HEAD_SIZE = _RECORD.size + _TIMES.size

Bounded = Annotated[int, Field(ge=0, le=MAX_OFFSET)]


class Header(Section):
    """What a header must have."""

    model_config = ConfigDict(extra="ignore", strict=True)
    format: int
    config: dict[str, Any]
    config_sha256: str
    versions: dict[str, Any]
    created: dict[str, Any]
    about: dict[str, Any]


class Head(Section):
    """The line of JSON of a block."""

    model_config = ConfigDict(extra="ignore", strict=True)
    before: int
    """Checksum of the bytes of the file since the block before."""
    episode: int = -1
    """Number of the episode; -1 for the first and last block of a file."""
    start: Annotated[float, Field(ge=-MAX_STAMP, le=MAX_STAMP)] = 0.0
    offset: Annotated[int, Field(ge=-MAX_OFFSET, le=MAX_OFFSET)] = 0
    info: dict[str, Any] = Field(default_factory=dict)
    periods: tuple[int, int] | None = Field(default=None, strict=False)
    """First and last exchange."""
    outcome: tuple[bool, bool, bool] | None = Field(default=None, strict=False)
    """Whether the newest step terminated and truncated the episode, and succeeded."""
    tables: dict[str, list[Bounded]] = Field(default_factory=dict)
    """Shape of each table, and its length in the block [bytes]."""
    header: dict[str, Any] | None = None
    dropped: Bounded | None = None
    """In the last block: how many events were dropped."""


class Block(NamedTuple):
    """A block as it was read."""

    place: int
    """Where its record is in the file."""
    head: Head
    data: bytes
    """Its tables, packed."""


def pack_block(head: Mapping[str, Any], tables: Tables) -> bytes:
    """Return the content of a block."""
    with require_extra("recording", "record"):
        import zstandard  # noqa: PLC0415 - optional

    compress = zstandard.ZstdCompressor().compress
    packed = {name: compress(table.tobytes()) for name, table in tables.items()}
    sizes = {name: [*table.shape, len(packed[name])] for name, table in tables.items()}
    line = json.dumps({**head, "tables": sizes}) + "\n"
    return line.encode() + b"".join(packed.values())


def unpack_table(block: Block, name: str) -> NDArray[Any]:
    """Return a table of a block; ConfigError if it isn't what the block declares."""
    with require_extra("reading a recording", "record"):
        import zstandard  # noqa: PLC0415 - optional

    sizes = block.head.tables
    *shape, size = sizes[name]
    names = list(sizes)
    first = sum(sizes[earlier][-1] for earlier in names[: names.index(name)])
    packed = block.data[first : first + size]
    kind = TABLES[name]
    try:
        # A frame states how long its content is. The decompressor believes it.
        if zstandard.frame_content_size(packed) != math.prod(shape) * kind.itemsize:
            raise ConfigError(f"is damaged: a table of another size than declared: {name}")
        data = zstandard.ZstdDecompressor().decompress(packed)
    except zstandard.ZstdError as error:
        raise ConfigError(f"is damaged: a table that can't be unpacked: {name}") from error
    return np.frombuffer(data, kind).reshape(shape)


def iterate_blocks(file: IO[bytes], damages: list[str]) -> Iterator[Block]:
    """Yield the blocks of a recording, up to its end or to where it is cut.

    Args:
        file: The file, which may also be read between blocks.
        damages: Gets a line for each damaged place, which is left out.

    Raises:
        ConfigError: The file has too many damaged places.
    """
    end = unpacked = 0
    place = find_block(file, 0)
    while place >= 0:
        block = read_block(file, place)
        following = place + 1
        if block is not None:
            following = file.tell()
            if _compute_checksum(file, end, place) != block.head.before:
                damages.append(f"{place - end:,} bytes from byte {end:,} on")
            end = following
            unpacked += _count_bytes(block)
            if unpacked > FREE_UNPACKED + MAX_RATIO * following:
                raise ConfigError("is no recording: it unpacks to more than a recording holds")
            yield block
            if block.head.dropped is not None:
                if has_end(file) and not _has_sound_index(file, end):
                    damages.append(f"the index from byte {end:,} on")
                return
        if len(damages) > MAX_DAMAGES:
            raise ConfigError(f"is damaged in more than {MAX_DAMAGES} places: try mcap recover")
        place = find_block(file, following)

    if end and has_end(file):  # the file is whole, but not its last block
        damages.append(f"all from byte {end:,} on")


def has_end(file: IO[bytes]) -> bool:
    """Whether a file ends as an MCAP file."""
    size = file.seek(0, io.SEEK_END)
    file.seek(max(size - len(MAGIC), 0))
    return file.read() == MAGIC


def find_block(file: IO[bytes], place: int, limit: float = math.inf) -> int:
    """Return where the next record begins that may be a block; -1 if there is none."""
    place += _HEAD_SIZE
    while place < limit:
        file.seek(place)
        data = file.read(SEARCH_BYTES)
        offset = data.find(MARKER)
        if offset >= 0:
            return place + offset - _HEAD_SIZE
        if len(data) < SEARCH_BYTES:
            break
        place += SEARCH_BYTES - len(MARKER) + 1
    return -1


def read_block(file: IO[bytes], place: int) -> Block | None:
    """Read the block at a place; None if it is damaged, cut, or something else."""
    file.seek(place)
    record = file.read(_RECORD.size)
    if len(record) < _RECORD.size:
        return None
    opcode, length = _RECORD.unpack(record)
    shortest = _TIMES.size + len(MARKER) + _SIZE.size + _CHECKSUM.size
    if opcode != ATTACHMENT or not shortest <= length <= MAX_BLOCK:
        return None

    content = file.read(length)
    checksum = _CHECKSUM.unpack(content[-_CHECKSUM.size :])[0] if len(content) == length else None
    if checksum != zlib.crc32(content[: -_CHECKSUM.size]):
        return None
    head_size = shortest - _CHECKSUM.size
    line, _, data = content[head_size : -_CHECKSUM.size].partition(b"\n")
    return Block(place, parse_section(Head, parse_json(line.decode("ascii", "replace"))), data)


def parse_section(kind: type[Head | Header], mapping: Any) -> Any:
    """Parse what JSON holds; ConfigError if a field is missing or wrong."""
    if not isinstance(mapping, dict):
        raise ConfigError("is damaged: the beginning of a block is no mapping")
    try:
        return kind.model_validate(mapping)
    except ConfigError as error:
        raise ConfigError(f"is damaged: {error}") from error


def _count_bytes(block: Block) -> int:
    """Return the size of a block's tables; ConfigError for an unknown or impossible table."""
    count = 0
    for name, (*shape, _) in block.head.tables.items():
        if name not in TABLES or not shape:
            raise ConfigError(f"is damaged: an unknown table: {name[:20]!r}")
        count += math.prod(shape) * TABLES[name].itemsize
    return count


def _compute_checksum(file: IO[bytes], begin: int, end: int) -> int:
    """Return the CRC-32 of a part of a file, which is read piece by piece."""
    checksum = 0
    file.seek(begin)
    for place in range(begin, end, SEARCH_BYTES):
        checksum = zlib.crc32(file.read(min(end - place, SEARCH_BYTES)), checksum)
    return checksum


def _has_sound_index(file: IO[bytes], begin: int) -> bool:
    """Whether the index that follows the last block is what was written."""
    end = file.seek(0, io.SEEK_END) - len(MAGIC) - _CHECKSUM.size
    if end - begin < len(_DATA_END):
        return False
    summary = _compute_checksum(file, begin + len(_DATA_END), end)
    checksum = file.read(_CHECKSUM.size)
    file.seek(begin)
    return file.read(len(_DATA_END)) == _DATA_END and checksum == _CHECKSUM.pack(summary)
