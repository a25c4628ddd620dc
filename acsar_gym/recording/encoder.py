"""What the control loop hands over, and how that becomes ROS 2 messages, a batch at a time."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.odometry import POSE_COVARIANCE, TWIST_COVARIANCE
from acsar_gym.protocol import PRINTED_STEP, Speeds
from acsar_gym.recording import messages
from acsar_gym.recording.messages import (
    BASE_FOOTPRINT,
    WORLD_FRAME,
    Topic,
    array_packer,
    make_message,
    make_ros_header,
    make_time,
    pack_message,
    pose_fields,
    stamp_fields,
    twist_fields,
)
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds.geometry import RaySpec

Floats = NDArray[np.float64]
Pair = tuple[float, float]
Pieces = tuple[tuple[float, bytes], ...]  # with the times at which they were sent or arrived [s]

EPISODE_GAP = 1_000_000  # time between two episodes whose clocks both begin at zero [ns]
DIAGNOSTICS_PERIOD = 1.0  # time between two messages of /diagnostics [s]
MARKERS_PERIOD = 0.1  # time between two messages of /movers [s]
SPLIT_TOLERANCE = 1e-6  # rounding of times when a file ends [s]
SPLIT_PATIENCE = 10.0  # how long a file waits for the end of an env's step [s]
DIAGNOSTIC_OK, DIAGNOSTIC_WARN, DIAGNOSTIC_ERROR = 0, 1, 2
NORMAL_REASONS = ("NONE", "LIMITS")  # reasons of the safety layer that are part of normal driving
INTERVAL_DEVIATIONS = 2.0 * 1.959964  # standard deviations in a 95 % interval
TURNING_FIELDS = ("wheel_separation_multiplier", "body.turn_factor")
ROLLING_FIELDS = ("wheel_radius", "left_wheel_radius_multiplier", "right_wheel_radius_multiplier")
LEAST_DEVIATION = 0.005  # of each part of a pose at the start [m], [rad]: a tyre and a gear give
SLIP_SHARE = 0.02  # of a way or a turn, by which tyres slip otherwise than where calibrated
UNKNOWN_VARIANCE = 0.01  # variance that the robot's own driver publishes [m^2], [rad^2]
UNMEASURED_VARIANCE = 1e3
"""Variance of what wheels don't measure, such as roll. robot_localization ("Preparing Your Data")
takes a zero for nearly certain, and from this order on leaves such a part to another sensor."""
X, Y, YAW = 0, 7, 35  # places of the variances in a row-major 6 x 6 matrix
DIAGONAL = np.arange(0, 36, 7)
UNMEASURED = DIAGONAL[2:5]  # places of z, roll and pitch
UNMEASURED_RATES = DIAGONAL[1:5]  # places of the velocities along y and z, and of roll and pitch


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
    """A scan was read."""

    exchange: int
    stamp: float
    """When it was read, which is where the robot was that its ranges are from [s]."""
    ranges: Any
    """(rays,) [m]."""
    revolution: Any
    """The `Revolution` of which it was made."""


class Moved(NamedTuple):
    """What moved around a simulated robot, at the end of an exchange."""

    exchange: int
    stamp: float
    hit: float
    intrusions: float
    movers: Floats
    """(movers, 5), see `Crowd.copy_states`."""


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


Event = Began | Exchange | Written | Tick | Scanned | Moved | Stepped | Fault | Clock
"""What the control loop hands over; making one takes less than a microsecond."""


class Message(NamedTuple):
    """One message of a topic."""

    topic: Topic
    time: int
    """Nanoseconds on the file's time line: the wall clock at the first reset, and from there on the
    link's clock."""
    data: bytes


NEW_FILE = Message(Topic("", ""), 0, b"")  # what is yielded where a new file begins
State = tuple[str, int, str, Mapping[str, Any]]  # name, level, text, values


class OdometryCovariance:
    """Covariances of /odom during an episode, from the intervals of what was measured.

    Errors of the turning factor and of the wheels' radii are shares of every turn and distance, and
    `SLIP_SHARE` is added to either: sigma_theta = s_turn * integral |omega| dt, sigma_along =
    s_roll * integral |v| dt, sigma_across = integral sigma_theta |v| dt. x and y get the sum of
    both variances, as the direction changes. A twist also has the resolution of encoders and
    numbers, and what it changed within their lag.

    Args:
        config: Robot configuration.
        pose_diagonal: Six constant variances of the pose, as in diff_drive_controller. None to
            compute them.
        twist_diagonal: Six constant variances of the twist likewise.
    """

    def __init__(
        self,
        config: RobotConfig,
        pose_diagonal: Sequence[float] | None = None,
        twist_diagonal: Sequence[float] | None = None,
    ) -> None:
        self._pose_diagonal = pose_diagonal
        self._twist_diagonal = twist_diagonal
        self._turn = relative_deviation(config, TURNING_FIELDS)
        self._roll = relative_deviation(config, ROLLING_FIELDS)
        encoder = config.encoder
        step = 2.0 * math.pi / (encoder.counts_per_revolution * encoder.window)
        printed = math.hypot(encoder.quantum or 0.0, PRINTED_STEP)
        wheel = math.hypot(step / math.sqrt(6.0), printed / math.sqrt(12.0))
        rim = wheel * config.wheel_radius  # of each wheel; a twist is a mean of four
        self._resolution = np.array([rim / 2.0, rim / config.effective_separation])
        lag = encoder.window / 2.0 + 1.0 / config.feedback_rate
        self._lag = max(1, math.ceil(lag / config.period))
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the pose is known."""
        self._rolled = self._turned = self._across = 0.0
        self._last: float | None = None
        self._recent = np.zeros((self._lag, 2))

    def update(self, stamps: Floats, twists: Floats) -> tuple[Floats, Floats]:
        """Continue with the next ticks; returns covariances of pose and twist, (n, 36) each."""
        dt = np.diff(stamps, prepend=stamps[0] if self._last is None else self._last)
        self._last = float(stamps[-1])
        way, turn = np.abs(twists[:, 0]) * dt, np.abs(twists[:, 1]) * dt
        rolled, turned = self._rolled + np.cumsum(way), self._turned + np.cumsum(turn)
        across = self._across + np.cumsum((self._turn or 0.0) * turned * way)
        self._rolled, self._turned = float(rolled[-1]), float(turned[-1])
        self._across = float(across[-1])
        recent = np.concatenate((self._recent, twists))
        self._recent = recent[-self._lag :]
        floor = self._resolution**2 + (twists - recent[: len(twists)]) ** 2
        pose = np.tile(POSE_COVARIANCE, (len(stamps), 1))
        twist = np.tile(TWIST_COVARIANCE, (len(stamps), 1))
        pose[:, UNMEASURED] = UNMEASURED_VARIANCE
        twist[:, UNMEASURED_RATES] = UNMEASURED_VARIANCE
        pose[:, X] = UNKNOWN_VARIANCE
        if self._roll is not None:
            pose[:, X] = LEAST_DEVIATION**2 + (self._roll * rolled) ** 2
            twist[:, X] = floor[:, 0] + (self._roll * twists[:, 0]) ** 2
        pose[:, X] += across**2
        pose[:, Y] = pose[:, X]
        if self._turn is not None:
            pose[:, YAW] = LEAST_DEVIATION**2 + (self._turn * turned) ** 2
            twist[:, YAW] = floor[:, 1] + (self._turn * twists[:, 1]) ** 2
        if self._pose_diagonal is not None:
            pose[:, DIAGONAL] = self._pose_diagonal
        if self._twist_diagonal is not None:
            twist[:, DIAGONAL] = self._twist_diagonal
        return pose, twist


def relative_deviation(config: RobotConfig, names: tuple[str, ...]) -> float | None:
    """Relative standard deviation of a way or turn, by its factors' intervals; None for none."""
    measured: Any = getattr(config, "measured", {})
    intervals = [measured[name] for name in names if name in measured]
    if not intervals:
        return None
    middles = [abs(interval.low + interval.high) / 2.0 for interval in intervals]
    shares = [
        abs(interval.high - interval.low) / INTERVAL_DEVIATIONS / middle if middle else 0.0
        for interval, middle in zip(intervals, middles, strict=True)
    ]
    return math.hypot(math.sqrt(sum(share**2 for share in shares) / len(shares)), SLIP_SHARE)


class Diagnostics:
    """What /diagnostics tells once a second: lateness, safety, refused input, drops; and faults.

    Attributes: `dropped`, what the recorder has dropped so far.
    """

    def __init__(self, config: RobotConfig) -> None:
        self.dropped = 0
        self._hardware = config.base_frame
        self._late_tick = config.late_tick
        self.reset(0.0)

    def reset(self, stamp: float) -> None:
        """Begin a second at this time of the link's clock [s]."""
        self._due = stamp + DIAGNOSTICS_PERIOD
        self._late: list[float] = []
        self._reasons: Counter[str] = Counter()

    def add(self, tick: Tick, time: int) -> bytes | None:
        """Add a tick that ended at this time of the file [ns]; the message if a second is over."""
        reason = str(getattr(tick.reason, "name", tick.reason))
        self._late.append(math.nan if tick.lateness is None else tick.lateness)
        self._reasons[reason] += 1
        if tick.stamp < self._due - 1e-9:
            return None
        late = np.array(self._late)
        timed = late[~np.isnan(late)]
        over = int((timed > self._late_tick).sum())
        loop: dict[str, float] = {"ticks": len(late), "late": over}
        if len(timed):
            p50, p99 = np.percentile(timed, (50, 99)) * 1e3
            loop |= {"p50_ms": round(p50, 3), "p99_ms": round(p99, 3)}
            loop["worst_ms"] = round(float(timed.max()) * 1e3, 3)
        stops = any(name not in NORMAL_REASONS for name in self._reasons)
        wire = {"feedback_age_ms": round(tick.feedback_age * 1e3, 3), "refused": tick.refused}
        lost = {"dropped": self.dropped}
        states: list[State] = [
            ("control loop", int(over > 0), f"{over} late ticks", loop),
            ("safety", int(stops), reason, dict(self._reasons)),
            ("wire", DIAGNOSTIC_OK, f"{tick.refused} parts refused", wire),
            ("recorder", int(self.dropped > 0), f"{self.dropped} dropped", lost),
        ]
        self.reset(tick.stamp)
        return self.pack(time, states)

    def pack(self, time: int, states: Sequence[State]) -> bytes:
        """Pack diagnostic_msgs/DiagnosticArray of these states."""
        status = [
            make_message(
                "diagnostic_msgs/msg/DiagnosticStatus",
                level=level,
                name=f"acsar: {name}",
                message=text,
                hardware_id=self._hardware,
                values=[
                    make_message("diagnostic_msgs/msg/KeyValue", key=key, value=str(value))
                    for key, value in values.items()
                ],
            )
            for name, level, text, values in states
        ]
        kind = messages.DIAGNOSTICS.kind
        return pack_message(kind, header=make_ros_header(time), status=status)


class FileSplitter:
    """Tells where a new file begins: at the first reset that is due, or in mid-episode.

    Attributes: `began`, what began the episode; `last`, `step` and `scan`, the newest exchange,
    step and scan of it, None where there is none; `pose`, by odometry.
    """

    def __init__(self, duration: float) -> None:
        self._duration = duration
        self._written = self._file_began = 0.0
        self.began: Began | None = None
        self._episode_began: float | None = None
        self._since_step = False
        self.last: Exchange | None = None
        self.pose = (0.0, 0.0, 0.0)
        self.step: Stepped | None = None
        self.scan: Scanned | None = None

    def is_due(self, event: Event) -> bool:
        """Whether a new file begins before this event."""
        if type(event) is Began:
            return self._written - self._file_began >= self._duration
        if type(event) is not Exchange or self._episode_began is None or self.last is None:
            return False
        lasts = self.last.stamp - self._episode_began
        late = lasts >= self._duration + SPLIT_PATIENCE
        between = self.step is None or not self._since_step
        return lasts >= self._duration - SPLIT_TOLERANCE and (between or late)

    def begin_file(self) -> None:
        """A new file begins."""
        self._file_began = self._written
        if self.last is not None:
            self._episode_began = self.last.stamp

    def note(self, event: Event) -> None:
        """Note what was written."""
        if isinstance(event, Began):
            self.began, self._episode_began = event, event.stamp
            self.last = self.step = self.scan = None
            self.pose, self._since_step = (0.0, 0.0, 0.0), False
        elif isinstance(event, Exchange):
            before = self.began.stamp if self.began else event.stamp
            self._written += event.stamp - (self.last.stamp if self.last else before)
            self.last, self._since_step = event, True
        elif isinstance(event, Tick):
            self.pose = event.pose
        elif isinstance(event, Scanned):
            self.scan = event
        elif isinstance(event, Stepped):
            self.step, self._since_step = event, False


class Encoder:
    """Makes messages of events."""

    def __init__(self, config: RobotConfig, split: float | None = None) -> None:
        self._config = config
        self._splitter = None if split is None else FileSplitter(split)
        self._first_exchange = self._first_step = 0
        self._covariance = OdometryCovariance(config)
        self._diagnostics = Diagnostics(config)
        self._offset = 0
        self._newest = self._episode = self._rays = -1
        self._scanned: float | None = None
        self._revolution: Any = None
        self._start: Sequence[float] = (0.0, 0.0, 0.0)
        self._markers_due = 0.0
        odom, twist = config.odom_frame, messages.Packer(*messages.TWIST)
        self._packers = {
            messages.ODOM: messages.odometry_packer(odom, BASE_FOOTPRINT),
            messages.TRUTH: messages.odometry_packer(WORLD_FRAME, BASE_FOOTPRINT),
            messages.TF: messages.transform_packer(odom, BASE_FOOTPRINT),
            messages.JOINT_STATES: messages.joint_packer(),
            messages.CMD_VEL: twist,
            messages.CMD_VEL_SENT: twist,
        }
        self._makers: dict[Any, Callable[[Any], Iterator[Message]]] = {
            Began: self._encode_reset,
            Exchange: self._encode_exchanges,
            Written: self._encode_writes,
            Tick: self._encode_ticks,
            Scanned: self._encode_scans,
            Moved: self._encode_movers,
            Stepped: self._encode_steps,
            Fault: self._encode_faults,
            Clock: self._encode_clocks,
        }

    def encode(self, events: Sequence[Event], dropped: int) -> Iterator[Message]:
        """Make the messages of some events: episode by episode, and kind by kind."""
        self._diagnostics.dropped = dropped
        run: list[Event] = []
        for event in events:
            splits = self._splitter is not None and self._splitter.is_due(event)
            if splits or type(event) is Began:
                yield from self._encode_run(run)
                run = []
            if splits:
                yield NEW_FILE
                if type(event) is not Began:
                    yield from self._encode_part()
                self._splitter.begin_file()  # type: ignore[union-attr]
            if self._splitter is not None:
                self._splitter.note(event)
            run.append(event)
            if type(event) is Began:
                yield from self._encode_run(run)
                run = []
        yield from self._encode_run(run)

    def _encode_run(self, events: Sequence[Event]) -> Iterator[Message]:
        """Make the messages of events of one episode, kind by kind."""
        for kind, make in self._makers.items():
            if same := [event for event in events if type(event) is kind]:
                for message in make(same):
                    self._newest = max(self._newest, message.time)
                    yield message

    def _encode_part(self) -> Iterator[Message]:
        splitter = self._splitter
        if splitter is None or splitter.began is None or splitter.last is None:
            return
        began, stamp = splitter.began, splitter.last.stamp
        lasted = stamp - began.stamp
        part = {"from": round(lasted, 6), "pose": [float(number) for number in splitter.pose]}
        info = {**messages.to_plain_json(dict(began.info)), "part": part}
        wall = began.wall + round(lasted * 1e9)
        yield from self._open_episode(0, Began(stamp, wall, info))
        self._first_exchange = splitter.last.number + 1
        if splitter.step is not None:
            self._first_step = splitter.step.step
            step = splitter.step._replace(stamp=stamp, action=None, reward=0.0)
            yield from self._encode_steps([step])
        self._scanned = self._revolution = None
        if splitter.scan is not None:
            number = self._first_exchange - 1
            yield from self._encode_revolution(splitter.scan._replace(exchange=number, stamp=stamp))

    def _encode_reset(self, events: Sequence[Began]) -> Iterator[Message]:
        """Begin an episode; its clock may have started again at zero."""
        (event,) = events
        start = round(event.stamp * 1e9)
        if self._newest < 0:
            self._offset = event.wall - start
        elif start + self._offset <= self._newest:
            self._offset = self._newest + EPISODE_GAP - start
        self._episode += 1
        self._first_exchange = self._first_step = 0
        self._scanned = self._revolution = None
        self._covariance.reset()
        self._diagnostics.reset(event.stamp)
        self._start = event.info.get("start", (0.0, 0.0, 0.0))
        self._markers_due = event.stamp
        yield from self._open_episode(self._episode, event)

    def _open_episode(self, number: int, event: Began) -> Iterator[Message]:
        time = round(event.stamp * 1e9) + self._offset
        opening = {"episode": number, "start": event.stamp, "offset": self._offset}
        opening |= {"wall": event.wall, "info": messages.to_plain_json(dict(event.info))}
        yield Message(messages.EPISODE, time, messages.pack_text(json.dumps(opening)))
        yield Message(messages.TF_STATIC, time, self._pack_static_frames(time))
        yield from self._encode_clocks([Clock(event.stamp, event.wall)])

    def _pack_static_frames(self, time: int) -> bytes:
        """base_footprint, base frame at the height of the axles, and LiDAR."""
        config = self._config
        at = config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset
        edges = (
            (BASE_FOOTPRINT, config.base_frame, (0.0, 0.0, config.wheel_radius)),
            (config.base_frame, config.lidar_frame, at),
        )
        turned = make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
        transforms = []
        for parent, child, (x, y, z) in edges:
            moved = make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
            transforms.append(
                make_message(
                    "geometry_msgs/msg/TransformStamped",
                    header=make_ros_header(time, parent),
                    child_frame_id=child,
                    transform=make_message(
                        "geometry_msgs/msg/Transform", translation=moved, rotation=turned
                    ),
                )
            )
        return pack_message(messages.TF_STATIC.kind, transforms=transforms)

    def _encode_exchanges(self, events: Sequence[Exchange]) -> Iterator[Message]:
        """The raw wire, the truth, and the row that says which bytes belong together."""
        rows = np.full((len(events), len(messages.EXCHANGE_COLUMNS)), math.nan)
        for row, event in zip(rows, events, strict=True):
            yield from self._encode_pieces(messages.WIRE_SENT, event.sent)
            yield from self._encode_pieces(messages.WIRE_RECEIVED, event.received)
            number = event.number - self._first_exchange
            row[:4] = number, event.stamp, len(event.sent), len(event.received)
            if event.lateness is not None:
                row[4] = event.lateness
            if event.truth is not None:
                row[5:] = *event.truth.pose, *event.truth.twist, event.truth.contact
        yield from self._encode_table(messages.EXCHANGES, rows[:, 1], rows)
        simulated = rows[~np.isnan(rows[:, 5])]
        fields = pose_fields(simulated[:, 5:8]) | twist_fields(simulated[:, 8:10])
        yield from self._pack(messages.TRUTH, simulated[:, 1], fields, stamped=True)

    def _encode_writes(self, events: Sequence[Written]) -> Iterator[Message]:
        for event in events:
            yield from self._encode_pieces(messages.WIRE_SENT, event.sent)

    def _encode_pieces(self, topic: Topic, pieces: Pieces) -> Iterator[Message]:
        for stamp, data in pieces:
            yield Message(topic, self._file_time(stamp), messages.pack_octets(data))

    def _encode_ticks(self, events: Sequence[Tick]) -> Iterator[Message]:
        """Odometry, joints, commands, and the row with all of it."""
        first = self._first_exchange
        rows = np.array(
            [
                (
                    *(
                        tick.exchange - first,
                        tick.stamp,
                        *tick.pose,
                        *tick.twist,
                        *tick.speeds,
                        *tick.angles,
                    ),
                    *(*tick.asked, *tick.sent, int(tick.reason)),
                    *(math.nan if tick.lateness is None else tick.lateness,),
                    *(tick.feedback_age, tick.refused),
                )
                for tick in events
            ]
        )
        stamps, pose, twists = rows[:, 1], pose_fields(rows[:, 2:5]), rows[:, 5:7]
        pose_cov, twist_cov = self._covariance.update(stamps, twists)
        covariances = {"pose_cov": pose_cov, "twist_cov": twist_cov}
        odometry = pose | twist_fields(twists) | covariances
        yield from self._pack(messages.ODOM, stamps, odometry, stamped=True)
        yield from self._pack(messages.TF, stamps, pose, stamped=True)
        joints = {"position": rows[:, 11:15], "velocity": rows[:, 7:11]}
        yield from self._pack(messages.JOINT_STATES, stamps, joints, stamped=True)
        yield from self._pack(messages.CMD_VEL_SENT, stamps, twist_fields(rows[:, 17:19]))
        asked = rows[~np.isnan(rows[:, 15])]
        yield from self._pack(messages.CMD_VEL, asked[:, 1], twist_fields(asked[:, 15:17]))
        yield from self._encode_table(messages.TICKS, stamps, rows)
        for event in events:
            time = self._file_time(event.stamp)
            if (data := self._diagnostics.add(event, time)) is not None:
                yield Message(messages.DIAGNOSTICS, time, data)

    def _encode_scans(self, events: Sequence[Scanned]) -> Iterator[Message]:
        """Scans, for viewers and exactly, and each new revolution of which they are made."""
        lidar = self._config.lidar
        for event in events:
            ranges, stamps = np.asarray(event.ranges, np.float64), np.array([event.stamp])
            step = RaySpec(len(ranges), lidar.max_range, lidar.field_of_view).step
            if self._rays != len(ranges):
                self._rays = len(ranges)
                self._packers[messages.SCAN] = messages.scan_packer(self._config, step, self._rays)
            seen = {"ranges": np.where(ranges >= lidar.max_range, np.inf, ranges)}
            seen["scan_time"] = np.array([event.stamp - (self._scanned or event.stamp)])
            self._scanned = event.stamp
            yield from self._pack(messages.SCAN, stamps, seen, stamped=True)
            number = event.exchange - self._first_exchange
            row = np.concatenate([[number, event.stamp], ranges])
            yield from self._encode_table(messages.SCANS, stamps, row[None])
            yield from self._encode_revolution(event)

    def _encode_revolution(self, event: Scanned) -> Iterator[Message]:
        """The revolution of which a scan was made, once."""
        if event.revolution is not self._revolution:
            self._revolution = event.revolution
            *measured, ended = event.revolution
            number = event.exchange - self._first_exchange
            row = np.concatenate([[number, ended], *measured])
            stamps = np.array([event.stamp])
            yield from self._encode_table(messages.REVOLUTIONS, stamps, row[None])

    def _encode_movers(self, events: Sequence[Moved]) -> Iterator[Message]:
        """Movers exactly, and some times a second for viewers, in the frame of the odometry."""
        for event in events:
            stamps, number = np.array([event.stamp]), event.exchange - self._first_exchange
            row = np.concatenate([[number, *event[1:4]], event.movers.ravel()])
            yield from self._encode_table(messages.MOVERS, stamps, row[None])
            if event.stamp >= self._markers_due - 1e-9:
                self._markers_due = event.stamp + MARKERS_PERIOD
                time, shown = self._file_time(event.stamp), event.movers.copy()
                cos, sin = math.cos(self._start[2]), math.sin(self._start[2])
                turn = np.array([[cos, -sin], [sin, cos]])
                shown[:, :2] = (shown[:, :2] - self._start[:2]) @ turn
                shown[:, 2:4] = shown[:, 2:4] @ turn
                data = messages.pack_markers(time, self._config.odom_frame, shown)
                yield Message(messages.MARKERS, time, data)

    def _encode_steps(self, events: Sequence[Stepped]) -> Iterator[Message]:
        for event in events:
            stamps = np.array([event.stamp])
            number = event.step - self._first_step
            row = np.array([[number, event.stamp, event.reward, *event[5:]]], np.float64)
            yield from self._encode_table(messages.STEPS, stamps, row)
            values = (messages.ACTION, event.action), (messages.OBSERVATION, event.observation)
            for topic, numbers in values:
                if numbers is not None:
                    data = np.asarray(numbers, np.float32).reshape(1, -1)
                    yield from self._encode_table(topic, stamps, data)

    def _encode_faults(self, events: Sequence[Fault]) -> Iterator[Message]:
        for event in events:
            time = self._file_time(event.stamp)
            states: list[State] = [("fault", DIAGNOSTIC_ERROR, event.text, {})]
            yield Message(messages.DIAGNOSTICS, time, self._diagnostics.pack(time, states))

    def _encode_clocks(self, events: Sequence[Clock]) -> Iterator[Message]:
        for event in events:
            time = self._file_time(event.stamp)
            fields = {"header": make_ros_header(time), "time_ref": make_time(event.wall)}
            kind = messages.TIME_REFERENCE.kind
            data = pack_message(kind, source="wall clock", **fields)
            yield Message(messages.TIME_REFERENCE, time, data)

    def _encode_table(self, topic: Topic, stamps: Floats, rows: NDArray[Any]) -> Iterator[Message]:
        self._packers[topic] = array_packer(rows.dtype.str, rows.shape[1])
        return self._pack(topic, stamps, {"data": rows})

    def _pack(
        self, topic: Topic, stamps: Floats, fields: Mapping[str, Any], *, stamped: bool = False
    ) -> Iterator[Message]:
        """Messages of one topic; `stamped` for those with a header."""
        when = np.maximum(np.rint(stamps * 1e9).astype(np.int64) + self._offset, 0)
        more = stamp_fields(when) if stamped else {}
        packed = self._packers[topic].pack(len(when), {**fields, **more})
        yield from map(Message, [topic] * len(packed), when.tolist(), packed)

    def _file_time(self, stamp: float) -> int:
        return max(round(stamp * 1e9) + self._offset, 0)
