"""Cuts a part out of a recording, or out of another MCAP file."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import struct
from collections import deque
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, NamedTuple

from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.reading import explain_error, open_file, replace_file
from acsar_gym.recording import messages
from acsar_gym.recording.episodes import parse_array, parse_opening, parse_sealed
from acsar_gym.recording.messages import (
    ACTION,
    END_RECORD,
    EPISODE,
    EXCHANGES,
    HEADER_RECORD,
    REVOLUTIONS,
    SCANS,
    STEPS,
    TF_STATIC,
    TICKS,
    WIRE_RECEIVED,
    WIRE_SENT,
    seal_text,
)
from acsar_gym.recording.sinks import CHUNK_SIZE
from acsar_gym.recording.stream import (
    ATTACHMENT,
    CHANNEL,
    HEADER,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    SCHEMA,
    FileCut,
    RecordStream,
    parse_record,
)

NUMBER_PLACE = 20  # where the first number of a row is in its message [bytes]
MOST_ROWS = 1e15  # numbers of rows, and times, are smaller
LATCHED_MARKS = ("durability: 1\n", "transient_local")  # in a topic's quality of service


class CutResult(NamedTuple):
    """What was cut out."""

    seconds: float
    episodes: int
    """Of a recording of this package; 0 for another file."""
    damages: tuple[str, ...]
    """A line for each damaged place of the file, which was left out."""


def cut_recording(path: Path, begin: float, end: float, target: Path) -> CutResult:
    """Write a part of a recording to a new file.

    Episodes that begin before the part begin anew where it does: their info says `part`, and the
    numbers of their exchanges and steps begin with zero. What late listeners get, such as
    /tf_static, is repeated at the beginning.

    Args:
        path: the recording, or another MCAP file.
        begin: of the part, since the first reset of the recording [s].
        end: of the part [s]; infinity for all that follows.
        target: the new file.

    Raises:
        ConfigError: the file can't be read, there is nothing in that part, or the new file is there
            already or can't be written.
        MissingExtraError: mcap isn't installed.
    """
    if not 0.0 <= begin < end:
        raise ConfigError(f"--from {begin:g} --to {end:g}: must be 0 s or more, and in this order")
    if target.exists():
        raise ConfigError(f"{target}: is there already: name another file with --out")
    with open_file(path, None) as file:
        survey = Survey(file, begin)
        lasts = (survey.last - survey.first) / 1e9
        if begin > lasts:
            raise ConfigError(f"lasts {lasts:.1f} s: nothing is there from {begin:g} s on")
        last = survey.first + round(end * 1e9) if end < lasts else survey.last + 1
        span = range(survey.first + round(begin * 1e9), last)
        part = {"of": survey.digest, "from": begin, "to": None if math.isinf(end) else end}
        try:
            with replace_file(target) as new, new.open("wb") as output:
                if survey.is_ours:
                    cutter: FileCutter = RecordingCutter(output, span, survey, part)
                else:
                    cutter = FileCutter(output, span, survey)
                for opcode, content in read_records(RecordStream(file)):
                    cutter.take(opcode, content)
                cutter.finish()
        except OSError as error:
            raise ConfigError(f"{target}: can't be written: {explain_error(error)}") from error
    seconds = (min(span.stop, survey.last) - span.start) / 1e9
    return CutResult(seconds, cutter.episodes, survey.damages)


def read_records(stream: RecordStream) -> Iterator[tuple[int, bytes]]:
    """Yield all records, also of a file without its end."""
    with contextlib.suppress(FileCut):
        yield from stream


class Survey:
    """What an MCAP file holds.

    Attributes: `first` and `last`, times [ns]; `profile` and `library`, of its header; `is_ours`,
    whether it is a recording of this package; `digest`, its hash; `damages`, a line for each
    damaged place; `pose` and `revolution`, by odometry and with its channel, the newest of the
    episode when the part begins.

    Raises:
        ConfigError: it holds no message.
    """

    def __init__(self, file: BufferedReader, begin: float) -> None:
        stream = RecordStream(file)
        self.profile, self.library = "ros2", ""
        self.is_ours = False
        self.pose = [0.0, 0.0, 0.0]
        self.revolution: tuple[int, bytes] | None = None
        self._topics: dict[int, str] = {}
        self._opened = -1
        self._begin = round(begin * 1e9)
        first, self.last = 2**64, -1
        for opcode, content in read_records(stream):
            if opcode == MESSAGE:
                channel, _, time, _ = MESSAGE_HEAD.unpack_from(content)
                first, self.last = min(first, time), max(self.last, time)
                self._note(self._topics.get(channel, ""), channel, time, content[22:])
            elif opcode == METADATA:
                self.is_ours |= parse_record("Metadata", content).name == HEADER_RECORD
            elif opcode == CHANNEL:
                record = parse_record("Channel", content)
                self._topics[record.id] = record.topic
            elif opcode == HEADER:
                record = parse_record("Header", content)
                self.profile, self.library = record.profile, record.library
        if self.last < 0:
            raise ConfigError("holds no messages")
        self.first = self._opened if self._opened >= 0 else first
        self.damages = tuple(stream.damages)
        file.seek(0)
        self.digest = hashlib.file_digest(file, "sha256").hexdigest()[:16]

    def _note(self, name: str, channel: int, time: int, data: bytes) -> None:
        """Note what an episode has when the part begins."""
        if name == EPISODE.name and self._opened < 0:
            self._opened = time
        if self._opened < 0 or time >= self._opened + self._begin:
            return
        if name == EPISODE.name:
            self.pose, self.revolution = [0.0, 0.0, 0.0], None
        elif name == TICKS.name and len(data) >= NUMBER_PLACE + 40:
            self.pose = list(struct.unpack_from("<3d", data, NUMBER_PLACE + 16))
        elif name == REVOLUTIONS.name:
            self.revolution = channel, data


class FileCutter:
    """Copies the messages of a span of time, and all that isn't a message.

    Attributes: `episodes`, how many were written.
    """

    def __init__(self, output: IO[bytes], span: range, survey: Survey) -> None:
        with require_extra("recording", "record"):
            from mcap.writer import Writer  # noqa: PLC0415 - optional
        self.episodes = 0
        self._span = span
        self._writer: Any = Writer(output, chunk_size=CHUNK_SIZE)
        self._writer.start(survey.profile, survey.library)
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self._topics: dict[int, str] = {}
        self._latched: dict[int, bytes | None] = {}

    def take(self, opcode: int, content: bytes) -> None:
        """Take a record of the file; ConfigError for one that is damaged."""
        if opcode == MESSAGE:
            channel, sequence, time, published = MESSAGE_HEAD.unpack_from(content)
            if channel in self._channels:
                self._take_message(channel, sequence, time, published, content[22:])
        elif opcode == SCHEMA:
            schema = parse_record("Schema", content)
            if schema.id not in self._schemas:
                number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
                self._schemas[schema.id] = number
        elif opcode == CHANNEL:
            self._take_channel(parse_record("Channel", content))
        elif opcode == METADATA:
            self._take_metadata(parse_record("Metadata", content))
        elif opcode == ATTACHMENT:
            attachment = parse_record("Attachment", content)
            self._writer.add_attachment(
                attachment.create_time,
                attachment.log_time,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )

    def _take_channel(self, channel: Any) -> None:
        if channel.id in self._channels:
            return
        self._topics[channel.id] = channel.topic
        self._channels[channel.id] = self._writer.register_channel(
            channel.topic,
            channel.message_encoding,
            self._schemas.get(channel.schema_id, 0),
            channel.metadata,
        )
        quality = channel.metadata.get("offered_qos_profiles", "")
        if channel.topic == TF_STATIC.name or any(mark in quality for mark in LATCHED_MARKS):
            self._latched[channel.id] = None

    def _take_metadata(self, record: Any) -> None:
        self._writer.add_metadata(record.name, record.metadata)

    def _take_message(
        self, channel: int, sequence: int, time: int, published: int, data: bytes
    ) -> None:
        if time < self._span.start:
            if channel in self._latched:
                self._latched[channel] = data
        elif time in self._span:
            for latched, newest in self._latched.items():
                if newest is not None:
                    self._write(latched, self._span.start, newest, sequence, self._span.start)
            self._latched.clear()
            self._write(channel, time, data, sequence, published)

    def _write(self, channel: int, time: int, data: bytes, sequence: int, published: int) -> None:
        self._writer.add_message(self._channels[channel], time, data, published, sequence)

    def finish(self) -> None:
        """Write the end of the file."""
        self._writer.finish()


class RecordingCutter(FileCutter):
    """Copies a part of a recording of this package, so that it can be read as one."""

    def __init__(
        self, output: IO[bytes], span: range, survey: Survey, part: dict[str, Any]
    ) -> None:
        super().__init__(output, span, survey)
        self._survey = survey
        self._part = part
        self._header: dict[str, str] | None = None
        self._begin_episode(None, 0)

    def _begin_episode(self, opening: dict[str, Any] | None, channel: int) -> None:
        self._opening, self._opening_channel = opening, channel
        self._is_open = self._has_stepped = False
        self._first_exchange = self._first_step = 0.0
        self._stamp: float | None = None
        self._pieces: dict[str, deque[tuple[int, int, bytes]]] = {
            WIRE_SENT.name: deque(),
            WIRE_RECEIVED.name: deque(),
        }
        self._reset_time = -1

    def _take_metadata(self, record: Any) -> None:
        if record.name == HEADER_RECORD and self._header is None:
            with contextlib.suppress(ConfigError):  # there is a second one at the end
                header = parse_sealed(record.metadata, "header")
                self._header = seal_text("header", header | {"cut": self._part})
                self._writer.add_metadata(HEADER_RECORD, self._header)
        elif record.name not in (HEADER_RECORD, END_RECORD):
            super()._take_metadata(record)

    def _take_message(
        self, channel: int, sequence: int, time: int, published: int, data: bytes
    ) -> None:
        name = self._topics[channel]
        if name == EPISODE.name:
            self._flush_pieces()
            self._begin_episode(parse_opening(data), channel)
            if time in self._span:
                self._open_episode()
        elif name in self._pieces:
            self._pieces[name].append((channel, time, data))
        elif name == EXCHANGES.name:
            self._take_exchange(channel, time, data)
        elif name == TF_STATIC.name and not self._is_open:
            self._latched[channel] = data
        elif time in self._span and self._is_open:
            self._copy_message(name, channel, time, data)

    def _copy_message(self, name: str, channel: int, time: int, data: bytes) -> None:
        """Copy a message of the part; rows tell the new numbers of exchange and step."""
        if name in (TICKS.name, SCANS.name, REVOLUTIONS.name):
            number = read_numbers(data, 1)[0] - self._first_exchange
            if number >= 0:
                self._put(channel, time, write_number(data, number))
        elif name == STEPS.name:
            (number,) = read_numbers(data, 1)
            if not self._has_stepped:
                self._has_stepped = True
                self._first_step = number
                self._reset_time = time if number else -1
            self._put(channel, time, write_number(data, number - self._first_step))
        elif name != ACTION.name or time != self._reset_time:  # a reset has no action
            self._put(channel, time, data)

    def _take_exchange(self, channel: int, time: int, data: bytes) -> None:
        """Take the row of a control period, and the bytes that belong to it."""
        parse_array(data, 8)
        number, stamp, writes, pieces = read_numbers(data, 4)
        if time in self._span and not self._is_open:
            self._open_part(number)
        is_kept = time in self._span and self._is_open
        for name, count in ((WIRE_SENT.name, writes), (WIRE_RECEIVED.name, pieces)):
            queue = self._pieces[name]
            for _ in range(min(int(count), len(queue))):
                piece = queue.popleft()
                if is_kept:
                    self._put(*piece)
        if is_kept:
            self._put(channel, time, write_number(data, number - self._first_exchange))
        elif time < self._span.start:
            self._stamp = stamp

    def _open_episode(self) -> None:
        if self._opening is not None:
            opening = self._opening | {"episode": self.episodes}
            time = round(float(opening["start"]) * 1e9) + int(opening["offset"])
            self._is_open = True
            self.episodes += 1
            self._put(self._opening_channel, time, messages.pack_text(json.dumps(opening)))

    def _open_part(self, first_exchange: float) -> None:
        self._first_exchange = first_exchange
        if self._opening is not None and self._stamp is not None:
            self._opening = begin_anew(self._opening, self._stamp, self._survey.pose)
        self._open_episode()
        if self._is_open:
            for channel, data in self._latched.items():
                if data is not None and self._topics[channel] == TF_STATIC.name:
                    self._put(channel, self._span.start, data)
            if self._survey.revolution is not None:
                channel, data = self._survey.revolution
                self._put(channel, self._span.start, write_number(data, -1.0))

    def _flush_pieces(self) -> None:
        """Write what was sent after the last period of an episode, such as the stop at its end."""
        for queue in self._pieces.values():
            for channel, time, data in queue:
                if self._is_open and time in self._span:
                    self._put(channel, time, data)

    def _put(self, channel: int, time: int, data: bytes) -> None:
        self._write(channel, time, data, self.episodes, time)

    def finish(self) -> None:
        """Write the end of the file."""
        self._flush_pieces()
        if not self.episodes:
            raise ConfigError("holds no episode in that part")
        if self._header is not None:
            self._writer.add_metadata(HEADER_RECORD, self._header)
        self._writer.add_metadata(END_RECORD, seal_text("end", {"dropped": 0}))
        super().finish()


def begin_anew(opening: dict[str, Any], stamp: float, pose: list[float]) -> dict[str, Any]:
    """Make what begins a part of an episode."""
    info, lasted = opening["info"], stamp - opening["start"]
    before = info.get("part")
    began = before.get("from") if isinstance(before, dict) else None
    lasted_before = began if isinstance(began, int | float) else 0.0
    part = {"from": round(lasted_before + lasted, 6), "pose": pose}
    wall = opening.get("wall")
    changed = {"start": stamp, "info": info | {"part": part}}
    if isinstance(wall, int):
        changed["wall"] = wall + round(lasted * 1e9)
    return opening | changed


def read_numbers(data: bytes, count: int) -> tuple[float, ...]:
    """Return the first numbers of a row; ConfigError where one is none."""
    try:
        numbers = struct.unpack_from(f"<{count}d", data, NUMBER_PLACE)
    except struct.error as error:
        raise ConfigError("is damaged: a broken row") from error
    if not all(abs(number) < MOST_ROWS for number in numbers):
        raise ConfigError("is damaged: a row with a broken number")
    return numbers


def write_number(data: bytes, number: float) -> bytes:
    """Return a row with another first number."""
    return data[:NUMBER_PLACE] + struct.pack("<d", number) + data[NUMBER_PLACE + 8 :]


def parse_duration(text: str) -> float:
    """Parse a time such as "90", "90s", "20min", "1.5h", "1:30" or "1:02:30" [s].

    Raises:
        ConfigError: it is none.
    """
    units = {"s": 1.0, "min": 60.0, "h": 3600.0, "": 1.0}
    number = text.rstrip("minsh")
    try:
        if ":" in text:
            seconds = 0.0
            for part in text.split(":"):
                seconds = 60.0 * seconds + float(part)
        else:
            seconds = float(number) * units[text[len(number) :]]
    except (KeyError, ValueError):
        seconds = math.nan
    if not 0.0 <= seconds < math.inf:
        raise ConfigError(f"{text[:40]!r}: must be a time such as 90s, 20min, 1h or 1:02:30")
    return seconds
