"""What the control loop hands over, and how that becomes ROS 2 messages, a batch at a time."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.odometry import POSE_COVARIANCE, TWIST_COVARIANCE
from acsar_gym.physics.body import GroundTruth
from acsar_gym.protocol import Speeds
from acsar_gym.recording import messages
from acsar_gym.recording.messages import (
    NANOSECONDS,
    Packer,
    Topic,
    make_message,
    make_ros_header,
    pack_message,
    stamp_fields,
    static_transforms,
    time_reference,
    to_plain_json,
)
from acsar_gym.worlds.geometry import RaySpec

Floats = NDArray[np.float64]
INTERVAL_DEVIATIONS = 2.0 * 1.959964
"""Width of a 95 % interval of a normal distribution, in standard deviations."""
TURNING_FIELDS = ("wheel_separation_multiplier", "body.turn_factor")
ROLLING_FIELDS = ("wheel_radius", "left_wheel_radius_multiplier", "right_wheel_radius_multiplier")
LEAST_VARIANCE = 1e-9
"""Variance at the start of an episode, as zero would mean that nothing can be wrong."""
UNKNOWN_VARIANCE = 0.01
"""Variance that the robot's own driver publishes [m^2], [rad^2]."""
X, Y, YAW = 0, 7, 35
"""Places of the variances in a row-major 6 x 6 matrix."""


class OdometryCovariance:
    """Covariances of /odom during an episode.

    Args:
        config: of the robot; `measured` has the intervals.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._turn = relative_deviation(config, TURNING_FIELDS)
        self._roll = relative_deviation(config, ROLLING_FIELDS)
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the pose is known."""
        self._rolled = self._turned = self._across = 0.0
        self._last: float | None = None

    def of(self, stamps: Floats, twists: Floats) -> tuple[Floats, Floats]:
        """Continue with the next ticks.

        Args:
            stamps: (n,) [s].
            twists: (n, 2): linear [m/s], angular [rad/s].

        Returns:
            Covariances of pose and twist, (n, 36) each.
        """
        first = stamps[0] if self._last is None else self._last
        dt = np.diff(stamps, prepend=first)
        self._last = float(stamps[-1])
        way, turn = np.abs(twists[:, 0]) * dt, np.abs(twists[:, 1]) * dt
        rolled, turned = self._rolled + np.cumsum(way), self._turned + np.cumsum(turn)
        across = self._across + np.cumsum((self._turn or 0.0) * turned * way)
        self._rolled, self._turned = float(rolled[-1]), float(turned[-1])
        self._across = float(across[-1])
        pose = np.tile(POSE_COVARIANCE, (len(stamps), 1))
        along = (
            UNKNOWN_VARIANCE if self._roll is None else LEAST_VARIANCE + (self._roll * rolled) ** 2
        )
        pose[:, X] = pose[:, Y] = along + across**2
        if self._turn is not None:
            pose[:, YAW] = LEAST_VARIANCE + (self._turn * turned) ** 2
        return pose, self._twist(twists)

    def _twist(self, twists: Floats) -> Floats:
        """Covariances of the twist."""
        found = np.tile(TWIST_COVARIANCE, (len(twists), 1))
        if self._roll is not None:
            found[:, X] = LEAST_VARIANCE + (self._roll * twists[:, 0]) ** 2
        if self._turn is not None:
            found[:, YAW] = LEAST_VARIANCE + (self._turn * twists[:, 1]) ** 2
        return found


def relative_deviation(config: RobotConfig, names: tuple[str, ...]) -> float | None:
    """Return the relative standard deviation of a product of fields; None if none was measured."""
    measured: Any = getattr(config, "measured", {})
    found = [measured[name] for name in names if name in measured]
    if not found:
        return None
    return math.sqrt(sum(_relative(one.low, one.high) ** 2 for one in found) / len(found))


def _relative(low: float, high: float) -> float:
    """The standard deviation of a 95 % interval, relative to its middle."""
    middle = abs(low + high) / 2.0
    return abs(high - low) / INTERVAL_DEVIATIONS / middle if middle else 0.0


Pair = tuple[float, float]
Pieces = tuple[tuple[float, bytes], ...]
"""Bytes with the times at which they were sent or arrived [s]."""


class Began(NamedTuple):
    """A reset: an episode begins."""

    stamp: float
    wall: int
    """Wall clock at the same moment [ns since 1970]."""
    info: Mapping[str, Any]


class Exchange(NamedTuple):
    """One control period of the wire."""

    number: int
    stamp: float
    sent: Pieces
    received: Pieces
    lateness: float | None
    truth: GroundTruth | None


class Written(NamedTuple):
    """Bytes that were sent after the last control period of a link, such as the stop at its end."""

    sent: Pieces


class Tick(NamedTuple):
    """One tick of the robot, after the exchange of the same number."""

    exchange: int
    stamp: float
    pose: tuple[float, float, float]
    twist: Pair
    speeds: Speeds
    angles: Speeds
    asked: Pair
    sent: Pair
    reason: int
    """An IntEnum with a name, such as `safety.rules.Reason`, or a number."""
    lateness: float | None
    feedback_age: float
    refused: int


class Scanned(NamedTuple):
    """A scan became the newest one."""

    exchange: int
    stamp: float
    ranges: Any
    """(rays,) [m]."""


class Stepped(NamedTuple):
    """A step of the env, or its reset, which has no action."""

    step: int
    stamp: float
    observation: Any
    action: Any
    reward: float
    terminated: bool
    truncated: bool
    success: bool = False


class Fault(NamedTuple):
    """Something that stopped the robot."""

    stamp: float
    text: str


class Clock(NamedTuple):
    """Wall clock and link's clock at the same moment."""

    stamp: float
    wall: int


Event = Began | Exchange | Written | Tick | Scanned | Stepped | Fault | Clock


DIAGNOSTICS_PERIOD = 1.0
"""Time between two messages [s]."""
LATE_TICK = 0.001
"""A tick that ends more than this after its deadline is late [s]."""
OK, WARN, ERROR = 0, 1, 2
NORMAL_REASONS = ("NONE", "LIMITS")
"""Reasons of the safety layer that are part of normal driving."""


class Diagnostics:
    """Sums up the ticks of a second.

    Attributes: `dropped`, what the recorder has dropped so far.

    Args:
        config: of the robot.
    """

    def __init__(self, config: RobotConfig) -> None:
        self.dropped = 0
        self._hardware = config.base_frame
        self.reset(0.0)

    def reset(self, stamp: float) -> None:
        """Begin an episode at this time of the link's clock [s]."""
        self._due = stamp + DIAGNOSTICS_PERIOD
        self._late: list[float] = []
        self._reasons: Counter[str] = Counter()

    def ticked(
        self, ticks: Sequence[Tick], time: Callable[[float], int]
    ) -> Iterator[tuple[float, bytes]]:
        """Add ticks; yields stamp [s] and message wherever a second is over."""
        for tick in ticks:
            self._late.append(math.nan if tick.lateness is None else tick.lateness)
            self._reasons[_name(tick.reason)] += 1
            if tick.stamp >= self._due - 1e-9:
                yield tick.stamp, self._message(time(tick.stamp), self._told(tick))
                self.reset(tick.stamp)

    def fault(self, text: str, time: int) -> bytes:
        """Pack an error that stopped the robot."""
        return self._message(time, [self._status("fault", ERROR, text, {})])

    def _told(self, newest: Tick) -> list[Any]:
        """The states of loop, safety, wire and recorder."""
        late = np.array(self._late)
        timed = late[~np.isnan(late)]
        over = int((timed > LATE_TICK).sum())
        loop: dict[str, float] = {"ticks": len(late), "late": over}
        if len(timed):
            p50, p99 = np.percentile(timed, (50, 99)) * 1e3
            loop |= {"p50_ms": round(p50, 3), "p99_ms": round(p99, 3)}
            loop["worst_ms"] = round(float(timed.max()) * 1e3, 3)
        stops = [name for name in self._reasons if name not in NORMAL_REASONS]
        reason = _name(newest.reason)
        wire = {"feedback_age_ms": round(newest.feedback_age * 1e3, 3), "refused": newest.refused}
        lost = {"dropped": self.dropped}
        return [
            self._status("control loop", WARN if over else OK, f"{over} late ticks", loop),
            self._status("safety", WARN if stops else OK, reason, dict(self._reasons)),
            self._status("wire", OK, f"{newest.refused} parts refused", wire),
            self._status("recorder", WARN if self.dropped else OK, f"{self.dropped} dropped", lost),
        ]

    def _status(self, name: str, level: int, text: str, values: Mapping[str, Any]) -> Any:
        """A diagnostic_msgs/DiagnosticStatus."""
        pairs = [
            make_message("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
            for key, value in values.items()
        ]
        return make_message(
            "diagnostic_msgs/msg/DiagnosticStatus",
            level=level,
            name=f"acsar: {name}",
            message=text,
            hardware_id=self._hardware,
            values=pairs,
        )

    def _message(self, time: int, states: list[Any]) -> bytes:
        """Pack diagnostic_msgs/DiagnosticArray."""
        return pack_message(
            make_message(
                "diagnostic_msgs/msg/DiagnosticArray", header=make_ros_header(time), status=states
            )
        )


def _name(reason: int) -> str:
    """The name of a reason; numbers without one stay numbers."""
    return str(getattr(reason, "name", reason))


EPISODE_GAP = 1_000_000
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
        self._formats = messages.MessageFormats.of(config)
        self._covariance = OdometryCovariance(config)
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
        for episode in _split_episodes(events):
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
            self._offset = self._newest + EPISODE_GAP - start
        self._episode += 1
        self._covariance.reset()
        self._diagnostics.reset(event.stamp)
        time = start + self._offset
        told = {"episode": self._episode, "start": event.stamp, "offset": self._offset}
        text = json.dumps(told | {"wall": event.wall, "info": to_plain_json(dict(event.info))})
        yield Message(messages.EPISODE, time, messages.pack_text(text))
        yield Message(messages.TF_STATIC, time, self._static(time))
        yield self._reference(Clock(event.stamp, event.wall))

    def _exchanges(self, events: Sequence[Exchange]) -> Iterator[Message]:
        """The raw wire, the truth, and the row that says which bytes belong together."""
        for event in events:
            yield from self._pieces(messages.WIRE_SENT, event.sent)
            yield from self._pieces(messages.WIRE_RECEIVED, event.received)
        rows = np.array([_exchange_row(event) for event in events])
        yield from self._table(messages.EXCHANGES, self._formats.exchanges, rows[:, 1], rows)
        known = rows[~np.isnan(rows[:, 5])]
        if len(known):
            when = self._times(known[:, 1])
            fields = stamp_fields(when) | messages.pose_fields(known[:, 5:8])
            fields |= messages.twist_fields(known[:, 8:10])
            yield from _pack_messages(messages.TRUTH, self._formats.truth, when, fields)

    def _written(self, events: Sequence[Written]) -> Iterator[Message]:
        """Bytes that were sent at the end."""
        for event in events:
            yield from self._pieces(messages.WIRE_SENT, event.sent)

    def _pieces(self, topic: Topic, pieces: Pieces) -> Iterator[Message]:
        """Bytes of the wire."""
        for stamp, data in pieces:
            yield Message(topic, self._time(stamp), messages.pack_octets(data))

    def _ticks(self, events: Sequence[Tick]) -> Iterator[Message]:
        """Odometry, joints, commands, and the row with all of it."""
        rows = np.array([_tick_row(event) for event in events])
        stamps, own = rows[:, 1], self._formats
        when = self._times(stamps)
        stamped, pose = stamp_fields(when), messages.pose_fields(rows[:, 2:5])
        pose_cov, twist_cov = self._covariance.of(stamps, rows[:, 5:7])
        fields: dict[str, Any] = stamped | pose | messages.twist_fields(rows[:, 5:7])
        fields |= {"pose_cov": pose_cov, "twist_cov": twist_cov}
        yield from _pack_messages(messages.ODOM, own.odometry, when, fields)
        yield from _pack_messages(messages.TF, own.transform, when, stamped | pose)
        joints = stamped | {"position": rows[:, 11:15], "velocity": rows[:, 7:11]}
        yield from _pack_messages(messages.JOINT_STATES, own.joints, when, joints)
        yield from _pack_messages(
            messages.CMD_VEL_SENT, own.twist, when, messages.twist_fields(rows[:, 17:19])
        )
        is_asked = ~np.isnan(rows[:, 15])
        asked = messages.twist_fields(rows[is_asked, 15:17])
        yield from _pack_messages(messages.CMD_VEL, own.twist, when[is_asked], asked)
        yield from self._table(messages.TICKS, own.ticks, stamps, rows)
        for stamp, data in self._diagnostics.ticked(events, self._time):
            yield Message(messages.DIAGNOSTICS, self._time(stamp), data)

    def _scans(self, events: Sequence[Scanned]) -> Iterator[Message]:
        """Scans, for viewers and exactly."""
        lidar = self._config.lidar
        for event in events:
            ranges = np.asarray(event.ranges, np.float64)
            time, rays = self._time(event.stamp), len(ranges)
            step = RaySpec(rays, lidar.max_range, lidar.field_of_view).step
            packer = messages.scan_packer(self._config, step, rays)
            seen = np.where(ranges >= lidar.max_range, np.inf, ranges)
            when = np.array([time])
            yield from _pack_messages(
                messages.SCAN, packer, when, stamp_fields(when) | {"ranges": seen}
            )
            row = np.concatenate([[event.exchange, event.stamp], ranges])
            exact = {"data": row}
            yield from _pack_messages(
                messages.SCANS, messages.doubles_packer(len(row)), when, exact
            )

    def _steps(self, events: Sequence[Stepped]) -> Iterator[Message]:
        """Observations, actions and rewards."""
        for event in events:
            when = np.array([self._time(event.stamp)])
            row = np.array([[event.step, event.stamp, event.reward, *event[5:]]], np.float64)
            yield from self._table(messages.STEPS, self._formats.steps, row[:, 1], row)
            for topic, values in (
                (messages.ACTION, event.action),
                (messages.OBSERVATION, event.observation),
            ):
                if values is not None:
                    data = np.asarray(values, np.float32).ravel()
                    yield from _pack_messages(
                        topic, messages.singles_packer(len(data)), when, {"data": data}
                    )

    def _faults(self, events: Sequence[Fault]) -> Iterator[Message]:
        """Errors that stopped the robot."""
        for event in events:
            time = self._time(event.stamp)
            data = self._diagnostics.fault(event.text, time)
            yield Message(messages.DIAGNOSTICS, time, data)

    def _clocks(self, events: Sequence[Clock]) -> Iterator[Message]:
        """Wall clock and link's clock."""
        for event in events:
            yield self._reference(event)

    def _reference(self, event: Clock) -> Message:
        """The wall clock at a time of the link's clock."""
        time = self._time(event.stamp)
        return Message(messages.TIME_REFERENCE, time, time_reference(time, event.wall))

    def _table(
        self, topic: Topic, packer: Packer, stamps: NDArray[np.float64], rows: NDArray[np.float64]
    ) -> Iterator[Message]:
        """The rows of a table, one message each."""
        yield from _pack_messages(topic, packer, self._times(stamps), {"data": rows})

    def _time(self, stamp: float) -> int:
        """A time on the file's time line [ns]."""
        return max(round(stamp * NANOSECONDS) + self._offset, 0)

    def _times(self, stamps: NDArray[np.float64]) -> NDArray[np.int64]:
        """Times on the file's time line [ns]."""
        return np.maximum(np.rint(stamps * NANOSECONDS).astype(np.int64) + self._offset, 0)


def _pack_messages(
    topic: Topic, packer: Packer, when: NDArray[np.int64], fields: Any
) -> list[Message]:
    """Pack messages of one topic."""
    packed = packer.packed(len(when), fields)
    return [Message(topic, time, data) for time, data in zip(when.tolist(), packed, strict=True)]


def _split_episodes(events: Iterable[Event]) -> Iterator[list[Event]]:
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
