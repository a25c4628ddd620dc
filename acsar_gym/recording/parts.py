"""The episodes of a recording, put together from its messages."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.reading import structured
from acsar_gym.recording import topics
from acsar_gym.recording.types import Episode, Exchanges, Scans
from acsar_gym.recording.wire_log import Floats, WireLog

MOST_TIME = 4e9
"""Largest time on a link's clock, either sign [s]: 126 years."""
MOST_OFFSET = 2**62
"""Largest offset of an episode, either sign [ns]; times of the file then fit into 64 bits."""
_ARRAY = struct.Struct("<4sIII")
"""Encapsulation, no dimensions, no offset, number of elements."""


class Part:
    """What was read of one episode so far."""

    def __init__(self, told: dict[str, Any]) -> None:
        self.told = told
        self.start, self.offset = float(told["start"]), int(told["offset"])
        self.sent: list[bytes] = []
        self.got: list[bytes] = []
        self.sent_times: list[int] = []
        self.got_times: list[int] = []
        self.tables: dict[str, bytearray] = {topic.name: bytearray() for topic in TABLES}
        self.scans: list[bytes] = []
        self.observations: list[bytes] = []
        self.actions: list[bytes] = []


Take = Callable[[Part, int, bytes], None]


def mapping(text: str) -> dict[str, Any]:
    """Parse JSON that must be a mapping."""
    found = structured.from_json(text)
    if not isinstance(found, dict):
        raise ConfigError("is damaged: its header is no mapping")
    return found


def opening(data: bytes) -> dict[str, Any]:
    """Parse what begins an episode."""
    told = mapping(data[8:-1].decode("ascii", "replace"))
    start, offset = told.get("start"), told.get("offset")
    sound = isinstance(start, int | float) and abs(start) <= MOST_TIME
    sound = sound and isinstance(offset, int) and abs(offset) <= MOST_OFFSET
    if not sound or not isinstance(told.get("info"), dict):
        raise ConfigError("is damaged: a broken episode")
    return told


def _payload(data: bytes, size: int) -> bytes:
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


def begin(part: Part, time: int, data: bytes) -> None:
    """Begin an episode; `_Reader` does it."""


def _sent(part: Part, time: int, data: bytes) -> None:
    part.sent_times.append(time)
    part.sent.append(_payload(data, 1))


def _got(part: Part, time: int, data: bytes) -> None:
    part.got_times.append(time)
    part.got.append(_payload(data, 1))


def _row(name: str, columns: int) -> Take:
    """A taker for the rows of a table."""

    def take(part: Part, time: int, data: bytes) -> None:
        row = _payload(data, 8)
        if len(row) != 8 * columns:
            raise ConfigError(f"is damaged: a broken row of {name}")
        part.tables[name] += row

    return take


def _scan(part: Part, time: int, data: bytes) -> None:
    part.scans.append(_payload(data, 8))


def _observation(part: Part, time: int, data: bytes) -> None:
    part.observations.append(_payload(data, 4))


def _action(part: Part, time: int, data: bytes) -> None:
    part.actions.append(_payload(data, 4))


TABLES = topics.EXCHANGES, topics.TICKS, topics.STEPS
TAKERS: dict[str, Take] = {
    topics.EPISODE.name: begin,
    topics.WIRE_SENT.name: _sent,
    topics.WIRE_RECEIVED.name: _got,
    topics.SCANS.name: _scan,
    topics.OBSERVATION.name: _observation,
    topics.ACTION.name: _action,
    **{topic.name: _row(topic.name, len(topic.columns)) for topic in TABLES},
}


def made(part: Part) -> Episode:
    """Make an episode of what was read."""
    exchanges, ticks, steps = (_table(part, topic) for topic in TABLES)
    for table in (exchanges, ticks, steps):
        _check_times(table[:, 1], part.start)
    number, actions = len(steps), _stacked(part.actions, np.float32)
    return Episode(
        start=part.start,
        offset=part.offset,
        wire=_wire(part),
        stamps=ticks[:, 1],
        poses=ticks[:, 2:5],
        twists=ticks[:, 5:7],
        speeds=ticks[:, 7:11],
        asked=ticks[:, 15:17],
        sent=ticks[:, 17:19],
        reasons=_whole(ticks[:, 19]),
        lateness=ticks[:, 20],
        truth=_truth_of(ticks, exchanges),
        observations=_stacked(part.observations[:number], np.float32),
        actions=actions if len(actions) else np.zeros((0, 2), np.float32),
        rewards=steps[1:, 2],
        terminated=bool(number and steps[-1, 3] == 1.0),
        success=bool(steps[-1, 5] == 1.0) if number > 1 else None,
        step_stamps=steps[:, 1],
        scans=_scans(part.scans),
        exchanges=_exchanges(exchanges),
        info=part.told["info"],
    )


def _wire(part: Part) -> WireLog:
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
    times = np.concatenate([[start], _in_range(stamps)])
    if (np.diff(times) < 0.0).any():
        raise ConfigError("is damaged: its times go backwards")


def _in_range(stamps: Floats) -> Floats:
    """Return times [s]; ConfigError where one is out of range or no number."""
    if not (np.abs(stamps) <= MOST_TIME).all():
        raise ConfigError("is damaged: a time that is out of range")
    return stamps


def _table(part: Part, topic: topics.Topic) -> Floats:
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


def missing(part: Part) -> int:
    """How many exchanges of an episode are missing."""
    rows = _table(part, topics.EXCHANGES)
    return int(max(_whole(rows[:, 0]).max() + 1 - len(rows), 0)) if len(rows) else 0


def _stamps(times: list[int], offset: int) -> Floats:
    """Times of the file on the link's clock [s]."""
    return _in_range(np.array([time - offset for time in times], np.float64) / 1e9)


def _stacked(rows: list[bytes], kind: type[np.float32]) -> NDArray[np.float32]:
    """Rows of one length, (n, length)."""
    if not rows:
        return np.zeros((0, 0), kind)
    if any(len(row) != len(rows[0]) for row in rows):
        raise ConfigError("is damaged: observations or actions of several lengths")
    return np.frombuffer(b"".join(rows), "<f4").reshape(len(rows), -1).astype(kind, copy=False)


def _scans(rows: list[bytes]) -> Scans:
    """The scans of an episode."""
    if not rows:
        return Scans(np.zeros(0), np.zeros((0, 0)), np.zeros(0, np.int64))
    if len(rows[0]) < 16 or any(len(row) != len(rows[0]) for row in rows):
        raise ConfigError("is damaged: scans of several lengths")
    table = np.frombuffer(b"".join(rows), "<f8").reshape(len(rows), -1)
    if not np.isfinite(table).all():
        raise ConfigError("is damaged: a scan that isn't finite")
    return Scans(_in_range(table[:, 1]).copy(), table[:, 2:].copy(), _whole(table[:, 0]))
