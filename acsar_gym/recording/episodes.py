"""Makes episodes of a recording's messages."""

from __future__ import annotations

import math
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from acsar_gym.config.section import Section
from acsar_gym.errors import ConfigError
from acsar_gym.reading import parse_json
from acsar_gym.recording import messages
from acsar_gym.recording.messages import (
    ARRAY_HEADER,
    DOUBLES_TYPE,
    END_RECORD,
    EXCHANGES,
    HEADER_RECORD,
    RECORDING_FORMAT,
    REVOLUTIONS,
    SCANS,
    STEPS,
    TICKS,
    Topic,
    is_sealed,
)
from acsar_gym.recording.stream import (
    CHANNEL,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    parse_record,
)
from acsar_gym.recording.types import (
    MAX_DISTANCE,
    MAX_STAMP,
    Episode,
    Exchanges,
    Floats,
    Pieces,
    Revolutions,
    Scans,
    WireLog,
)

MAX_EPISODES = 50_000
"""Most episodes; one that isn't kept takes 3 kB of memory."""
MAX_OPENINGS = 10_000_000
"""Most bytes of what begins the episodes; of JSON, which takes 25 times the memory."""
MAX_DESCRIBED = 4_000_000
"""Most bytes of channels and metadata, which are slow to read; a recording's are 30,000."""
MAX_BEARING = 100.0
"""Largest bearing of a LiDAR's measurement, either sign [rad]."""
MAX_OFFSET = 2**62
"""Largest offset of an episode, either sign [ns]; times of the file then fit into 64 bits."""
COMPACT_PIECES = 100_000
"""From so many on, pieces of bytes stay in one buffer."""
TOO_MUCH = "holds more episodes than can be read: record fewer to a file"

TABLE_TOPICS = EXCHANGES, TICKS, STEPS
LIST_TOPICS = (
    *(messages.WIRE_SENT, messages.WIRE_RECEIVED, SCANS, messages.OBSERVATION, messages.ACTION),
)
ELEMENT_SIZES = {DOUBLES_TYPE: 8, messages.SINGLES_TYPE: 4, messages.OCTETS_TYPE: 1}
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
    """Content and times of a topic's messages.

    Attributes: `data`, all content; `ends`, where that of each message ends; `times` [ns].
    """

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

    def rows(self, kind: str, least: int) -> NDArray[Any]:
        """Messages of one length, at least so many numbers each, (n, length)."""
        if not self.ends:
            return np.zeros((0, least), kind)
        lengths = np.diff(np.frombuffer(self.ends, np.uint64), prepend=np.uint64(0))
        itemsize = np.dtype(kind).itemsize
        if (lengths != lengths[0]).any() or lengths[0] < least * itemsize:
            raise ConfigError("is damaged: scans, observations or actions of several lengths")
        return np.frombuffer(self.data, kind).reshape(len(lengths), -1)


class ChunkPlace(NamedTuple):
    """Where messages of an episode are: the place of a record, and what came before it."""

    at: int
    episode: int
    sequence: int
    exchange: float


class EpisodeParts:
    """What was read of one episode so far.

    Attributes: `start` [s], `offset` [ns], `info`; `tables`, the rows of each table; `lists`,
    messages of the other topics; `places`, where they are in the file; `counts` and `sizes`
    [bytes], by topic, also of what was forgotten; `last_step`, the newest row of that table; `end`,
    time of the last exchange [s]; `missing`, numbers of exchanges that weren't there; `simulated`,
    whether the truth is known; `newest`, times of the tables' last rows [s].
    """

    def __init__(self, opening: EpisodeOpening | None) -> None:
        self.is_lost = opening is None  # then it begins with what is there
        self.start, self.offset = (opening.start, opening.offset) if opening else (math.nan, 0)
        self.info: Mapping[str, Any] = opening.info if opening else {}
        self.places: list[ChunkPlace] = []
        self.counts: Counter[str] = Counter()
        self.sizes: Counter[str] = Counter()
        self.last_step: tuple[float, ...] = ()
        self.end = self.start
        self.highest = -1.0
        self.newest: dict[str, float] = {}
        self.simulated = False
        self.forget()

    def forget(self) -> None:
        """Forget what was read, but not how much it was."""
        self.tables: dict[str, bytearray] = {topic.name: bytearray() for topic in TABLE_TOPICS}
        self.lists: dict[str, PieceBuffer] = {}

    @property
    def missing(self) -> int:
        """Exchanges that aren't there."""
        return max(int(self.highest) + 1 - self.counts[EXCHANGES.name], 0)

    def add(self, topic: Topic, time: int, data: bytes) -> None:
        """Take a message; ConfigError for one that is damaged."""
        name = topic.name
        size = ELEMENT_SIZES.get(topic.kind)
        content = parse_array(data, size) if size else data
        self.counts[name] += 1
        self.sizes[name] += len(content)
        table = self.tables.get(name)
        if table is None:
            if name not in self.lists:
                self.lists[name] = PieceBuffer()
            self.lists[name].add(time, content)
            return
        if len(content) != 8 * len(topic.columns):
            raise ConfigError(f"is damaged: a broken row of {name}")
        table += content
        number, stamp = _NUMBER_AND_STAMP.unpack_from(content)
        self.newest[name] = stamp
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
        rows = np.frombuffer(self.tables[topic.name], "<f8").reshape(-1, len(topic.columns))
        rows = rows.astype(np.float64, copy=False)
        stamps = check_stamps(rows[:, 1])
        if len(stamps) and (stamps[0] < self.start or (np.diff(stamps) < 0.0).any()):
            raise ConfigError("is damaged: its times go backwards")
        return rows

    def pieces(self, topic: Topic) -> PieceBuffer:
        """The messages of a topic that isn't a table."""
        return self.lists.get(topic.name) or PieceBuffer()

    def take_table(self, topic: Topic) -> Floats:
        """Return the rows of a table, and forget them."""
        data, self.tables[topic.name] = self.tables[topic.name], bytearray()
        return np.frombuffer(data, "<f8").reshape(-1, len(topic.columns))

    def take_list(self, topic: Topic) -> tuple[list[int], list[bytes]]:
        """Return times [ns] and content of a topic's messages, and forget them."""
        buffer = self.lists.pop(topic.name, PieceBuffer())
        return buffer.times.tolist(), list(Pieces(buffer.data, buffer.ends))


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


def parse_mapping(text: str) -> dict[str, Any]:
    """Parse JSON that must be a mapping."""
    mapping = parse_json(text)
    if not isinstance(mapping, dict):
        raise ConfigError("is damaged: its header is no mapping")
    return mapping


Parsed = TypeVar("Parsed", bound=Section)


def parse_section(kind: type[Parsed], mapping: dict[str, Any]) -> Parsed:
    """Parse a mapping of a file; ConfigError where a field is missing or wrong."""
    try:
        return kind.model_validate(mapping)
    except ConfigError as error:
        raise ConfigError(f"is damaged: {error}") from error


class EpisodeCollector:
    """Collects the episodes of a file.

    Attributes: `header` and `end`, None until they were read; `parts`, the episodes; `topics`, by
    the numbers of the channels that are wanted; `kept`, bytes that are in memory; `is_whole`,
    whether nothing was forgotten; `is_damaged`, whether chunks are left out; `damages`, a line for
    each record that isn't what was written; `problem`, what is wrong with a header that was left
    out.

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
        self.damages: list[str] = []
        self.problem = ""
        self._wanted = {topic.name: topic for topic in (messages.EPISODE, *wanted)}
        self._openings = self._described = 0
        self.is_whole = True
        self.is_damaged = False
        self._only: tuple[int, EpisodeParts, Container[Topic]] | None = None
        self._current: EpisodeParts | None = None
        self._at = -1
        self._place = ChunkPlace(-1, -1, 0, -1.0)
        self._episode, self._sequence, self._exchange = -1, 0, -1.0

    def forget(self) -> None:
        """Forget the content of all episodes."""
        for parts in self.parts:
            parts.forget()
        self.kept = 0
        self.is_whole = False

    def begin_again(
        self, place: ChunkPlace, number: int, parts: EpisodeParts, topics: Container[Topic]
    ) -> None:
        """Read a chunk again, of one episode only.

        Args:
            place: of the chunk.
            number: of the episode.
            parts: takes its messages.
            topics: whose messages it takes.
        """
        self._episode, self._sequence, self._exchange = place[1:]
        self._only = number, parts, topics
        self._current = parts if self._episode == number else None

    def take(self, opcode: int, content: bytes, at: int = 0) -> None:
        """Take a record; `at` is the place of it or its chunk in the file."""
        if opcode == MESSAGE:
            self._take_message(content, at)
        elif opcode in (CHANNEL, METADATA):
            self._described += len(content)
            if self._described > MAX_DESCRIBED:
                raise ConfigError("is damaged: too many channels or metadata")
            if opcode == CHANNEL:
                self._take_channel(parse_record("Channel", content))
            else:
                self._take_metadata(parse_record("Metadata", content))

    def _take_channel(self, channel: Any) -> None:
        topic = self._wanted.get(channel.topic)
        self.topics.pop(channel.id, None)
        if topic is not None:
            columns = channel.metadata.get("columns", "")
            if topic in TABLE_TOPICS and columns.split(",") != list(topic.columns):
                raise ConfigError(
                    f"{topic.name} has other columns: it was recorded by another version"
                )
            self.topics[channel.id] = topic

    def _take_metadata(self, record: Any) -> None:
        if record.name == HEADER_RECORD and self.header is None:
            text = record.metadata.get("header", "")
            if not is_sealed(text, record.metadata):
                self.problem = "is damaged: a header with a wrong checksum"
                return
            try:
                header = parse_mapping(text)
                if header.get("format") == RECORDING_FORMAT:
                    parse_section(RecordingHeader, header)
            except ConfigError as error:  # a second one is at the end
                self.problem = self.problem or str(error)
                return
            if header.get("format") != RECORDING_FORMAT:
                raise ConfigError(
                    f"is a recording of format {str(header.get('format'))[:20]}: "
                    f"this version reads format {RECORDING_FORMAT}"
                )
            self.header = header
            if self.problem:
                self.damages.append("the first header")
        elif record.name == END_RECORD and self.end is None:
            text = record.metadata.get("end", "")
            if is_sealed(text, record.metadata):
                self.end = parse_mapping(text)
            else:
                self.end = {}
                self.damages.append("the number of drops")

    def _take_message(self, content: bytes, at: int) -> None:
        try:
            channel, sequence, time, _ = MESSAGE_HEAD.unpack_from(content)
        except struct.error as error:
            raise ConfigError("is damaged: a broken message") from error
        topic = self.topics.get(channel)
        if topic is None:
            return
        if at != self._at:
            self._at = at
            self._place = ChunkPlace(at, self._episode, self._sequence, self._exchange)
        data = content[MESSAGE_HEAD.size :]
        if topic is messages.EPISODE:
            self._sequence = sequence
            self._open_episode(data)
            return
        if sequence != self._sequence:  # the opening is lost
            self._sequence = sequence
            self._open_episode(None)
        if topic in TABLE_TOPICS and len(data) >= 36:
            self._look_at_row(topic, sequence, *_NUMBER_AND_STAMP.unpack_from(data, 20))
        parts = self._current
        if parts is None or (self._only is not None and topic not in self._only[2]):
            return
        self.kept += len(data) + 16
        parts.add(topic, time, data)
        if self._only is None and (not parts.places or parts.places[-1].at != at):
            parts.places.append(self._place)

    def _look_at_row(self, topic: Topic, sequence: int, number: float, stamp: float) -> None:
        """Begin an episode where a row of an older version's file is of one with a lost opening."""
        if self._current is not None:
            newest = self._current.newest.get(topic.name, -math.inf)
            begins = self.is_damaged and stamp < newest
        else:
            begins = self.is_damaged and self._only is None
        if not sequence and (begins or (topic is EXCHANGES and number < self._exchange)):
            self._open_episode(None)
        if topic is EXCHANGES:
            self._exchange = number

    def _open_episode(self, data: bytes | None) -> None:
        """Begin an episode; None where its opening is lost."""
        self._episode += 1
        self._exchange = -1.0
        if self._only is not None:
            number, parts, _ = self._only
            self._current = parts if self._episode == number else None
            return
        opening = None
        if data is not None:
            self._openings += len(data)
            opening = parse_section(
                EpisodeOpening, parse_mapping(data[8:-1].decode("ascii", "replace"))
            )
        if len(self.parts) >= MAX_EPISODES or self._openings > MAX_OPENINGS:
            raise ConfigError(TOO_MUCH)
        self._current = EpisodeParts(opening)
        self.parts.append(self._current)


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
    found = Exchanges(
        to_integers(rows[:, 0]),
        rows[:, 1],
        to_integers(rows[:, 2]),
        to_integers(rows[:, 3]),
        rows[:, 4],
        rows[:, 5:],
    )
    return {"exchanges": found}


def make_wire(parts: EpisodeParts) -> dict[str, Any]:
    """The bytes of the wire."""
    fields: list[Any] = []
    for topic in (messages.WIRE_SENT, messages.WIRE_RECEIVED):
        buffer = parts.pieces(topic)
        pieces: Sequence[bytes] = Pieces(buffer.data, buffer.ends)
        if len(pieces) < COMPACT_PIECES:
            pieces = tuple(pieces)
        fields += [buffer.stamps(parts.offset), pieces]
    return {"wire": WireLog(*fields)}


def make_steps(parts: EpisodeParts) -> dict[str, Any]:
    """What an env recorded."""
    steps = parts.table(STEPS)
    actions = parts.pieces(messages.ACTION).rows("<f4", 0)
    observations = parts.pieces(messages.OBSERVATION).rows("<f4", 0)[: len(steps)]
    return {
        "observations": observations.astype(np.float32, copy=False),
        "actions": actions.astype(np.float32) if len(actions) else np.zeros((0, 2), np.float32),
        "rewards": steps[1:, 2],
        "step_stamps": steps[:, 1],
    }


def make_scans(parts: EpisodeParts) -> dict[str, Any]:
    """The scans of a LiDAR."""
    scans = parts.pieces(SCANS).rows("<f8", 2)
    if not np.isfinite(scans).all():
        raise ConfigError("is damaged: a scan that isn't finite")
    return {"scans": Scans(check_stamps(scans[:, 1]), scans[:, 2:], to_integers(scans[:, 0]))}


def make_revolutions(parts: EpisodeParts) -> dict[str, Any]:
    """What a LiDAR measured."""
    buffer = parts.pieces(REVOLUTIONS)
    rows = [parse_revolution(data) for data in Pieces(buffer.data, buffer.ends)]
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


@dataclass(frozen=True)
class FieldGroup:
    """Fields of an episode that are made together, and the topics that they are made of."""

    topics: tuple[Topic, ...]
    make: Callable[[EpisodeParts], dict[str, Any]]
    fields: tuple[str, ...]


FIELD_GROUPS = (
    FieldGroup(
        (TICKS,),
        make_ticks,
        ("stamps", "poses", "twists", "speeds", "asked", "sent", "reasons", "lateness"),
    ),
    FieldGroup((TICKS, EXCHANGES), make_truth, ("truth",)),
    FieldGroup((EXCHANGES,), make_exchanges, ("exchanges",)),
    FieldGroup((messages.WIRE_SENT, messages.WIRE_RECEIVED), make_wire, ("wire",)),
    FieldGroup(
        (STEPS, messages.OBSERVATION, messages.ACTION),
        make_steps,
        ("observations", "actions", "rewards", "step_stamps"),
    ),
    FieldGroup((SCANS,), make_scans, ("scans",)),
    FieldGroup((REVOLUTIONS,), make_revolutions, ("revolutions",)),
)


def describe_parts(parts: EpisodeParts) -> dict[str, Any]:
    """Fields of an episode that are known without its tables."""
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
    """Make an episode of what was read of it.

    Raises:
        ConfigError: it is damaged.
    """
    fields = describe_parts(parts)
    for group in FIELD_GROUPS:
        fields |= group.make(parts)
    return Episode(**fields)


def check_stamps(stamps: Floats) -> Floats:
    """Return times [s]; ConfigError where one is out of range or no number."""
    if not (np.abs(stamps) <= MAX_STAMP).all():
        raise ConfigError("is damaged: a time that is out of range")
    return stamps


def to_integers(numbers: Floats) -> NDArray[np.int64]:
    """Numbers of a file as integers, whatever they are."""
    return np.nan_to_num(np.clip(numbers, -1e15, 1e15)).astype(np.int64)
