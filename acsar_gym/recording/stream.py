"""The records of an MCAP file one after the other, whatever the file holds.

The library mcap parses them. Its own stream reader ends at the first damaged byte, believes every
length that a record tells, and unpacks a chunk to whatever size it has.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections import Counter
from collections.abc import Container, Iterator
from typing import IO, Any

from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.recording.messages import MCAP_MAGIC

MAX_RECORD = 2**26 - 1  # longest accepted record, and chunk once it is unpacked [bytes]
MAX_RATIO = 32  # most unpacked bytes for each byte of the file; a robot that stands has 10
FREE_UNPACKED = 8_000_000  # bytes that may be unpacked from however few
MAX_DAMAGES = 100  # most damaged places of a file that is read all the same
SEARCH_BLOCK = 1 << 20  # bytes that are searched at once for the next record

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
METADATA, DATA_END = 12, 15
DATA_OPCODES = {*range(HEADER, MESSAGE_INDEX + 1), 9, METADATA, DATA_END} - {FOOTER}  # 9: files
SUMMARY_OPCODES = {FOOTER, 8, 10, 11, 13, 14}  # of an index, besides schemas and channels
PARSED_KINDS = {
    HEADER: "Header",
    SCHEMA: "Schema",
    CHANNEL: "Channel",
    METADATA: "Metadata",
}
MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, and two times [ns] of a message
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # two times, unpacked size, checksum, length of the packer's name
_FOOTER_SIZE = _RECORD.size + 20 + len(MCAP_MAGIC)
# The beginning of a record of MAX_RECORD bytes at most.
_PLAUSIBLE = re.compile(rb"[\x03-\x07\x09\x0c\x0f](?=.{3}[\x00-\x03]\x00{4})", re.DOTALL)


class FileCut(Exception):  # noqa: N818 - not an error
    """The file ends in the middle of a record, or before its last one.

    Attributes: `damaged`, whether what is there isn't the beginning of a record.
    """

    def __init__(self, *, damaged: bool = False) -> None:
        super().__init__()
        self.damaged = damaged


class RecordStream:
    """The records of a file, chunks unpacked. What is damaged is left out.

    Attributes: `place`, where the next record of the file begins, and `at`, that of the newest one
    [bytes]; `index`, number of the newest message in its chunk; `counts`, messages by channel,
    wanted or not; `damages`, a line for each place that was left out.

    Raises:
        ConfigError: it is another file.
    """

    def __init__(self, file: IO[bytes], wanted: Container[int] | None = None) -> None:
        self.place = self.at = len(MCAP_MAGIC)
        self.index = 0
        self.counts: Counter[int] = Counter()
        self.damages: list[str] = []
        self._file, self._wanted = file, wanted
        self._packed = self._unpacked = 0
        self._has_channels = False
        magic = self._read_at(0, len(MCAP_MAGIC))
        if magic != MCAP_MAGIC:
            head = self._read_at(self.place, _RECORD.size)
            if not (head[:1] == bytes([HEADER]) and self._is_record(self.place)):
                raise ConfigError("isn't a recording: not an MCAP file")
            self._note("its first bytes")

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Yield opcode and content of every record from `place` to the end of the data.

        Where the chunk with the channels is damaged, those at the end of the file take their place.
        FileCut where the end is missing; ConfigError for too many damaged places.
        """
        while True:
            opcode, content = self._read_record()
            if opcode == DATA_END:
                self.place = self.at  # it is read again where the index isn't written yet
                break
            if self.damages and not self._has_channels:
                yield from self._read_summary()
                self._has_channels = True
            yield from self._open_record(opcode, content)
        if not self._has_end():
            raise FileCut

    def read_again(self, place: int) -> Iterator[tuple[int, bytes]]:
        """Yield the records of the chunk at a place, or the one record that is there."""
        self.place, self._packed, self._unpacked = place, 0, 0
        yield from self._open_record(*self._read_record())

    def _has_end(self) -> bool:
        size = self._file.seek(0, io.SEEK_END)
        return self._read_at(size - len(MCAP_MAGIC), len(MCAP_MAGIC)) == MCAP_MAGIC

    def _read_record(self) -> tuple[int, bytes]:
        """Read the next record that is whole."""
        while True:
            self.at = at = self.place
            head = self._read_at(at, _RECORD.size)
            if len(head) < _RECORD.size or not any(head):  # zeros, as a loss of power leaves them
                raise FileCut
            opcode, length = _RECORD.unpack(head)
            plausible = opcode in DATA_OPCODES and length <= MAX_RECORD
            if plausible:
                content = self._file.read(length)
                if len(content) == length and is_consistent(opcode, content):
                    self.place = at + _RECORD.size + length
                    self._packed += length
                    return opcode, content
            following = self._find_record(at + 1)
            if following is None and self._has_end():  # only the end of the data is damaged
                self._note(f"the index from byte {at:,} on")
                return DATA_END, b""
            if following is None:
                raise FileCut(damaged=not plausible)
            self._note(f"{following - at:,} bytes from byte {at:,} on")
            self.place = following

    def _open_record(self, opcode: int, content: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield a record of the file, or those of a chunk; none where that is damaged."""
        self.index = 0
        if opcode != CHUNK:
            if opcode == MESSAGE:
                self.counts[content[0] | content[1] << 8] += 1
            yield opcode, content
            return
        unpacked = self._unpack(content)
        if unpacked is None:
            self._note(f"a chunk of {len(content):,} bytes at byte {self.at:,}")
            return
        wanted, counts = self._wanted, self.counts
        place, end, unpack, head = 0, len(unpacked) - _RECORD.size, _RECORD.unpack_from, 9
        while place <= end:
            opcode, length = unpack(unpacked, place)
            first = place + head
            place = first + length
            if opcode == MESSAGE:
                if length < MESSAGE_HEAD.size or place > len(unpacked):
                    raise ConfigError("is damaged: a broken message")
                self.index += 1
                channel = unpacked[first] | unpacked[first + 1] << 8
                counts[channel] += 1
                if wanted is not None and channel not in wanted:
                    continue
            if place > len(unpacked):
                raise ConfigError("is damaged: a broken record in a chunk")
            if opcode in (MESSAGE, CHANNEL, SCHEMA):
                self._has_channels = self._has_channels or opcode == CHANNEL
                yield opcode, unpacked[first:place]

    def _unpack(self, content: bytes) -> bytes | None:
        """Unpack a chunk; None where it isn't what it says, or more than a recording has."""
        _, _, size, checksum, name_length = _CHUNK.unpack_from(content)
        kind = content[_CHUNK.size : _CHUNK.size + name_length]
        most = FREE_UNPACKED + MAX_RATIO * self._packed - self._unpacked
        if size > min(MAX_RECORD, most):
            return None
        data = unpack_bytes(kind, content[_CHUNK.size + name_length + 8 :], size)
        if data is None or len(data) != size or (checksum and zlib.crc32(data) != checksum):
            return None
        self._unpacked += size
        return data

    def _read_summary(self) -> Iterator[tuple[int, bytes]]:
        """Yield the schemas and channels at the end of a whole file."""
        size = self._file.seek(0, io.SEEK_END)
        footer = self._read_at(max(size - _FOOTER_SIZE, 0), _FOOTER_SIZE)
        if len(footer) < _FOOTER_SIZE or footer[0] != FOOTER or not footer.endswith(MCAP_MAGIC):
            return
        place = int.from_bytes(footer[9:17], "little")
        while 0 < place < size and self._is_record(place):
            opcode, length = _RECORD.unpack(self._read_at(place, _RECORD.size))
            if opcode not in PARSED_KINDS:
                return
            yield opcode, self._file.read(length)
            place += _RECORD.size + length

    def _find_record(self, place: int) -> int | None:
        """Find where the next record begins that is followed by another one."""
        while len(block := self._read_at(place, SEARCH_BLOCK)) >= _RECORD.size:
            for match in _PLAUSIBLE.finditer(block):
                if self._is_record(place + match.start()):
                    return place + match.start()
            place += max(len(block) - _RECORD.size + 1, 1)
        return None

    def _is_record(self, place: int) -> bool:
        """Whether there is a record, and another one or the end of the file behind it."""
        opcode, length = _RECORD.unpack(self._read_at(place, _RECORD.size))
        if length > MAX_RECORD:
            return False
        content = self._file.read(length)
        if len(content) < length or not is_consistent(opcode, content):
            return False
        head = self._file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return not head
        return head[0] in DATA_OPCODES | SUMMARY_OPCODES and _RECORD.unpack(head)[1] <= MAX_RECORD

    def _note(self, damage: str) -> None:
        self.damages.append(damage)
        if len(self.damages) > MAX_DAMAGES:
            raise ConfigError(f"is damaged in more than {MAX_DAMAGES} places")

    def _read_at(self, place: int, size: int) -> bytes:
        self._file.seek(place)
        return self._file.read(size)


def is_consistent(opcode: int, content: bytes) -> bool:
    """Whether the lengths inside a record add up to its own."""
    length = len(content)
    if opcode == CHUNK:
        name_length = int.from_bytes(content[_CHUNK.size - 4 : _CHUNK.size], "little")
        first = _CHUNK.size + name_length
        data = int.from_bytes(content[first : first + 8], "little")
        return length >= _CHUNK.size + 8 and first + 8 + data == length
    if opcode == MESSAGE_INDEX:
        return length >= 6 and 6 + int.from_bytes(content[2:6], "little") == length
    if opcode == MESSAGE:
        return length >= MESSAGE_HEAD.size
    if opcode in PARSED_KINDS:
        try:
            parse_record(PARSED_KINDS[opcode], content)
        except ConfigError:
            return False
    return opcode != DATA_END or length == 4


def parse_record(kind: str, content: bytes) -> Any:
    """Parse a record of a kind such as "Channel", as mcap has it; ConfigError for a broken one."""
    with require_extra("reading a recording", "record"):
        from mcap import records  # noqa: PLC0415 - optional
        from mcap.data_stream import ReadDataStream  # noqa: PLC0415 - optional
        from mcap.exceptions import McapError  # noqa: PLC0415 - optional
    stream = ReadDataStream(io.BytesIO(content))
    try:
        record = getattr(records, kind).read(stream)
    except (McapError, struct.error, UnicodeDecodeError) as error:
        raise ConfigError(f"is damaged: broken {kind.lower()}") from error
    if stream.count != len(content):
        raise ConfigError(f"is damaged: broken {kind.lower()}")
    return record


def unpack_bytes(kind: bytes, data: bytes, size: int) -> bytes | None:
    """Decompress a chunk, but no more than one byte beyond `size`; None where it is damaged."""
    if not kind:
        return data
    with require_extra("reading a recording", "record"):
        import zstandard  # noqa: PLC0415 - optional
        from lz4 import frame  # noqa: PLC0415 - optional
    try:
        if kind == b"lz4":
            return bytes(frame.LZ4FrameDecompressor().decompress(data, size + 1))
        if kind == b"zstd":
            with zstandard.ZstdDecompressor().stream_reader(data) as stream:
                return bytes(stream.read(size + 1))
    except Exception:  # noqa: BLE001 - each library has its own
        return None
    return None
