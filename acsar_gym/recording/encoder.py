"""Turns what the control loop hands over into ROS 2 messages, a batch at a time."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.recording import formats, topics
from acsar_gym.recording.covariance import Covariance
from acsar_gym.recording.diagnostics import Diagnostics
from acsar_gym.recording.events import (
    Began,
    Clock,
    Event,
    Exchange,
    Fault,
    Pieces,
    Scanned,
    Stepped,
    Tick,
    Written,
)
from acsar_gym.recording.header import plain
from acsar_gym.recording.layouts import NANOSECONDS, Packer, times
from acsar_gym.recording.topics import Topic
from acsar_gym.recording.transforms import static_transforms, time_reference
from acsar_gym.worlds.geometry import RaySpec

GAP = 1_000_000
"""Time between two episodes whose clocks both begin at zero [ns]."""
NO_TRUTH = (math.nan,) * 6


class Message(NamedTuple):
    """One message of a topic."""

    topic: Topic
    time: int
    """Nanoseconds on the file's time line: the wall clock at the first reset, and from there on the
    link's clock."""
    data: bytes


class Encoder:
    """Makes messages of events.

    Args:
        config: of the robot.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._formats = formats.Formats.of(config)
        self._covariance = Covariance(config)
        self._diagnostics = Diagnostics(config)
        self._static = static_transforms(config)
        self._offset = 0
        self._newest = -1
        self._episode = -1
        self._makers: dict[Any, Callable[[Any], Iterator[Message]]] = {
            Began: self._began,
            Exchange: self._exchanges,
            Written: self._written,
            Tick: self._ticks,
            Scanned: self._scans,
            Stepped: self._steps,
            Fault: self._faults,
            Clock: self._clocks,
        }

    def encode(self, events: Sequence[Event], dropped: int) -> Iterator[Message]:
        """Make the messages of some events, in the order in which they happened.

        Args:
            events: what was handed over since the last call.
            dropped: events that were dropped so far.
        """
        self._diagnostics.dropped = dropped
        for episode in _episodes(events):
            by_kind: dict[Any, list[Any]] = {}
            for event in episode:
                by_kind.setdefault(type(event), []).append(event)
            for kind, make in self._makers.items():
                if kind in by_kind:
                    for message in make(by_kind[kind]):
                        self._newest = max(self._newest, message.time)
                        yield message

    def _began(self, events: Sequence[Began]) -> Iterator[Message]:
        """Begin an episode; its clock may have started again at zero."""
        (event,) = events
        start = round(event.stamp * NANOSECONDS)
        if self._newest < 0:
            self._offset = event.wall - start
        elif start + self._offset <= self._newest:
            self._offset = self._newest + GAP - start
        self._episode += 1
        self._covariance.reset()
        self._diagnostics.reset(event.stamp)
        time = start + self._offset
        told = {"episode": self._episode, "start": event.stamp, "offset": self._offset}
        text = json.dumps(told | {"wall": event.wall, "info": plain(dict(event.info))})
        yield Message(topics.EPISODE, time, formats.text(text))
        yield Message(topics.TF_STATIC, time, self._static(time))
        yield self._reference(Clock(event.stamp, event.wall))

    def _exchanges(self, events: Sequence[Exchange]) -> Iterator[Message]:
        """The raw wire, the truth, and the row that says which bytes belong together."""
        for event in events:
            yield from self._pieces(topics.WIRE_SENT, event.sent)
            yield from self._pieces(topics.WIRE_RECEIVED, event.received)
        rows = np.array([_exchange_row(event) for event in events])
        yield from self._table(topics.EXCHANGES, self._formats.exchanges, rows[:, 1], rows)
        known = rows[~np.isnan(rows[:, 5])]
        if len(known):
            when = self._times(known[:, 1])
            fields = times(when) | formats.pose_fields(known[:, 5:8])
            fields |= formats.twist_fields(known[:, 8:10])
            yield from _messages(topics.TRUTH, self._formats.truth, when, fields)

    def _written(self, events: Sequence[Written]) -> Iterator[Message]:
        """Bytes that were sent at the end."""
        for event in events:
            yield from self._pieces(topics.WIRE_SENT, event.sent)

    def _pieces(self, topic: Topic, pieces: Pieces) -> Iterator[Message]:
        """Bytes of the wire."""
        for stamp, data in pieces:
            yield Message(topic, self._time(stamp), formats.octets(data))

    def _ticks(self, events: Sequence[Tick]) -> Iterator[Message]:
        """Odometry, joints, commands, and the row with all of it."""
        rows = np.array([_tick_row(event) for event in events])
        stamps, own = rows[:, 1], self._formats
        when = self._times(stamps)
        stamped, pose = times(when), formats.pose_fields(rows[:, 2:5])
        pose_cov, twist_cov = self._covariance.of(stamps, rows[:, 5:7])
        fields: dict[str, Any] = stamped | pose | formats.twist_fields(rows[:, 5:7])
        fields |= {"pose_cov": pose_cov, "twist_cov": twist_cov}
        yield from _messages(topics.ODOM, own.odometry, when, fields)
        yield from _messages(topics.TF, own.transform, when, stamped | pose)
        joints = stamped | {"position": rows[:, 11:15], "velocity": rows[:, 7:11]}
        yield from _messages(topics.JOINT_STATES, own.joints, when, joints)
        yield from _messages(
            topics.CMD_VEL_SENT, own.twist, when, formats.twist_fields(rows[:, 17:19])
        )
        is_asked = ~np.isnan(rows[:, 15])
        asked = formats.twist_fields(rows[is_asked, 15:17])
        yield from _messages(topics.CMD_VEL, own.twist, when[is_asked], asked)
        yield from self._table(topics.TICKS, own.ticks, stamps, rows)
        for stamp, data in self._diagnostics.ticked(events, self._time):
            yield Message(topics.DIAGNOSTICS, self._time(stamp), data)

    def _scans(self, events: Sequence[Scanned]) -> Iterator[Message]:
        """Scans, for viewers and exactly."""
        lidar = self._config.lidar
        for event in events:
            ranges = np.asarray(event.ranges, np.float64)
            time, rays = self._time(event.stamp), len(ranges)
            step = RaySpec(rays, lidar.max_range, lidar.field_of_view).step
            packer = formats.laser_scan(self._config, step, rays)
            seen = np.where(ranges >= lidar.max_range, np.inf, ranges)
            when = np.array([time])
            yield from _messages(topics.SCAN, packer, when, times(when) | {"ranges": seen})
            row = np.concatenate([[event.exchange, event.stamp], ranges])
            exact = {"data": row}
            yield from _messages(topics.SCANS, formats.doubles(len(row)), when, exact)

    def _steps(self, events: Sequence[Stepped]) -> Iterator[Message]:
        """Observations, actions and rewards."""
        for event in events:
            when = np.array([self._time(event.stamp)])
            row = np.array([[event.step, event.stamp, event.reward, *event[5:]]], np.float64)
            yield from self._table(topics.STEPS, self._formats.steps, row[:, 1], row)
            for topic, values in (
                (topics.ACTION, event.action),
                (topics.OBSERVATION, event.observation),
            ):
                if values is not None:
                    data = np.asarray(values, np.float32).ravel()
                    yield from _messages(topic, formats.singles(len(data)), when, {"data": data})

    def _faults(self, events: Sequence[Fault]) -> Iterator[Message]:
        """Errors that stopped the robot."""
        for event in events:
            time = self._time(event.stamp)
            data = self._diagnostics.fault(event.text, time)
            yield Message(topics.DIAGNOSTICS, time, data)

    def _clocks(self, events: Sequence[Clock]) -> Iterator[Message]:
        """Wall clock and link's clock."""
        for event in events:
            yield self._reference(event)

    def _reference(self, event: Clock) -> Message:
        """The wall clock at a time of the link's clock."""
        time = self._time(event.stamp)
        return Message(topics.TIME_REFERENCE, time, time_reference(time, event.wall))

    def _table(
        self, topic: Topic, packer: Packer, stamps: NDArray[np.float64], rows: NDArray[np.float64]
    ) -> Iterator[Message]:
        """The rows of a table, one message each."""
        yield from _messages(topic, packer, self._times(stamps), {"data": rows})

    def _time(self, stamp: float) -> int:
        """A time on the file's time line [ns]."""
        return max(round(stamp * NANOSECONDS) + self._offset, 0)

    def _times(self, stamps: NDArray[np.float64]) -> NDArray[np.int64]:
        """Times on the file's time line [ns]."""
        return np.maximum(np.rint(stamps * NANOSECONDS).astype(np.int64) + self._offset, 0)


def _messages(topic: Topic, packer: Packer, when: NDArray[np.int64], fields: Any) -> list[Message]:
    """Pack messages of one topic."""
    packed = packer.packed(len(when), fields)
    return [Message(topic, time, data) for time, data in zip(when.tolist(), packed, strict=True)]


def _episodes(events: Iterable[Event]) -> Iterator[list[Event]]:
    """Split events at every reset: the reset itself, then what follows it."""
    for begins, group in groupby(events, lambda event: type(event) is Began):
        if begins:
            yield from ([event] for event in group)
        else:
            yield list(group)


def _exchange_row(event: Exchange) -> tuple[float, ...]:
    """The columns of topics.EXCHANGE_COLUMNS."""
    late, truth = math.nan if event.lateness is None else event.lateness, NO_TRUTH
    if event.truth is not None:
        truth = (*event.truth.pose, *event.truth.twist, float(event.truth.contact))
    return (event.number, event.stamp, len(event.sent), len(event.received), late, *truth)


def _tick_row(event: Tick) -> tuple[float, ...]:
    """The columns of topics.TICK_COLUMNS."""
    late = math.nan if event.lateness is None else event.lateness
    return (
        *(event.exchange, event.stamp, *event.pose, *event.twist, *event.speeds, *event.angles),
        *(*event.asked, *event.sent, int(event.reason), late, event.feedback_age, event.refused),
    )
