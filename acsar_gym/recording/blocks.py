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
from itertools import accumulate
from typing import IO, Annotated, Any, NamedTuple

import numpy as np
from pydantic import ConfigDict, Field

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.lidar.scan import MAX_STAMP
from acsar_gym.reading import parse_json
from acsar_gym.recording.events import TABLES, Table

MAGIC = b"\x89MCAP0\r\n"  # the first and last bytes of an MCAP file
NAME = "acsar_gym"
MEDIA_TYPE = "application/x-acsar-gym-block"
FORMAT = 2

MAX_BLOCK = 2**26  # longest accepted block, packed or not [bytes]
MAX_RATIO = 100  # most unpacked bytes for each byte of the file (a robot at rest has 30)
FREE_UNPACKED = 2**26  # bytes that may be unpacked from a file of any size
MAX_DAMAGES = 100  # most damaged places of a file that is read
MAX_OFFSET = 2**62  # largest offset of an episode, either sign [ns] (its times then fit 64 bits)
IDENTIFYING_BYTES = 5_000_000  # a recording of this package has its first block within these
SEARCH_BYTES = 2**16  # bytes that are searched at once for the next block

MARKER = b"".join(struct.pack("<I", len(text)) + text.encode() for text in (NAME, MEDIA_TYPE))
RECORD_START = struct.Struct("<BQQQ")  # opcode, length, and two times of an attachment [ns]
HEAD_START = RECORD_START.size + len(MARKER) + 8  # place of the head's line in its record
LENGTH_START = 9  # a record's length counts the bytes from here on
ATTACHMENT = 9  # opcode
CHECKSUM = struct.Struct("<I")
DATA_END = struct.pack("<BQI", 15, 4, 0)

Bounded = Annotated[int, Field(ge=0, le=MAX_OFFSET)]


class Header(Section):
    """What a header must have. It may have more."""

    model_config = ConfigDict(extra="allow", strict=True)
    format: int
    config: dict[str, Any]
    config_sha256: str
    versions: dict[str, Any]
    created: dict[str, Any]
    about: dict[str, Any]


class Head(Section):
    """The line of JSON of a block."""

    model_config = ConfigDict(extra="ignore", strict=True)
    checksum: int = Field(default=0, alias="before")
    """CRC-32 of the bytes of the file since the block before."""
    episode: int = -1
    """Number of the episode. -1 for the first and last block of a file."""
    start: Annotated[float, Field(ge=-MAX_STAMP, le=MAX_STAMP)] = 0.0
    offset: Annotated[int, Field(ge=-MAX_OFFSET, le=MAX_OFFSET)] = 0
    info: dict[str, Any] = Field(default_factory=dict)
    periods: tuple[int, int] | None = Field(default=None, strict=False)
    """First and last exchange."""
    outcome: tuple[bool, bool, bool] | None = Field(default=None, strict=False)
    """Whether the newest step terminated and truncated the episode, and succeeded."""
    tables: dict[str, list[Bounded]] = Field(default_factory=dict)
    """Shape of each table, and its length in the block [bytes]."""
    header: Header | None = None
    dropped: Bounded | None = None
    """In the last block: how many events were dropped."""


class Block(NamedTuple):
    """A block as it was read."""

    place: int
    """Where its record is in the file."""
    head: Head
    data: bytes
    """Its tables, packed."""


def pack_block(head: Mapping[str, Any], tables: Mapping[str, Table]) -> bytes:
    """Return the content of a block."""
    with require_extra("recording", "record"):
        import zstandard  # noqa: PLC0415 - optional

    compress = zstandard.ZstdCompressor().compress
    packed = {name: compress(table.tobytes()) for name, table in tables.items()}
    sizes = {name: [*table.shape, len(packed[name])] for name, table in tables.items()}
    line = json.dumps({**head, "tables": sizes}) + "\n"
    return line.encode() + b"".join(packed.values())


def unpack_table(block: Block, name: str) -> Table:
    """Return a table of a block. Raises ConfigError if it isn't what the block declares."""
    with require_extra("reading a recording", "record"):
        import zstandard  # noqa: PLC0415 - optional

    *shape, size = block.head.tables[name]
    sizes = accumulate(sizes[-1] for sizes in block.head.tables.values())
    end = dict(zip(block.head.tables, sizes, strict=True))[name]
    packed = block.data[end - size : end]
    try:
        # A frame states how long its content is. The decompressor believes it.
        if zstandard.frame_content_size(packed) != math.prod(shape) * TABLES[name].itemsize:
            raise ConfigError(f"is damaged: a table of another size than declared: {name}")
        data = zstandard.ZstdDecompressor().decompress(packed)
    except zstandard.ZstdError as error:
        raise ConfigError(f"is damaged: a table that can't be unpacked: {name}") from error
    return np.frombuffer(data, TABLES[name]).reshape(shape)


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
        # What can't be read may only look like a block, so the search goes on inside it.
        following = place + 1
        if block is not None:
            following = file.tell()
            if _compute_checksum(file, end, place) != block.head.checksum:
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
    """Return where the next record begins that may be a block. -1 if there is none."""
    place += RECORD_START.size
    while place < limit:
        file.seek(place)
        data = file.read(SEARCH_BYTES)
        offset = data.find(MARKER)
        if offset >= 0:
            return place + offset - RECORD_START.size
        if len(data) < SEARCH_BYTES:
            break
        # A marker may lie across the end of a piece, so pieces overlap.
        place += SEARCH_BYTES - len(MARKER) + 1
    return -1


def read_block(file: IO[bytes], place: int) -> Block | None:
    """Read the block at a place. None if it is damaged, cut, or something else."""
    file.seek(place)
    start = file.read(HEAD_START)
    if len(start) < HEAD_START:
        return None
    opcode, length, *_ = RECORD_START.unpack(start[: RECORD_START.size])
    remaining = length + LENGTH_START - HEAD_START
    # With a damaged length the next read could fill the memory.
    if opcode != ATTACHMENT or not CHECKSUM.size <= remaining <= MAX_BLOCK:
        return None
    content = file.read(remaining)
    # MCAP's checksum leaves out the opcode and the length of the record.
    checksum = zlib.crc32(content[: -CHECKSUM.size], zlib.crc32(start[LENGTH_START:]))
    if len(content) < remaining or content[-CHECKSUM.size :] != CHECKSUM.pack(checksum):
        return None
    line, _, data = content[: -CHECKSUM.size].partition(b"\n")
    try:
        head = Head.model_validate(parse_json(line.decode("ascii", "replace")))
    except ConfigError as error:
        raise ConfigError(f"is damaged: {error}") from error

    return Block(place, head, data)


def _count_bytes(block: Block) -> int:
    """Return the size of a block's tables. Raises ConfigError for an unknown table."""
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
    file.seek(begin)
    is_sound = file.read(len(DATA_END)) == DATA_END
    end = file.seek(0, io.SEEK_END) - len(MAGIC) - CHECKSUM.size
    checksum = _compute_checksum(file, begin + len(DATA_END), end)
    return is_sound and file.read(CHECKSUM.size) == CHECKSUM.pack(checksum)
