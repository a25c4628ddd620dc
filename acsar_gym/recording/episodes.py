"""Makes episodes of a recording's messages."""

from __future__ import annotations

import hashlib
import math
import struct
from array import array
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError
from acsar_gym.lidar.scan import MAX_DISTANCE, MAX_STAMP
from acsar_gym.reading import parse_json
from acsar_gym.recording.messages import (
    ACTION,
    ARRAY_HEADER,
    DOUBLES_TYPE,
    END_RECORD,
    EPISODE,
    EXCHANGES,
    HEADER_RECORD,
    MOVER_COLUMNS,
    MOVERS,
    OBSERVATION,
    OCTETS_TYPE,
    RECORDING_FORMAT,
    REVOLUTIONS,
    SCANS,
    SINGLES_TYPE,
    STEPS,
    TICKS,
    WIRE_RECEIVED,
    WIRE_SENT,
    Topic,
)
from acsar_gym.recording.stream import CHANNEL, MESSAGE, MESSAGE_HEAD, METADATA, parse_record
from acsar_gym.recording.types import (
    Episode,
    Exchanges,
    Floats,
    Movers,
    Pieces,
    Revolutions,
    Scans,
    WireLog,
)
from acsar_gym.worlds.crowd import SEEN_NUMBERS
from acsar_gym.worlds.movers import MAX_MOVERS

MAX_BEARING = 100.0  # largest bearing of a LiDAR's measurement, either sign [rad]
MAX_OFFSET = 2**62  # largest offset of an episode, either sign [ns]; its times then fit 64 bits
MOVER_HEAD = len(MOVER_COLUMNS) - 1  # numbers of a row before those of its movers
COMPACT_PIECES = 100_000  # from so many on, pieces of bytes stay in one buffer
TABLE_TOPICS = EXCHANGES, TICKS, STEPS
LIST_TOPICS = WIRE_SENT, WIRE_RECEIVED, SCANS, MOVERS, OBSERVATION, ACTION
ELEMENT_SIZES = {DOUBLES_TYPE: 8, SINGLES_TYPE: 4, OCTETS_TYPE: 1}
_NUMBER_AND_STAMP = struct.Struct("<dd")
_TRUE_X = struct.Struct("<d")


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


class PieceBuffer:
    """Content of a topic's messages in one buffer, where each ends, and their times [ns]."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.ends = array("Q")
        self.times = array("Q")

    def add(self, time: int, content: bytes) -> None:
        """Add a message."""
        self.data += content
        self.ends.append(len(self.data))
        self.times.append(time)

    def stamps(self, offset: int) -> Floats:
        """Times on the link's clock [s], (n,); ConfigError where one is out of range."""
        times = np.frombuffer(self.times, np.uint64)
        if (times >= MAX_OFFSET).any():
            raise ConfigError("is damaged: a time that is out of range")
        return check_stamps((times.astype(np.int64) - offset).astype(np.float64) / 1e9)

    def pieces(self) -> Pieces:
        """The content of each message."""
        return Pieces(self.data, self.ends)

    def rows(self, kind: str, least: int) -> NDArray[Any]:
        """Messages of one length, at least so many numbers each, (n, length)."""
        if not self.ends:
            return np.zeros((0, least), kind)
        lengths = np.diff(np.frombuffer(self.ends, np.uint64), prepend=np.uint64(0))
        itemsize = np.dtype(kind).itemsize
        if (lengths != lengths[0]).any() or lengths[0] < least * itemsize:
            raise ConfigError(
                "is damaged: scans, movers, observations or actions of several lengths"
            )
        return np.frombuffer(self.data, kind).reshape(len(lengths), -1)


class EpisodeParts:
    """What was read of one episode so far.

    Attributes: `start` [s], `offset` [ns], `info`; `buffers`, content by topic; `places`, where its
    messages are: chunk, first and last number in it; `counts` and `sizes` [bytes] by topic, also of
    what isn't kept; `last_step`, that table's newest row; `end`, time of the last exchange [s];
    `highest`, its number; `simulated`, whether the truth is known.
    """

    def __init__(self, opening: EpisodeOpening | None = None) -> None:
        self.is_lost = opening is None  # then it begins with what is there
        self.start, self.offset = (opening.start, opening.offset) if opening else (math.nan, 0)
        self.info: Mapping[str, Any] = opening.info if opening else {}
        self.buffers: defaultdict[str, PieceBuffer] = defaultdict(PieceBuffer)
        self.places: list[list[int]] = []
        self.counts: Counter[str] = Counter()
        self.sizes: Counter[str] = Counter()
        self.last_step: tuple[float, ...] = ()
        self.end, self.highest = self.start, -1.0
        self.simulated = False

    def make_blank(self) -> EpisodeParts:
        """Make parts of the same episode without content."""
        parts = EpisodeParts()
        parts.start, parts.offset, parts.info = self.start, self.offset, self.info
        return parts

    @property
    def missing(self) -> int:
        """Exchanges that aren't there."""
        return max(int(self.highest) + 1 - self.counts[EXCHANGES.name], 0)

    def note(self, topic: Topic, time: int, content: bytes) -> None:
        """Note what a message tells about the episode, without keeping it."""
        name = topic.name
        self.counts[name] += 1
        self.sizes[name] += len(content)
        if topic not in TABLE_TOPICS:
            return
        number, stamp = _NUMBER_AND_STAMP.unpack_from(content)
        if self.is_lost and not stamp >= self.start and abs(stamp) <= MAX_STAMP:
            self.start = stamp
            self.offset = time - round(stamp * 1e9)
        if topic is EXCHANGES:
            self.end = stamp
            if number > self.highest and number < 1e15:
                self.highest = number
            if self.counts[name] == 1:
                self.simulated = not math.isnan(_TRUE_X.unpack_from(content, 40)[0])
        elif topic is STEPS:
            self.last_step = struct.unpack("<6d", content)

    def table(self, topic: Topic) -> Floats:
        """The rows of a table, (n, columns); ConfigError where their times go backwards."""
        rows = np.frombuffer(self.buffers[topic.name].data, "<f8").reshape(-1, len(topic.columns))
        rows = rows.astype(np.float64, copy=False)
        stamps = check_stamps(rows[:, 1])
        if len(stamps) and (stamps[0] < self.start or (np.diff(stamps) < 0.0).any()):
            raise ConfigError("is damaged: its times go backwards")
        return rows

    def take_table(self, topic: Topic) -> Floats:
        """Return the rows of a table, and forget them."""
        data = self.buffers.pop(topic.name, PieceBuffer()).data
        return np.frombuffer(data, "<f8").reshape(-1, len(topic.columns))

    def take_list(self, topic: Topic) -> tuple[list[int], list[bytes]]:
        """Return times [ns] and content of a topic's messages, and forget them."""
        buffer = self.buffers.pop(topic.name, PieceBuffer())
        return buffer.times.tolist(), list(buffer.pieces())


def parse_content(topic: Topic, data: bytes) -> bytes:
    """Return what counts of a message: of an array its elements; ConfigError if it is damaged."""
    size = ELEMENT_SIZES.get(topic.kind)
    if size is None:
        return data
    content = parse_array(data, size)
    if topic in TABLE_TOPICS and len(content) != 8 * len(topic.columns):
        raise ConfigError(f"is damaged: a broken row of {topic.name}")
    return content


def parse_array(data: bytes, size: int) -> bytes:
    """Return the elements of a MultiArray without dimensions; `size` is that of one element."""
    try:
        _, dimensions, _, count = ARRAY_HEADER.unpack_from(data)
    except struct.error as error:
        raise ConfigError("is damaged: a broken message") from error
    first = ARRAY_HEADER.size + (4 if size == 8 else 0)  # numbers of 8 bytes are aligned
    payload = data[first : first + count * size]
    if dimensions or len(payload) != count * size:
        raise ConfigError("is damaged: a broken array")
    return payload


Parsed = TypeVar("Parsed", bound=Section)


def parse_section(kind: type[Parsed], mapping: Any) -> Parsed:
    """Parse what JSON holds; ConfigError where it is no mapping, or a field is missing or wrong."""
    if not isinstance(mapping, dict):
        raise ConfigError("is damaged: what begins an episode is no mapping")
    try:
        return kind.model_validate(mapping)
    except ConfigError as error:
        raise ConfigError(f"is damaged: {error}") from error


def parse_opening(data: bytes) -> dict[str, Any]:
    """Parse the message that begins an episode."""
    opening: Any = parse_json(data[8:-1].decode("ascii", "replace"))
    parse_section(EpisodeOpening, opening)
    return dict(opening)


def parse_sealed(metadata: Mapping[str, str], name: str) -> dict[str, Any]:
    """Parse the JSON of metadata; ConfigError where it isn't what was written."""
    text = metadata.get(name, "")
    if hashlib.sha256(text.encode()).hexdigest() != metadata.get("sha256"):
        raise ConfigError(f"is damaged: {name} with a wrong checksum")
    mapping = parse_json(text)
    if not isinstance(mapping, dict):
        raise ConfigError(f"is damaged: its {name} is no mapping")
    return mapping


def parse_header(metadata: Mapping[str, str]) -> dict[str, Any]:
    """Parse the header of a recording; ConfigError for one that is damaged or of another format."""
    header = parse_sealed(metadata, "header")
    if header.get("format") != RECORDING_FORMAT:
        raise ConfigError(
            f"is a recording of format {str(header.get('format'))[:20]}: "
            f"this version reads format {RECORDING_FORMAT}"
        )
    parse_section(RecordingHeader, header)
    return header


class EpisodeCollector:
    """Collects the episodes of a file.

    Attributes: `header` and `end`, None until they were read; `parts`, the episodes; `names`, of
    all topics by channel, and `topics`, those that are wanted; `kept`, bytes that are in memory;
    `is_whole`, whether nothing was forgotten; `damages`, a line for each record that isn't what was
    written; `problem`, what is wrong with a header.
    """

    def __init__(self, wanted: Sequence[Topic]) -> None:
        self.header: dict[str, Any] | None = None
        self.end: dict[str, Any] | None = None
        self.parts: list[EpisodeParts] = []
        self.names: dict[int, str] = {}
        self.topics: dict[int, Topic] = {}
        self.kept = 0
        self.is_whole = True
        self.damages: list[str] = []
        self.problem = ""
        self._wanted = {topic.name: topic for topic in (EPISODE, *wanted)}
        self._sequence = 0

    def forget(self) -> None:
        """Forget the content of all episodes."""
        for parts in self.parts:
            parts.buffers.clear()
        self.kept = 0
        self.is_whole = False

    def take(self, opcode: int, content: bytes, at: int = 0, index: int = 0) -> None:
        """Take a record; ConfigError for one that is damaged or of another version."""
        if opcode == MESSAGE:
            self._take_message(content, at, index)
        elif opcode == CHANNEL:
            self._take_channel(parse_record("Channel", content))
        elif opcode == METADATA:
            self._take_metadata(parse_record("Metadata", content))

    def _take_channel(self, channel: Any) -> None:
        topic = self._wanted.get(channel.topic)
        self.names[channel.id] = channel.topic
        self.topics.pop(channel.id, None)
        if topic is not None:
            self.topics[channel.id] = topic

    def _take_metadata(self, record: Any) -> None:
        if record.name == HEADER_RECORD and self.header is None:
            try:
                self.header = parse_header(record.metadata)
            except ConfigError as error:  # a second one is at the end
                self.problem = self.problem or str(error)
            else:
                self.damages += ["the first header"] if self.problem else []
        elif record.name == END_RECORD and self.end is None:
            try:
                self.end = parse_sealed(record.metadata, "end")
            except ConfigError:
                self.end = {}
                self.damages.append("the number of drops")

    def _take_message(self, content: bytes, at: int, index: int) -> None:
        channel, sequence, time, _ = MESSAGE_HEAD.unpack_from(content)
        topic = self.topics.get(channel)
        if topic is None:
            return
        data = parse_content(topic, content[MESSAGE_HEAD.size :])
        if topic is EPISODE:
            self.parts.append(EpisodeParts(EpisodeOpening(**parse_opening(data))))
            self._sequence = sequence
            return
        if sequence != self._sequence:
            self.parts.append(EpisodeParts())  # whose opening is lost
            self._sequence = sequence
        if not self.parts:
            return
        parts = self.parts[-1]
        parts.note(topic, time, data)
        parts.buffers[topic.name].add(time, data)
        self.kept += len(data) + 16
        if parts.places and parts.places[-1][0] == at:
            parts.places[-1][2] = index
        else:
            parts.places.append([at, index, index])


def check_stamps(stamps: Floats) -> Floats:
    """Return times [s]; ConfigError where one is out of range or no number."""
    if not (np.abs(stamps) <= MAX_STAMP).all():
        raise ConfigError("is damaged: a time that is out of range")
    return stamps


def to_integers(numbers: Floats) -> NDArray[np.int64]:
    """Numbers of a file as integers, whatever they are."""
    return np.nan_to_num(np.clip(numbers, -1e15, 1e15)).astype(np.int64)


def make_ticks(parts: EpisodeParts) -> dict[str, Any]:
    """Fields of an episode that are made of its ticks."""
    ticks = parts.table(TICKS)
    return {
        "stamps": ticks[:, 1],
        "poses": ticks[:, 2:5],
        "twists": ticks[:, 5:7],
        "speeds": ticks[:, 7:11],
        "asked": ticks[:, 15:17],
        "sent": ticks[:, 17:19],
        "reasons": to_integers(ticks[:, 19]),
        "lateness": ticks[:, 20],
    }


def make_truth(parts: EpisodeParts) -> dict[str, Any]:
    """The true pose at each tick."""
    return {"truth": join_truth(parts.table(TICKS), parts.table(EXCHANGES))}


def join_truth(ticks: Floats, exchanges: Floats) -> Floats:
    """True poses (n, 3) at the ends of the exchanges of ticks; NaN where none is known."""
    places = np.searchsorted(exchanges[:, 0], ticks[:, 0])
    known = places < len(exchanges)
    known[known] = exchanges[places[known], 0] == ticks[known, 0]
    truth = np.full((len(ticks), 3), np.nan)
    truth[known] = exchanges[places[known], 5:8]
    return truth


def make_exchanges(parts: EpisodeParts) -> dict[str, Any]:
    """The control periods of the wire."""
    rows = parts.table(EXCHANGES)
    numbers, writes, pieces = (to_integers(rows[:, column]) for column in (0, 2, 3))
    return {"exchanges": Exchanges(numbers, rows[:, 1], writes, pieces, rows[:, 4], rows[:, 5:])}


def make_wire(parts: EpisodeParts) -> dict[str, Any]:
    """The bytes of the wire."""
    fields: list[Any] = []
    stamped = bool(parts.info.get("stamped"))
    for topic in (WIRE_SENT, WIRE_RECEIVED):
        buffer = parts.buffers[topic.name]
        pieces: Sequence[bytes] = buffer.pieces()
        fields += [
            buffer.stamps(parts.offset),
            tuple(pieces) if len(pieces) < COMPACT_PIECES else pieces,
        ]
    sent_stamps, sent, got_stamps, got = fields
    return {"wire": WireLog(sent_stamps, sent, got_stamps, got, stamped=stamped)}


def make_steps(parts: EpisodeParts) -> dict[str, Any]:
    """What an env recorded."""
    steps = parts.table(STEPS)
    actions = parts.buffers[ACTION.name].rows("<f4", 0)
    observations = parts.buffers[OBSERVATION.name].rows("<f4", 0)[: len(steps)]
    return {
        "observations": observations.astype(np.float32, copy=False),
        "actions": actions.astype(np.float32) if len(actions) else np.zeros((0, 2), np.float32),
        "rewards": steps[1:, 2],
        "step_stamps": steps[:, 1],
    }


def make_scans(parts: EpisodeParts) -> dict[str, Any]:
    """The scans of a LiDAR."""
    scans = parts.buffers[SCANS.name].rows("<f8", 2)
    if not np.isfinite(scans).all():
        raise ConfigError("is damaged: a scan that isn't finite")
    return {"scans": Scans(check_stamps(scans[:, 1]), scans[:, 2:], to_integers(scans[:, 0]))}


def make_movers(parts: EpisodeParts) -> dict[str, Any]:
    """What moved around the robot."""
    return {"movers": parse_movers(parts.buffers[MOVERS.name].rows("<f8", MOVER_HEAD))}


def parse_movers(rows: NDArray[Any]) -> Movers:
    """The movers of rows of `messages.MOVER_COLUMNS`; ConfigError for what can't be."""
    count, left = divmod(rows.shape[1] - MOVER_HEAD, SEEN_NUMBERS)
    if left or count > MAX_MOVERS or not np.isfinite(rows).all():
        raise ConfigError("is damaged: movers that can't be")
    states = rows[:, MOVER_HEAD:].astype(np.float64).reshape(len(rows), count, SEEN_NUMBERS)
    if not (states[:, :, -1] > 0.0).all():
        raise ConfigError("is damaged: a mover without a radius")
    numbers, stamps, hits, intrusions = rows[:, :MOVER_HEAD].T.astype(np.float64)
    return Movers(to_integers(numbers), check_stamps(stamps), hits, intrusions, states)


def make_revolutions(parts: EpisodeParts) -> dict[str, Any]:
    """What a LiDAR measured."""
    rows = [parse_revolution(data) for data in parts.buffers[REVOLUTIONS.name].pieces()]
    heads = np.array([head for head, _ in rows], np.float64).reshape(-1, 2)
    turns = tuple(turn for _, turn in rows)
    return {"revolutions": Revolutions(check_stamps(heads[:, 1]), turns, to_integers(heads[:, 0]))}


def parse_revolution(data: bytes) -> tuple[Floats, Floats]:
    """Exchange and end (2,), and measurements (3, n), of a revolution; ConfigError if damaged."""
    row = np.frombuffer(data, "<f8")
    if len(row) % 3 != 2 or not np.isfinite(row).all():
        raise ConfigError("is damaged: a broken revolution of the LiDAR")
    turn = row[2:].reshape(3, -1).astype(np.float64)
    check_stamps(turn[2])
    if np.abs(turn[0]).max(initial=0.0) > MAX_BEARING or (
        turn[1].min(initial=0.0) < 0.0 or turn[1].max(initial=0.0) > MAX_DISTANCE
    ):
        raise ConfigError("is damaged: a measurement of the LiDAR that is out of range")
    return row[:2], turn


class FieldGroup(NamedTuple):
    """Fields of an episode that are made together, and the topics that they are made of."""

    make: Callable[[EpisodeParts], dict[str, Any]]
    topics: tuple[Topic, ...]


FIELD_GROUPS = (
    FieldGroup(make_ticks, (TICKS,)),
    FieldGroup(make_truth, (TICKS, EXCHANGES)),
    FieldGroup(make_exchanges, (EXCHANGES,)),
    FieldGroup(make_wire, (WIRE_SENT, WIRE_RECEIVED)),
    FieldGroup(make_steps, (STEPS, OBSERVATION, ACTION)),
    FieldGroup(make_scans, (SCANS,)),
    FieldGroup(make_movers, (MOVERS,)),
    FieldGroup(make_revolutions, (REVOLUTIONS,)),
)
GROUP_OF_FIELD = {name: group for group in FIELD_GROUPS for name in group.make(EpisodeParts())}


def describe_parts(parts: EpisodeParts) -> dict[str, Any]:
    """Fields of an episode that are known without its content."""
    last, steps = parts.last_step, parts.counts[STEPS.name]
    return {
        "start": parts.start,
        "offset": parts.offset,
        "info": parts.info,
        "terminated": bool(last and last[3] == 1.0),
        "truncated": bool(last and last[4] == 1.0),
        "success": bool(last[5] == 1.0) if steps > 1 else None,
    }


def make_episode(parts: EpisodeParts) -> Episode:
    """Make an episode of what was read of it; ConfigError if it is damaged."""
    fields = describe_parts(parts)
    for group in FIELD_GROUPS:
        fields |= group.make(parts)
    return Episode(**fields)
