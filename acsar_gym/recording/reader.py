"""Reads recordings back, in bounded time and memory whatever the file holds.

The library mcap parses chunks, channels and metadata. Its stream reader could do the rest, too, but
makes objects of all messages of a chunk at once, wanted or not, takes six times as long, and
unpacks a chunk to whatever size it has.
"""

from __future__ import annotations

import hashlib
import io
import math
import struct
import zlib
from collections import Counter
from collections.abc import Container, Iterator, Sequence
from pathlib import Path
from typing import IO, Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from acsar_gym.config import RobotConfig
from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError, require_extra, shorten_text
from acsar_gym.reading import open_file, parse_json
from acsar_gym.recording import messages
from acsar_gym.recording.messages import (
    ARRAY_HEADER,
    DOUBLES_TYPE,
    END_RECORD,
    EXCHANGES,
    HEADER_RECORD,
    MCAP_MAGIC,
    RECORDING_FORMAT,
    REVOLUTIONS,
    SCANS,
    STEPS,
    TICKS,
    Topic,
)
from acsar_gym.recording.types import (
    MAX_DISTANCE,
    MAX_STAMP,
    Episode,
    Exchanges,
    Floats,
    Recording,
    Revolutions,
    Scans,
    WireLog,
)

MAX_FILE = 1_000_000_000
"""Largest accepted file [bytes]."""
MAX_KEPT = 300_000_000
"""Most bytes of a recording that are kept in memory."""
MESSAGE_COST = 100
"""What each message costs beside its content [bytes]; rows of tables cost nothing."""
MAX_EPISODES = 5_000
"""Most episodes; an empty one takes 7 kB of memory."""
MAX_OPENINGS = 10_000_000
"""Most bytes of what begins the episodes; of JSON, which takes 25 times the memory."""
MAX_RECORD = 8_000_000
"""Longest accepted record, and chunk once it is unpacked [bytes]."""
MAX_UNPACKED = 2_000_000_000
"""Most bytes of all chunks once they are unpacked; two hours at 100 Hz."""
MAX_RATIO = 32
"""Most unpacked bytes for each byte of the file, beyond MAX_RECORD; a robot that stands has 10."""
MAX_DESCRIBED = 4_000_000
"""Most bytes of channels and metadata, which are slow to read; a recording's are 30,000."""
MAX_RECORDS = 4_500_000
"""Most records; an hour at 100 Hz has 4 million."""
MAX_BEARING = 100.0
"""Largest bearing of a LiDAR's measurement, either sign [rad]."""
MAX_OFFSET = 2**62
"""Largest offset of an episode, either sign [ns]; times of the file then fit into 64 bits."""
TOO_MUCH = "holds too much: cut out a part of it"

CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 4, 5, 6, 12, 15
KNOWN_OPCODES = range(1, 16)
DESCRIPTIONS = CHANNEL, METADATA
_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
"""Encapsulation, no dimensions, no offset, number of elements."""

TABLE_TOPICS = EXCHANGES, TICKS, STEPS
LIST_TOPICS = (
    *(messages.WIRE_SENT, messages.WIRE_RECEIVED, SCANS, messages.OBSERVATION, messages.ACTION),
)
ELEMENT_SIZES = {DOUBLES_TYPE: 8, messages.SINGLES_TYPE: 4, messages.OCTETS_TYPE: 1}


class FileCut(Exception):  # noqa: N818 - not an error
    """The file ends in the middle of a record, or before its last one."""


class RecordingHeader(Section):
    """What a header must have besides its format."""

    model_config = ConfigDict(extra="ignore", strict=True)
    config: dict[str, Any]
    config_sha256: str
    versions: dict[str, Any]
    created: dict[str, Any]
    about: dict[str, Any]


class EpisodeOpening(Section):
    """What begins an episode."""

    model_config = ConfigDict(extra="ignore", strict=True)
    start: Annotated[float, Field(ge=-MAX_STAMP, le=MAX_STAMP)]
    offset: Annotated[int, Field(ge=-MAX_OFFSET, le=MAX_OFFSET)]
    info: dict[str, Any]


class RecordStream:
    """The records of a file, chunks unpacked.

    Args:
        file: an MCAP file, at its beginning.
        wanted: the channels whose messages are of interest; None for all.
        digest: is fed all bytes that are read; None for no digest.

    Raises:
        ConfigError: it is another file.
    """

    def __init__(
        self, file: IO[bytes], wanted: Container[int] | None = None, digest: Any = None
    ) -> None:
        self._file, self._wanted, self._digest = file, wanted, digest
        self._packed = self._unpacked = self._described = self._count = 0
        magic = self._read(len(MCAP_MAGIC))
        if magic.startswith(b"{"):
            raise ConfigError("is a recording of an older version, in JSON: record again")
        if magic != MCAP_MAGIC:
            raise ConfigError("isn't a recording: not an MCAP file")

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Yield opcode and content of every record up to the end of the data.

        Raises:
            FileCut: the file's end is missing.
            ConfigError: the file is damaged or too large.
        """
        opcode = 0
        while opcode != DATA_END:
            head = self._read(_RECORD.size)
            if len(head) < _RECORD.size or not any(head):  # zeros, as a loss of power leaves them
                raise FileCut
            opcode, length = _RECORD.unpack(head)
            if opcode not in KNOWN_OPCODES or length > MAX_RECORD:
                raise ConfigError("is damaged: a record of unknown kind or length")
            content = self._read(length)
            if len(content) < length:
                raise FileCut
            self._count_records(1)
            if opcode == CHUNK:
                yield from self._read_chunk(content)
            else:
                self._weigh(opcode, length)
                yield opcode, content
        newest = b""  # an index follows the data
        while piece := self._read(1 << 20):
            newest = (newest + piece)[-len(MCAP_MAGIC) :]
        if newest != MCAP_MAGIC:
            raise FileCut

    def _read_chunk(self, content: bytes) -> Iterator[tuple[int, bytes]]:
        """Unpack a chunk, and yield its records."""
        chunk = parse_record("Chunk", content)
        size = chunk.uncompressed_size
        self._packed += len(content)
        self._unpacked += size
        most = min(MAX_UNPACKED, MAX_RECORD + MAX_RATIO * self._packed)
        if size > MAX_RECORD or self._unpacked > most:
            raise ConfigError(TOO_MUCH)
        data = _unpack(chunk.compression, chunk.data, size)
        crc = chunk.uncompressed_crc
        if len(data) != size or (crc and zlib.crc32(data) != crc):
            raise ConfigError("is damaged: a chunk with a wrong checksum")
        place, end, unpack, head = 0, size - _RECORD.size, _RECORD.unpack_from, _RECORD.size
        most, before, wanted = MAX_RECORDS - self._count, 0, self._wanted
        while place <= end and before < most:
            opcode, length = unpack(data, place)
            first = place + head
            place = first + length
            before += 1
            if wanted is not None and opcode == MESSAGE and length > 1:
                channel = data[first] | data[first + 1] << 8
                if channel not in wanted:
                    continue
            if place > size or opcode not in KNOWN_OPCODES:
                raise ConfigError("is damaged: a broken record in a chunk")
            if opcode == MESSAGE or opcode in DESCRIPTIONS:
                self._weigh(opcode, length)
                yield opcode, data[first:place]
        self._count_records(before)

    def _weigh(self, opcode: int, length: int) -> None:
        """Count the bytes of descriptions; ConfigError for too many."""
        if opcode in DESCRIPTIONS:
            self._described += _RECORD.size + length
            if self._described > MAX_DESCRIBED:
                raise ConfigError(TOO_MUCH)

    def _count_records(self, records: int) -> None:
        self._count += records
        if self._count >= MAX_RECORDS:
            raise ConfigError(TOO_MUCH)

    def _read(self, size: int) -> bytes:
        data = self._file.read(size)
        if self._digest is not None:
            self._digest.update(data)
        return data


def parse_record(kind: str, content: bytes) -> Any:
    """Parse a record of a kind such as "Channel", as the library mcap has it."""
    with require_extra("reading a recording", "record"):
        from mcap import records  # noqa: PLC0415 - optional
        from mcap.data_stream import ReadDataStream  # noqa: PLC0415 - optional
        from mcap.exceptions import McapError  # noqa: PLC0415 - optional
    try:
        return getattr(records, kind).read(ReadDataStream(io.BytesIO(content)))
    except (McapError, struct.error, UnicodeDecodeError):
        raise ConfigError(f"is damaged: broken {kind.lower()}") from None


def _unpack(kind: str, data: bytes, size: int) -> bytes:
    """Decompress a chunk, but no more than `size` bytes."""
    if not kind:
        return data
    if kind not in ("zstd", "lz4"):
        raise ConfigError(f"has chunks packed as {kind[:20]!r}, which isn't known")
    with require_extra("reading a recording", "record"):
        import zstandard  # noqa: PLC0415 - optional
        from lz4 import frame  # noqa: PLC0415 - optional
    try:
        if kind == "lz4":
            return bytes(frame.LZ4FrameDecompressor().decompress(data, size + 1))
        with zstandard.ZstdDecompressor().stream_reader(data) as stream:
            return bytes(stream.read(size + 1))
    except Exception as error:  # noqa: BLE001 - each library has its own
        raise ConfigError(f"is damaged: {error}") from None


class EpisodeParts:
    """What was read of one episode so far.

    Attributes: `start` [s], `offset` [ns], `info`; `tables`, the rows of each table; `data` and
    `times` [ns], the content and the time of each message of the other topics.
    """

    def __init__(self, opening: EpisodeOpening) -> None:
        self.start, self.offset, self.info = opening.start, opening.offset, opening.info
        self.tables: dict[str, bytearray] = {topic.name: bytearray() for topic in TABLE_TOPICS}
        self.data: dict[str, list[bytes]] = {topic.name: [] for topic in LIST_TOPICS}
        self.times: dict[str, list[int]] = {topic.name: [] for topic in LIST_TOPICS}

    def add(self, topic: Topic, time: int, data: bytes) -> None:
        """Take a message; ConfigError for one that is damaged."""
        content = data
        if size := ELEMENT_SIZES.get(topic.kind):
            content = parse_array(data, size)
        if topic.name not in self.tables:
            self.data.setdefault(topic.name, []).append(content)
            self.times.setdefault(topic.name, []).append(time)
        elif len(content) == 8 * len(topic.columns):
            self.tables[topic.name] += content
        else:
            raise ConfigError(f"is damaged: a broken row of {topic.name}")

    def take_table(self, topic: Topic) -> Floats:
        """Return the rows of a table, and forget them."""
        data, self.tables[topic.name] = self.tables[topic.name], bytearray()
        rows = np.frombuffer(data, "<f8").reshape(-1, len(topic.columns))
        return rows.astype(np.float64, copy=False)

    def take_list(self, topic: Topic) -> tuple[list[int], list[bytes]]:
        """Return times [ns] and content of a topic's messages, and forget them."""
        return self.times.pop(topic.name, []), self.data.pop(topic.name, [])


def parse_array(data: bytes, size: int) -> bytes:
    """Return the elements of a MultiArray without dimensions; `size` is that of one element."""
    try:
        _, dimensions, _, count = ARRAY_HEADER.unpack_from(data)
    except struct.error:
        raise ConfigError("is damaged: a broken message") from None
    first = ARRAY_HEADER.size + (4 if size == 8 else 0)  # numbers of 8 bytes are aligned
    payload = data[first : first + count * size]
    if dimensions or len(payload) != count * size:
        raise ConfigError("is damaged: a broken array")
    return payload


def parse_mapping(text: str) -> dict[str, Any]:
    """Parse JSON that must be a mapping."""
    found = parse_json(text)
    if not isinstance(found, dict):
        raise ConfigError("is damaged: its header is no mapping")
    return found


Parsed = TypeVar("Parsed", bound=Section)


def parse_section(kind: type[Parsed], found: dict[str, Any]) -> Parsed:
    """Parse a mapping of a file; ConfigError where a field is missing or wrong."""
    try:
        return kind.model_validate(found)
    except ConfigError as error:
        raise ConfigError(f"is damaged: {error}") from None


class EpisodeCollector:
    """Collects the episodes of a file.

    Attributes: `header` and `end`, None until they were read; `parts`, the episodes; `topics`, by
    the numbers of the channels that are wanted; `kept`, bytes that were kept so far.

    Args:
        wanted: the topics that are wanted, besides that of the episodes.

    Raises:
        ConfigError: by `take`, for a record that is damaged or of another version.
    """

    def __init__(self, wanted: Sequence[Topic] = (*TABLE_TOPICS, *LIST_TOPICS)) -> None:
        self.header: dict[str, Any] | None = None
        self.end: dict[str, Any] | None = None
        self.parts: list[EpisodeParts] = []
        self.topics: dict[int, Topic] = {}
        self.kept = 0
        self._wanted = {topic.name: topic for topic in (messages.EPISODE, *wanted)}
        self._openings = 0

    def take(self, opcode: int, content: bytes) -> None:
        """Take a record."""
        if opcode == MESSAGE:
            self._take_message(content)
        elif opcode == CHANNEL:
            channel = parse_record("Channel", content)
            topic = self._wanted.get(channel.topic)
            if topic is not None:
                columns = channel.metadata.get("columns", "")
                if topic in TABLE_TOPICS and columns.split(",") != list(topic.columns):
                    raise ConfigError(
                        f"{topic.name} has other columns: it was recorded by another version"
                    )
                self.topics[channel.id] = topic
        elif opcode == METADATA:
            found = parse_record("Metadata", content)
            if found.name == HEADER_RECORD and self.header is None:
                self.header = parse_mapping(found.metadata.get("header", ""))
                if self.header.get("format") != RECORDING_FORMAT:
                    raise ConfigError(
                        f"is a recording of format {str(self.header.get('format'))[:20]}: "
                        f"this version reads format {RECORDING_FORMAT}"
                    )
                parse_section(RecordingHeader, self.header)
            elif found.name == END_RECORD and self.end is None:
                self.end = parse_mapping(found.metadata.get("end", ""))

    def _take_message(self, content: bytes) -> None:
        try:
            number, _, time, _ = _MESSAGE.unpack_from(content)
        except struct.error:
            raise ConfigError("is damaged: a broken message") from None
        topic = self.topics.get(number)
        if topic is None:
            return
        self.kept += len(content) + (0 if topic in TABLE_TOPICS else MESSAGE_COST)
        if self.kept > MAX_KEPT:
            raise ConfigError(TOO_MUCH)
        data = content[_MESSAGE.size :]
        if topic is messages.EPISODE:
            self._openings += len(data)
            if len(self.parts) >= MAX_EPISODES or self._openings > MAX_OPENINGS:
                raise ConfigError(TOO_MUCH)
            told = parse_mapping(data[8:-1].decode("ascii", "replace"))
            self.parts.append(EpisodeParts(parse_section(EpisodeOpening, told)))
        elif self.parts:
            self.parts[-1].add(topic, time, data)


def read(path: str | Path, *, revolutions: bool = False) -> Recording:
    """Read a recording.

    Args:
        path: the file, at most 1 GB.
        revolutions: also read what a LiDAR measured, which takes most of the memory.

    Returns:
        All of it. Where the end of the file is missing, what there is, and `cut` is true.

    Raises:
        ConfigError: the file can't be read, isn't a recording, or is damaged.
    """
    wanted = (*TABLE_TOPICS, *LIST_TOPICS, *((REVOLUTIONS,) if revolutions else ()))
    collector, digest, cut = EpisodeCollector(wanted), hashlib.sha256(), False
    with open_file(Path(path), MAX_FILE) as file:
        try:
            for opcode, content in RecordStream(file, collector.topics, digest):
                collector.take(opcode, content)
        except FileCut:
            cut = True
        if collector.header is None:
            raise ConfigError("isn't a recording of acsar_gym")
        config = RobotConfig.model_validate(collector.header["config"])
        episodes = tuple(make_episode(parts) for parts in collector.parts)
        if not episodes:
            raise ConfigError("holds no episode")
    dropped = (collector.end or {}).get("dropped", 0)
    if not (isinstance(dropped, int) and dropped > 0):
        numbers = [one.exchanges.numbers for one in episodes]
        dropped = sum(max(int(one.max()) + 1 - len(one), 0) for one in numbers if len(one))
    cut = cut or collector.end is None
    header, sha256 = collector.header, digest.hexdigest()[:16]
    return Recording(header, sha256, config, episodes, cut=cut, dropped=dropped)


def make_episode(parts: EpisodeParts) -> Episode:
    """Make an episode of what was read of it, which is forgotten.

    Raises:
        ConfigError: it is damaged.
    """
    exchanges, ticks, steps = (parts.take_table(topic) for topic in TABLE_TOPICS)
    for table in (exchanges, ticks, steps):
        stamps = np.concatenate([[parts.start], _check_stamps(table[:, 1])])
        if (np.diff(stamps) < 0.0).any():
            raise ConfigError("is damaged: its times go backwards")
    pieces: list[Any] = []
    for topic in (messages.WIRE_SENT, messages.WIRE_RECEIVED):
        times, data = parts.take_list(topic)
        stamps = np.array([time - parts.offset for time in times], np.float64) / 1e9
        pieces += [_check_stamps(stamps), tuple(data)]
    scans = _stack_rows(parts.take_list(SCANS)[1], "<f8", 2)
    if not np.isfinite(scans).all():
        raise ConfigError("is damaged: a scan that isn't finite")
    places = np.searchsorted(exchanges[:, 0], ticks[:, 0])
    known = places < len(exchanges)
    known[known] = exchanges[places[known], 0] == ticks[known, 0]
    truth = np.full((len(ticks), 3), np.nan)
    truth[known] = exchanges[places[known], 5:8]
    number = len(steps)
    actions = _stack_rows(parts.take_list(messages.ACTION)[1], "<f4", 0)
    observations = parts.take_list(messages.OBSERVATION)[1][:number]
    return Episode(
        start=parts.start,
        offset=parts.offset,
        info=parts.info,
        wire=WireLog(*pieces),
        stamps=ticks[:, 1],
        poses=ticks[:, 2:5],
        twists=ticks[:, 5:7],
        speeds=ticks[:, 7:11],
        asked=ticks[:, 15:17],
        sent=ticks[:, 17:19],
        reasons=_to_integers(ticks[:, 19]),
        lateness=ticks[:, 20],
        truth=truth,
        observations=_stack_rows(observations, "<f4", 0).astype(np.float32, copy=False),
        actions=actions.astype(np.float32) if len(actions) else np.zeros((0, 2), np.float32),
        rewards=steps[1:, 2],
        terminated=bool(number and steps[-1, 3] == 1.0),
        truncated=bool(number and steps[-1, 4] == 1.0),
        success=bool(steps[-1, 5] == 1.0) if number > 1 else None,
        step_stamps=steps[:, 1],
        scans=Scans(_check_stamps(scans[:, 1]), scans[:, 2:], _to_integers(scans[:, 0])),
        revolutions=_make_revolutions(parts.take_list(REVOLUTIONS)[1]),
        exchanges=Exchanges(
            _to_integers(exchanges[:, 0]),
            exchanges[:, 1],
            _to_integers(exchanges[:, 2]),
            _to_integers(exchanges[:, 3]),
            exchanges[:, 4],
            exchanges[:, 5:],
        ),
    )


def _make_revolutions(rows: list[bytes]) -> Revolutions:
    """The revolutions of an episode; ConfigError where one is damaged."""
    heads, measured = np.zeros((len(rows), 2)), []
    for place, data in enumerate(rows):
        row = np.frombuffer(data, "<f8")
        if len(row) % 3 != 2 or not np.isfinite(row).all():
            raise ConfigError("is damaged: a broken revolution of the LiDAR")
        heads[place] = row[:2]
        turn = row[2:].reshape(3, -1).astype(np.float64)
        _check_stamps(turn[2])
        if np.abs(turn[0]).max(initial=0.0) > MAX_BEARING or (
            turn[1].min(initial=0.0) < 0.0 or turn[1].max(initial=0.0) > MAX_DISTANCE
        ):
            raise ConfigError("is damaged: a measurement of the LiDAR that is out of range")
        measured.append(turn)
    return Revolutions(_check_stamps(heads[:, 1]), tuple(measured), _to_integers(heads[:, 0]))


def _check_stamps(stamps: Floats) -> Floats:
    """Return times [s]; ConfigError where one is out of range or no number."""
    if not (np.abs(stamps) <= MAX_STAMP).all():
        raise ConfigError("is damaged: a time that is out of range")
    return stamps


def _to_integers(numbers: Floats) -> NDArray[np.int64]:
    """Numbers of a file as integers, whatever they are."""
    return np.nan_to_num(np.clip(numbers, -1e15, 1e15)).astype(np.int64)


def _stack_rows(rows: list[bytes], kind: str, least: int) -> NDArray[Any]:
    """Rows of one length, at least so many numbers each, (n, length)."""
    if not rows:
        return np.zeros((0, least), kind)
    sizes = {len(row) for row in rows}
    if len(sizes) > 1 or min(sizes) < least * np.dtype(kind).itemsize:
        raise ConfigError("is damaged: scans, observations or actions of several lengths")
    return np.frombuffer(b"".join(rows), kind).reshape(len(rows), -1)


def summarize(path: Path) -> dict[str, Any]:
    """Sum up a recording, ready for JSON.

    Args:
        path: the recording.

    Raises:
        ConfigError: it can't be read.
    """
    recording = read(path)
    header = recording.header
    truths = [one.exchanges.truth for one in recording.episodes if len(one.exchanges.truth)]
    ends = [
        float(one.exchanges.stamps[-1]) if len(one.exchanges.stamps) else one.start
        for one in recording.episodes
    ]
    episodes: list[dict[str, Any]] = [
        {
            "ticks": len(one.stamps),
            "steps": len(one.actions),
            "scans": len(one.scans.stamps),
            "duration": round(end - one.start, 3),
            "info": dict(one.info),
        }
        for one, end in zip(recording.episodes, ends, strict=True)
    ]
    return {
        "file": str(path),
        "sha256": recording.sha256,
        "whole": not recording.cut,
        "dropped": None if recording.cut and not recording.dropped else recording.dropped,
        "duration": round(sum(one["duration"] for one in episodes), 3),
        "about": header["about"],
        "robot": {
            "sha256": header["config_sha256"][:16],
            "base_frame": recording.config.base_frame,
            "simulated": bool(truths) and not math.isnan(truths[0][0, 0]),
        },
        "versions": header["versions"],
        "created": header["created"],
        "topics": _count_messages(path),
        "episodes": episodes,
    }


def _count_messages(path: Path) -> dict[str, int]:
    """How many messages each topic has."""
    names: dict[int, str] = {}
    counts: Counter[int] = Counter()
    with open_file(path, MAX_FILE) as file:
        try:
            for opcode, content in RecordStream(file):
                if opcode == CHANNEL:
                    channel = parse_record("Channel", content)
                    names[channel.id] = channel.topic
                elif opcode == MESSAGE and len(content) > 1:
                    counts[struct.unpack_from("<H", content)[0]] += 1
        except FileCut:
            pass
    return {name: counts[number] for number, name in names.items() if counts[number]}


def summary_lines(found: dict[str, Any]) -> list[str]:
    """Return a summary as lines of text."""
    about, robot, episodes = found["about"], found["robot"], found["episodes"]
    kind = "simulated" if robot["simulated"] else "real"
    whole = "whole" if found["whole"] else "cut: what followed is missing"
    count = f"{len(episodes)} episode{'s' if len(episodes) != 1 else ''}"
    lost = "drops unknown"  # the end, which would tell them, is missing
    if found["dropped"] is not None:
        least = "" if found["whole"] else "at least "
        lost = f"{least}{found['dropped']:,} dropped" if found["dropped"] else "nothing dropped"
    lines = [
        f"{found['file']}: {whole}; {count}, {found['duration']:.1f} s, {lost}",
        f"{kind} robot, config {robot['sha256']}; file {found['sha256']}",
    ]
    if about:
        lines.append(", ".join(f"{name} {_shorten(value)}" for name, value in about.items()))
    lines += [
        f"episode {number}: {one['duration']:.1f} s, {one['ticks']:,} ticks, "
        f"{one['steps']} steps, {one['scans']} scans; {_shorten(one['info'])}"
        for number, one in enumerate(episodes[:20])
    ]
    if len(episodes) > 20:
        lines.append(f"... and {len(episodes) - 20} more episodes")
    return lines + [f"{name:<20} {count:>9,}" for name, count in found["topics"].items()]


def _shorten(value: Any) -> str:
    """A value of the header on one line."""
    text = " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
    return shorten_text(text, 100)
