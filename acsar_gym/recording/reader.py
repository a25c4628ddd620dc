"""Reads recordings back, in bounded time and memory whatever the file holds."""

from __future__ import annotations

import hashlib
import io
import math
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.recording import messages
from acsar_gym.recording.messages import END_RECORD, HEADER_RECORD, RECORDING_FORMAT
from acsar_gym.recording.types import Episode, Exchanges, Floats, Recording, Scans, WireLog

MAX_STAMP = 4e9
"""Largest time on a link's clock, either sign [s]: 126 years."""
MAX_OFFSET = 2**62
"""Largest offset of an episode, either sign [ns]; times of the file then fit into 64 bits."""
_ARRAY = struct.Struct("<4sIII")
"""Encapsulation, no dimensions, no offset, number of elements."""


class EpisodeParts:
    """What was read of one episode so far."""

    def __init__(self, told: dict[str, Any]) -> None:
        self.told = told
        self.start, self.offset = float(told["start"]), int(told["offset"])
        self.sent: list[bytes] = []
        self.got: list[bytes] = []
        self.sent_times: list[int] = []
        self.got_times: list[int] = []
        self.tables: dict[str, bytearray] = {topic.name: bytearray() for topic in TABLE_TOPICS}
        self.scans: list[bytes] = []
        self.observations: list[bytes] = []
        self.actions: list[bytes] = []


MessageTaker = Callable[[EpisodeParts, int, bytes], None]


def parse_mapping(text: str) -> dict[str, Any]:
    """Parse JSON that must be a mapping."""
    found = reading.parse_json(text)
    if not isinstance(found, dict):
        raise ConfigError("is damaged: its header is no mapping")
    return found


def parse_opening(data: bytes) -> dict[str, Any]:
    """Parse what begins an episode."""
    told = parse_mapping(data[8:-1].decode("ascii", "replace"))
    start, offset = told.get("start"), told.get("offset")
    sound = isinstance(start, int | float) and abs(start) <= MAX_STAMP
    sound = sound and isinstance(offset, int) and abs(offset) <= MAX_OFFSET
    if not sound or not isinstance(told.get("info"), dict):
        raise ConfigError("is damaged: a broken episode")
    return told


def _parse_array(data: bytes, size: int) -> bytes:
    """The elements of a MultiArray without dimensions; `size` is that of one element."""
    try:
        _, dimensions, _, count = _ARRAY.unpack_from(data)
    except struct.error:
        raise ConfigError("is damaged: a broken message") from None
    first = _ARRAY.size + (4 if size == 8 else 0)  # numbers of 8 bytes are aligned
    payload = data[first : first + count * size]
    if dimensions or len(payload) != count * size:
        raise ConfigError("is damaged: a broken array")
    return payload


def begin_episode(part: EpisodeParts, time: int, data: bytes) -> None:
    """Begin an episode; `_Reader` does it."""


def _sent(part: EpisodeParts, time: int, data: bytes) -> None:
    part.sent_times.append(time)
    part.sent.append(_parse_array(data, 1))


def _got(part: EpisodeParts, time: int, data: bytes) -> None:
    part.got_times.append(time)
    part.got.append(_parse_array(data, 1))


def _row(name: str, columns: int) -> MessageTaker:
    """A taker for the rows of a table."""

    def take(part: EpisodeParts, time: int, data: bytes) -> None:
        row = _parse_array(data, 8)
        if len(row) != 8 * columns:
            raise ConfigError(f"is damaged: a broken row of {name}")
        part.tables[name] += row

    return take


def _scan(part: EpisodeParts, time: int, data: bytes) -> None:
    part.scans.append(_parse_array(data, 8))


def _observation(part: EpisodeParts, time: int, data: bytes) -> None:
    part.observations.append(_parse_array(data, 4))


def _action(part: EpisodeParts, time: int, data: bytes) -> None:
    part.actions.append(_parse_array(data, 4))


TABLE_TOPICS = messages.EXCHANGES, messages.TICKS, messages.STEPS
MESSAGE_TAKERS: dict[str, MessageTaker] = {
    messages.EPISODE.name: begin_episode,
    messages.WIRE_SENT.name: _sent,
    messages.WIRE_RECEIVED.name: _got,
    messages.SCANS.name: _scan,
    messages.OBSERVATION.name: _observation,
    messages.ACTION.name: _action,
    **{topic.name: _row(topic.name, len(topic.columns)) for topic in TABLE_TOPICS},
}


def make_episode(part: EpisodeParts) -> Episode:
    """Make an episode of what was read."""
    exchanges, ticks, steps = (_read_table(part, topic) for topic in TABLE_TOPICS)
    for table in (exchanges, ticks, steps):
        _check_times(table[:, 1], part.start)
    number, actions = len(steps), _stack_rows(part.actions, np.float32)
    return Episode(
        start=part.start,
        offset=part.offset,
        wire=_make_wire(part),
        stamps=ticks[:, 1],
        poses=ticks[:, 2:5],
        twists=ticks[:, 5:7],
        speeds=ticks[:, 7:11],
        asked=ticks[:, 15:17],
        sent=ticks[:, 17:19],
        reasons=_whole(ticks[:, 19]),
        lateness=ticks[:, 20],
        truth=_truth_of(ticks, exchanges),
        observations=_stack_rows(part.observations[:number], np.float32),
        actions=actions if len(actions) else np.zeros((0, 2), np.float32),
        rewards=steps[1:, 2],
        terminated=bool(number and steps[-1, 3] == 1.0),
        success=bool(steps[-1, 5] == 1.0) if number > 1 else None,
        step_stamps=steps[:, 1],
        scans=_make_scans(part.scans),
        exchanges=_exchanges(exchanges),
        info=part.told["info"],
    )


def _make_wire(part: EpisodeParts) -> WireLog:
    """The bytes of an episode."""
    return WireLog(
        _stamps(part.sent_times, part.offset),
        tuple(part.sent),
        _stamps(part.got_times, part.offset),
        tuple(part.got),
    )


def _exchanges(rows: Floats) -> Exchanges:
    """The control periods of an episode."""
    whole = (_whole(rows[:, column]) for column in (0, 2, 3))
    number, writes, pieces = whole
    return Exchanges(number, rows[:, 1], writes, pieces, rows[:, 4], rows[:, 5:])


def _check_times(stamps: Floats, start: float) -> None:
    """Raise ConfigError for times that are out of range, or go backwards."""
    times = np.concatenate([[start], _check_stamps(stamps)])
    if (np.diff(times) < 0.0).any():
        raise ConfigError("is damaged: its times go backwards")


def _check_stamps(stamps: Floats) -> Floats:
    """Return times [s]; ConfigError where one is out of range or no number."""
    if not (np.abs(stamps) <= MAX_STAMP).all():
        raise ConfigError("is damaged: a time that is out of range")
    return stamps


def _read_table(part: EpisodeParts, topic: messages.Topic) -> Floats:
    """The rows of a table."""
    rows = np.frombuffer(part.tables[topic.name], "<f8")
    return rows.reshape(-1, len(topic.columns)).astype(np.float64, copy=False)


def _whole(numbers: Floats) -> NDArray[np.int64]:
    """Numbers of a file as integers, whatever they are."""
    return np.nan_to_num(np.clip(numbers, -1e15, 1e15)).astype(np.int64)


def _truth_of(ticks: Floats, exchanges: Floats) -> Floats:
    """True poses at the end of the ticks, (n, 3)."""
    places = np.searchsorted(exchanges[:, 0], ticks[:, 0])
    found = np.full((len(ticks), 3), np.nan)
    known = places < len(exchanges)
    known[known] = exchanges[places[known], 0] == ticks[known, 0]
    found[known] = exchanges[places[known], 5:8]
    return found


def count_missing(part: EpisodeParts) -> int:
    """How many exchanges of an episode are missing."""
    rows = _read_table(part, messages.EXCHANGES)
    return int(max(_whole(rows[:, 0]).max() + 1 - len(rows), 0)) if len(rows) else 0


def _stamps(times: list[int], offset: int) -> Floats:
    """Times of the file on the link's clock [s]."""
    return _check_stamps(np.array([time - offset for time in times], np.float64) / 1e9)


def _stack_rows(rows: list[bytes], kind: type[np.float32]) -> NDArray[np.float32]:
    """Rows of one length, (n, length)."""
    if not rows:
        return np.zeros((0, 0), kind)
    if any(len(row) != len(rows[0]) for row in rows):
        raise ConfigError("is damaged: observations or actions of several lengths")
    return np.frombuffer(b"".join(rows), "<f4").reshape(len(rows), -1).astype(kind, copy=False)


def _make_scans(rows: list[bytes]) -> Scans:
    """The scans of an episode."""
    if not rows:
        return Scans(np.zeros(0), np.zeros((0, 0)), np.zeros(0, np.int64))
    if len(rows[0]) < 16 or any(len(row) != len(rows[0]) for row in rows):
        raise ConfigError("is damaged: scans of several lengths")
    table = np.frombuffer(b"".join(rows), "<f8").reshape(len(rows), -1)
    if not np.isfinite(table).all():
        raise ConfigError("is damaged: a scan that isn't finite")
    return Scans(_check_stamps(table[:, 1]).copy(), table[:, 2:].copy(), _whole(table[:, 0]))


MCAP_MAGIC = b"\x89MCAP0\r\n"
CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 4, 5, 6, 12, 15
KNOWN_OPCODES = range(1, 16)
DESCRIPTIONS = CHANNEL, METADATA
CHUNK_OPCODES = MESSAGE, *DESCRIPTIONS
"""What is read of a chunk."""
MAX_RECORD = 8_000_000
"""Longest accepted record, and chunk once it is unpacked [bytes]."""
MAX_UNPACKED = 2_000_000_000
"""Most bytes of all chunks once they are unpacked; two hours at 100 Hz."""
MAX_RATIO = 32
"""Most unpacked bytes for each byte of the file, beyond MOST_RECORD; a robot that stands has 10."""
MAX_DESCRIBED = 4_000_000
"""Most bytes of channels and metadata, which are slow to read; a recording's are 30,000."""
MAX_RECORDS = 4_500_000
"""Most records; an hour at 100 Hz has 4 million."""
TOO_MUCH = "holds too much: cut out a part of it"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")


class FileCut(Exception):  # noqa: N818 - not an error
    """The file ends in the middle of a record, or before its last one."""


class RecordStream:
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
        if self._read(len(MCAP_MAGIC)) != MCAP_MAGIC:
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
            raise FileCut
        if opcode not in KNOWN_OPCODES or length > MAX_RECORD:
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
        most = min(MAX_UNPACKED, MAX_RECORD + MAX_RATIO * self._packed)
        if size > MAX_RECORD or self._unpacked > most:
            raise ConfigError(TOO_MUCH)
        unpacked = _unpack_chunk(kind, data, size)
        if len(unpacked) != size or (crc and zlib.crc32(unpacked) != crc):
            raise ConfigError("is damaged: a chunk with a wrong checksum")
        yield from self._inside(unpacked)

    def _inside(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield the records of a chunk."""
        place, end, unpack, head = 0, len(data) - _RECORD.size, _RECORD.unpack_from, _RECORD.size
        wanted = () if self.wanted is None else self.wanted
        most, before = MAX_RECORDS - self._count, 0
        while place <= end and before < most:
            opcode, length = unpack(data, place)
            first = place + head
            place = first + length
            before += 1
            is_one = opcode == MESSAGE and length > 1 and self.wanted is not None
            if is_one and data[first] | data[first + 1] << 8 not in wanted:
                continue
            if place > len(data) or opcode not in KNOWN_OPCODES:
                raise ConfigError("is damaged: a broken record in a chunk")
            if opcode in CHUNK_OPCODES:
                self._weigh(opcode, length)
                yield opcode, data[first:place]
        self._counted(before)

    def _weigh(self, opcode: int, length: int) -> None:
        """Count the bytes of descriptions; ConfigError for too many."""
        if opcode in DESCRIPTIONS:
            self._described += _RECORD.size + length
            if self._described > MAX_DESCRIBED:
                raise ConfigError(TOO_MUCH)

    def _counted(self, records: int = 1) -> None:
        """Count records; ConfigError for too many."""
        self._count += records
        if self._count >= MAX_RECORDS:
            raise ConfigError(TOO_MUCH)

    def _rest(self) -> None:
        """Read what follows the data, an index; Cut where it isn't whole."""
        newest = b""
        while piece := self._read(1 << 20):
            newest = (newest + piece)[-len(MCAP_MAGIC) :]
        if newest != MCAP_MAGIC:
            raise FileCut

    def _whole(self, size: int) -> bytes:
        data = self._read(size)
        if len(data) < size:
            raise FileCut
        return data

    def _read(self, size: int) -> bytes:
        data = self._file.read(size)
        self._digest.update(data)
        return data


def _unpack_chunk(kind: str, data: bytes, size: int) -> bytes:
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


def parse_description(opcode: int, content: bytes) -> Any:
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
HEADER_FIELDS = {"config_sha256": str, "versions": dict, "created": dict, "about": dict}
"""What a header must have besides format and config, and its kind."""
_MESSAGE = struct.Struct("<HIQQ")


class EpisodeCollector:
    """Collects the episodes of a file.

    Attributes: `header` and `end`, None until they were read; `parts`, the episodes; `takers`, by
    the numbers of the channels that are wanted; `kept`, bytes that were kept so far.

    Args:
        wanted: what takes the messages of each topic that is wanted.

    Raises:
        ConfigError: by `take`, for a record that is damaged or of another version.
    """

    def __init__(self, wanted: Mapping[str, MessageTaker] = MESSAGE_TAKERS) -> None:
        self.header: dict[str, Any] | None = None
        self._wanted = wanted
        self.end: dict[str, Any] | None = None
        self.parts: list[EpisodeParts] = []
        self.kept = 0
        self._openings = 0
        self._tables: set[int] = set()
        self.takers: dict[int, MessageTaker] = {}

    def take(self, opcode: int, content: bytes) -> None:
        """Take a record."""
        if opcode == MESSAGE:
            self._message(content)
        elif opcode in DESCRIPTIONS:
            found = parse_description(opcode, content)
            if opcode == CHANNEL:
                self._channel(found.id, found.topic, found.metadata)
            elif found.name == HEADER_RECORD and self.header is None:
                self.header = parse_mapping(found.metadata.get("header", ""))
                _check_format(self.header)
            elif found.name == END_RECORD and self.end is None:
                self.end = parse_mapping(found.metadata.get("end", ""))

    def _channel(self, number: int, name: str, told: Mapping[str, str]) -> None:
        """Take note of a channel, if its topic is one that is read back."""
        columns = {topic.name: topic.columns for topic in TABLE_TOPICS}
        if name in columns and told.get("columns", "").split(",") != list(columns[name]):
            raise ConfigError(f"{name} has other columns: it was recorded by another version")
        if name in columns:
            self._tables.add(number)
        if name in self._wanted:
            self.takers[number] = self._wanted[name]

    def _message(self, content: bytes) -> None:
        """Take a message."""
        try:
            number, _, time, _ = _MESSAGE.unpack_from(content)
        except struct.error:
            raise ConfigError("is damaged: a broken message") from None
        taker = self.takers.get(number)
        if taker is None:
            return
        self.kept += len(content) + (0 if number in self._tables else MESSAGE_COST)
        if self.kept > MAX_KEPT:
            raise ConfigError(TOO_MUCH)
        data = content[_MESSAGE.size :]
        if taker is begin_episode:
            self._openings += len(data)
            if len(self.parts) >= MAX_EPISODES or self._openings > MAX_OPENINGS:
                raise ConfigError(TOO_MUCH)
            self.parts.append(EpisodeParts(parse_opening(data)))
        elif self.parts:
            taker(self.parts[-1], time, data)


def read(path: str | Path) -> Recording:
    """Read a recording.

    Args:
        path: the file, at most 1 GB.

    Returns:
        All of it. Where the end of the file is missing, what there is, and `cut` is true.

    Raises:
        ConfigError: the file can't be read, isn't a recording, or is damaged.
    """
    reader, digest, cut = EpisodeCollector(), hashlib.sha256(), False
    path = Path(path)
    with reading.open_file(path, MAX_FILE) as file:
        try:
            found = open_records(file, digest)
            found.wanted = reader.takers
            for opcode, content in found:
                reader.take(opcode, content)
        except FileCut:
            cut = True
        if reader.header is None:
            raise ConfigError("isn't a recording of acsar_gym")
        config = RobotConfig.model_validate(reader.header["config"])
        episodes = tuple(make_episode(part) for part in reader.parts)
        if not episodes:
            raise ConfigError("holds no episode")
    told = (reader.end or {}).get("dropped", 0)
    dropped = told if isinstance(told, int) and told > 0 else sum(map(count_missing, reader.parts))
    cut = cut or reader.end is None
    return Recording(
        reader.header, digest.hexdigest()[:16], config, episodes, cut=cut, dropped=dropped
    )


def open_records(file: IO[bytes], digest: Any) -> RecordStream:
    """Return the records of a file; ConfigError for recordings of older versions."""
    if file.read(1) == b"{":
        raise ConfigError("is a recording of an older version, in JSON: record again")
    file.seek(0)
    return RecordStream(file, digest)


def _check_format(header: dict[str, Any]) -> None:
    """Raise ConfigError for a header of another version."""
    if header.get("format") != RECORDING_FORMAT or not isinstance(header.get("config"), dict):
        found = str(header.get("format"))[:20]
        raise ConfigError(
            f"is a recording of format {found}: this version reads format {RECORDING_FORMAT}"
        )
    for name, kind in HEADER_FIELDS.items():
        if not isinstance(header.get(name), kind):
            raise ConfigError(f"is damaged: its header has no {name!r}")


def summarize(path: Path) -> dict[str, Any]:
    """Sum up a recording, ready for JSON.

    Args:
        path: the recording.

    Raises:
        ConfigError: it can't be read.
    """
    recording = read(path)
    header = recording.header
    return {
        "file": str(path),
        "sha256": recording.sha256,
        "whole": not recording.cut,
        "dropped": None if recording.cut and not recording.dropped else recording.dropped,
        "duration": round(sum(map(_duration, recording.episodes)), 3),
        "about": header["about"],
        "robot": {
            "sha256": header["config_sha256"][:16],
            "base_frame": recording.config.base_frame,
            "simulated": _is_simulated(recording),
        },
        "versions": header["versions"],
        "created": header["created"],
        "topics": _count_messages(path),
        "episodes": [_summarize_episode(one) for one in recording.episodes],
    }


def summary_lines(found: dict[str, Any]) -> list[str]:
    """Return a summary as lines of text."""
    about, robot = found["about"], found["robot"]
    whole = "whole" if found["whole"] else "cut: what followed is missing"
    kind = "simulated" if robot["simulated"] else "real"
    told = ", ".join(f"{name} {_shorten(value)}" for name, value in about.items())
    episodes = found["episodes"]
    count = f"{len(episodes)} episode{'s' if len(episodes) != 1 else ''}"
    return [
        f"{found['file']}: {whole}; {count}, {found['duration']:.1f} s, {_describe_drops(found)}",
        f"{kind} robot, config {robot['sha256']}; file {found['sha256']}",
        *([told] if told else []),
        *(
            f"episode {number}: {one['duration']:.1f} s, {one['ticks']:,} ticks, "
            f"{one['steps']} steps, {one['scans']} scans; {_shorten(one['info'])}"
            for number, one in enumerate(episodes[:20])
        ),
        *([f"... and {len(episodes) - 20} more episodes"] if len(episodes) > 20 else []),
        *(f"{name:<20} {count:>9,}" for name, count in found["topics"].items()),
    ]


def _describe_drops(found: dict[str, Any]) -> str:
    """How many events were dropped; None where the end, which would tell it, is missing."""
    dropped = found["dropped"]
    if dropped is None:
        return "drops unknown"
    least = "" if found["whole"] else "at least "
    return f"{least}{dropped:,} dropped" if dropped else "nothing dropped"


def _duration(episode: Episode) -> float:
    """Duration of an episode [s]."""
    stamps = episode.exchanges.stamps
    return float(stamps[-1] - episode.start) if len(stamps) else 0.0


def _is_simulated(recording: Recording) -> bool:
    """Whether ground truth was recorded."""
    truths = [one.exchanges.truth for one in recording.episodes if len(one.exchanges.truth)]
    return bool(truths) and not math.isnan(truths[0][0, 0])


def _summarize_episode(episode: Episode) -> dict[str, Any]:
    """Sum up an episode."""
    return {
        "ticks": len(episode.stamps),
        "steps": len(episode.actions),
        "scans": len(episode.scans.stamps),
        "duration": round(_duration(episode), 3),
        "info": dict(episode.info),
    }


def _count_messages(path: Path) -> dict[str, int]:
    """How many messages each topic has."""
    names: dict[int, str] = {}
    counts: Counter[int] = Counter()
    with reading.open_file(path, MAX_FILE) as file:
        try:
            for opcode, content in RecordStream(file, hashlib.sha256()):
                if opcode == CHANNEL:
                    channel = parse_description(opcode, content)
                    names[channel.id] = channel.topic
                elif opcode == MESSAGE and len(content) > 1:
                    counts[struct.unpack_from("<H", content)[0]] += 1
        except FileCut:
            pass
    return {name: counts[number] for number, name in names.items() if counts[number]}


def _shorten(value: Any) -> str:
    """A value of the header on one line."""
    text = " ".join(f"{k}={v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
    return text if len(text) <= 100 else f"{text[:100]}..."
