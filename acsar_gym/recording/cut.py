"""Cuts a part out of a recording."""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections import deque
from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

from acsar_gym.errors import ConfigError, explain_error
from acsar_gym.reading import open_file, replace_file
from acsar_gym.recording import messages
from acsar_gym.recording.encoder import Message
from acsar_gym.recording.episodes import EpisodeCollector, parse_array, parse_opening
from acsar_gym.recording.messages import (
    ACTION,
    EPISODE,
    EXCHANGES,
    MOVERS,
    REVOLUTIONS,
    SCANS,
    STEPS,
    TF_STATIC,
    TICKS,
    TOPICS,
    WIRE_RECEIVED,
    WIRE_SENT,
    Topic,
)
from acsar_gym.recording.sinks import McapFile
from acsar_gym.recording.stream import MESSAGE, MESSAGE_HEAD, FileCut, RecordStream

NUMBER_PLACE = 20  # where the first number of a row is in its message [bytes]
MOST_ROWS = 1e15  # numbers of rows, and times, are smaller


class CutResult(NamedTuple):
    """What was cut out."""

    seconds: float
    episodes: int
    damages: tuple[str, ...]
    """A line for each damaged place of the file, which was left out."""


def cut_recording(path: Path, begin: float, end: float, target: Path) -> CutResult:
    """Write a part of a recording to a new file.

    Episodes that begin before the part begin anew where it does: their info says `part`, and the
    numbers of their exchanges and steps begin with zero.

    Args:
        path: the recording.
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
    with open_file(path) as file:
        survey = Survey(file, begin)
        lasts = (survey.last - survey.first) / 1e9
        if begin > lasts:
            raise ConfigError(f"lasts {lasts:.1f} s: nothing is there from {begin:g} s on")
        last = survey.first + round(end * 1e9) if end < lasts else survey.last + 1
        span = range(survey.first + round(begin * 1e9), last)
        part = {"of": survey.digest, "from": begin, "to": None if math.isinf(end) else end}
        try:
            with replace_file(target) as new:
                output = McapFile(new, {**survey.header, "cut": part})
                try:
                    cutter = Cutter(output, span, survey)
                    for topic, time, data in read_messages(file, EpisodeCollector(TOPICS)):
                        cutter.take(topic, time, data)
                    cutter.finish()
                finally:
                    output.abandon()
        except OSError as error:
            raise ConfigError(f"{target}: can't be written: {explain_error(error)}") from error
    seconds = (min(span.stop, survey.last) - span.start) / 1e9
    return CutResult(seconds, cutter.episodes, survey.damages)


def read_messages(
    file: BufferedReader, collector: EpisodeCollector
) -> Iterator[tuple[Topic, int, bytes]]:
    """Yield topics, times [ns] and data of all messages; the collector gets what isn't one."""
    stream = RecordStream(file)
    try:
        for opcode, content in stream:
            if opcode != MESSAGE:
                collector.take(opcode, content)
                continue
            channel, _, time, _ = MESSAGE_HEAD.unpack_from(content)
            if channel in collector.topics:
                yield collector.topics[channel], time, content[MESSAGE_HEAD.size :]
    except FileCut:
        pass
    collector.damages += stream.damages


class Survey:
    """What a recording holds.

    Attributes: `first` and `last`, times [ns]; `header`; `digest`, hash of the file; `damages`, a
    line for each damaged place; `pose` and `revolution`, by odometry and as it was recorded, the
    newest of the episode when the part begins.

    Raises:
        ConfigError: it isn't a recording, or holds no message.
    """

    def __init__(self, file: BufferedReader, begin: float) -> None:
        self.pose = [0.0, 0.0, 0.0]
        self.revolution: bytes | None = None
        self.first = self.last = -1
        collector = EpisodeCollector(TOPICS)
        for topic, time, data in read_messages(file, collector):
            self.last = max(self.last, time)
            if topic is EPISODE and self.first < 0:
                self.first = time
            if self.first >= 0 and time < self.first + round(begin * 1e9):
                self._note(topic, data)
        if collector.header is None:
            raise ConfigError(collector.problem or "isn't a recording of acsar_gym")
        if self.first < 0:
            raise ConfigError("holds no episode")
        self.header = collector.header
        self.damages = tuple(collector.damages)
        file.seek(0)
        self.digest = hashlib.file_digest(file, "sha256").hexdigest()[:16]

    def _note(self, topic: Topic, data: bytes) -> None:
        if topic is EPISODE:
            self.pose, self.revolution = [0.0, 0.0, 0.0], None
        elif topic is TICKS and len(data) >= NUMBER_PLACE + 40:
            self.pose = list(struct.unpack_from("<3d", data, NUMBER_PLACE + 16))
        elif topic is REVOLUTIONS:
            self.revolution = data


class Cutter:
    """Copies the messages of a span of time so that they can be read as a recording.

    Attributes: `episodes`, how many were written.
    """

    def __init__(self, output: McapFile, span: range, survey: Survey) -> None:
        self.episodes = 0
        self._output = output
        self._span = span
        self._survey = survey
        self._static: bytes | None = None
        self._begin_episode(None)

    def _begin_episode(self, opening: dict[str, Any] | None) -> None:
        self._opening = opening
        self._is_open = self._has_stepped = False
        self._first_exchange = self._first_step = 0.0
        self._stamp: float | None = None
        self._pieces: dict[Topic, deque[tuple[int, bytes]]] = {
            WIRE_SENT: deque(),
            WIRE_RECEIVED: deque(),
        }
        self._reset_time = -1

    def take(self, topic: Topic, time: int, data: bytes) -> None:
        """Take a message; ConfigError for one that is damaged."""
        if topic is EPISODE:
            self._flush_pieces()
            self._begin_episode(parse_opening(data))
            if time in self._span:
                self._open_episode()
        elif topic in self._pieces:
            self._pieces[topic].append((time, data))
        elif topic is EXCHANGES:
            self._take_exchange(time, data)
        elif topic is TF_STATIC and not self._is_open:
            self._static = data
        elif time in self._span and self._is_open:
            self._copy_message(topic, time, data)

    def _copy_message(self, topic: Topic, time: int, data: bytes) -> None:
        """Copy a message of the part; rows tell the new numbers of exchange and step."""
        if topic in (TICKS, SCANS, REVOLUTIONS, MOVERS):
            number = read_numbers(data, 1)[0] - self._first_exchange
            if number >= 0:
                self._put(topic, time, write_number(data, number))
        elif topic is STEPS:
            (number,) = read_numbers(data, 1)
            if not self._has_stepped:
                self._has_stepped = True
                self._first_step = number
                self._reset_time = time if number else -1
            self._put(topic, time, write_number(data, number - self._first_step))
        elif topic is not ACTION or time != self._reset_time:  # a reset has no action
            self._put(topic, time, data)

    def _take_exchange(self, time: int, data: bytes) -> None:
        """Take the row of a control period, and the bytes that belong to it."""
        parse_array(data, 8)
        number, stamp, writes, pieces = read_numbers(data, 4)
        if time in self._span and not self._is_open:
            self._open_part(number)
        is_kept = time in self._span and self._is_open
        for topic, count in ((WIRE_SENT, writes), (WIRE_RECEIVED, pieces)):
            queue = self._pieces[topic]
            for _ in range(min(int(count), len(queue))):
                piece = queue.popleft()
                if is_kept:
                    self._put(topic, *piece)
        if is_kept:
            self._put(EXCHANGES, time, write_number(data, number - self._first_exchange))
        elif time < self._span.start:
            self._stamp = stamp

    def _open_episode(self) -> None:
        if self._opening is not None:
            opening = self._opening | {"episode": self.episodes}
            time = round(float(opening["start"]) * 1e9) + int(opening["offset"])
            self._is_open = True
            self.episodes += 1
            self._put(EPISODE, time, messages.pack_text(json.dumps(opening)))

    def _open_part(self, first_exchange: float) -> None:
        self._first_exchange = first_exchange
        if self._opening is not None and self._stamp is not None:
            self._opening = begin_anew(self._opening, self._stamp, self._survey.pose)
        self._open_episode()
        if self._is_open:
            if self._static is not None:
                self._put(TF_STATIC, self._span.start, self._static)
            if self._survey.revolution is not None:
                turn = write_number(self._survey.revolution, -1.0)
                self._put(REVOLUTIONS, self._span.start, turn)

    def _flush_pieces(self) -> None:
        """Write what was sent after the last period of an episode, such as the stop at its end."""
        for topic, queue in self._pieces.items():
            for time, data in queue:
                if self._is_open and time in self._span:
                    self._put(topic, time, data)

    def _put(self, topic: Topic, time: int, data: bytes) -> None:
        self._output.add(Message(topic, time, data))

    def finish(self) -> None:
        """Write the end of the file."""
        self._flush_pieces()
        if not self.episodes:
            raise ConfigError("holds no episode in that part")
        self._output.close(0)


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
    """Parse a time such as "90", "20min", "1.5h" or "1:02:30" [s]; ConfigError for none."""
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
