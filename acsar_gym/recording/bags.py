"""Makes recordings of ROS 2 bags: MCAP files, SQLite files (.db3), and folders of them.

A bag has no bytes of a wire. What it has is written as a recording of this package: joint states,
or else an odometry's twists, as feedback lines; twists of /cmd_vel, by the robot's kinematics, as
command lines, each at the time at which the bag has it; scans. So every tool reads it.
"""

from __future__ import annotations

import atexit
import hashlib
import math
import shutil
import sqlite3
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    ConfigError,
    RecordingWarning,
    escape_unprintable,
    explain_error,
    require_extra,
    show_value,
)
from acsar_gym.odometry import Odometry
from acsar_gym.protocol import Speeds, encode
from acsar_gym.reading import open_file
from acsar_gym.recording import messages
from acsar_gym.recording.encoder import Began, Encoder, Event, Exchange, Scanned, Tick, Written
from acsar_gym.recording.messages import EPISODE, HEADER_RECORD, make_header
from acsar_gym.recording.sinks import McapFile
from acsar_gym.recording.stream import (
    CHANNEL,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    SCHEMA,
    FileCut,
    RecordStream,
    parse_record,
)
from acsar_gym.worlds.geometry import RaySpec

JOINT_STATE = "sensor_msgs/msg/JointState"
ODOMETRY = "nav_msgs/msg/Odometry"
TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ROLES = {
    "joint states": ((JOINT_STATE,), "/joint_states"),
    "odometry": ((ODOMETRY,), "/odom"),
    "commands": ((TWIST, TWIST_STAMPED), "/cmd_vel"),
    "scans": ((LASER_SCAN,), "/scan"),
}
"""What is read of a bag: types, and the usual name of the topic."""
IDENTIFYING_BYTES = 5_000_000  # a recording of this package shows within them what it is
BATCH = 64  # events that are encoded at once
MAX_TIME = 2**62  # times are smaller [ns]
FASTEST_WHEEL = 99.99  # what a line can say, either sign [rad/s]


class BagMessage(NamedTuple):
    """One message of a bag."""

    topic: str
    kind: str
    """Type, such as "sensor_msgs/msg/JointState"."""
    time: int
    """When it was recorded [ns]."""
    data: bytes
    """In CDR."""


def is_recording(path: Path) -> bool:
    """Whether a file is a recording of this package; ConfigError where it can't be read."""
    if path.is_dir() or path.suffix == ".db3":
        return False
    with open_file(path) as file:
        stream = RecordStream(file, ())
        try:
            for opcode, content in stream:
                if opcode == METADATA and parse_record("Metadata", content).name == HEADER_RECORD:
                    return True
                if opcode == CHANNEL and parse_record("Channel", content).topic == EPISODE.name:
                    return True
                if stream.at > IDENTIFYING_BYTES:
                    break
        except FileCut:
            pass
        return not stream.counts  # what isn't a bag, either, is said by whoever reads it


def open_recording(path: Path, robot: RobotConfig | None, topics: Sequence[str] = ()) -> Path:
    """Return a recording: the file itself, or one made of a bag; ConfigError where it can't be."""
    if is_recording(path):
        if topics:
            raise ConfigError(f"{path}: --topics is for ROS 2 bags; this is a recording")
        return path
    if robot is None:
        raise ConfigError(f"{path}: is a ROS 2 bag: name its robot with --robot PRESET|FILE")
    folder = Path(tempfile.mkdtemp(prefix="acsar-gym-bag-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    target = folder / f"{path.stem if path.is_file() else path.name}.mcap"
    import_bag(path, robot, target, topics)
    return target


def import_bag(path: Path, robot: RobotConfig, target: Path, topics: Sequence[str] = ()) -> None:
    """Write what a bag holds as a recording. See `open_recording`."""
    files = find_files(path)
    chosen = choose_topics(path, survey_topics(files), topics, robot)
    header = make_header(robot, {"command": "bag", "bag": path.name, "topics": chosen})
    file: McapFile | None = None
    converter = BagConverter(robot, chosen)
    encoder, events = Encoder(robot), list[Event]()
    try:
        for message in read_messages(files, set(chosen.values())):
            if file is None:
                digest = hash_bag(files)
                header |= {"process": 0, "cut": {"of": digest}}
                header["created"] = {"wall": message.time, "monotonic": 0}
                file = McapFile(target, header)
            events += converter.take(message)
            if len(events) >= BATCH:
                for encoded in encoder.encode(events, 0):
                    file.add(encoded)
                events.clear()
        if file is None or not converter.has_feedback:
            raise ConfigError(f"{path}: has no wheel speeds on {', '.join(chosen.values())}")
        for encoded in encoder.encode([*events, *converter.finish()], 0):
            file.add(encoded)
        file.close(0)
    finally:
        if file is not None:
            file.abandon()


def find_files(path: Path) -> list[Path]:
    """List the files of a bag, in order; a folder with metadata is one itself.

    A program that was killed has written no metadata.
    """
    if not path.is_dir() or (path / "metadata.yaml").exists():
        return [path]
    if files := sorted([*path.glob("*.mcap"), *path.glob("*.db3")]):
        return files
    raise ConfigError(f"{path}: holds no ROS 2 bag: no metadata.yaml, .mcap or .db3")


def hash_bag(files: Sequence[Path]) -> str:
    """First 16 hex digits of a hash of all files of a bag."""
    digests = []
    for path in files:
        for part in sorted(filter(Path.is_file, path.iterdir())) if path.is_dir() else [path]:
            with open_file(part) as file:
                digests.append(hashlib.file_digest(file, "sha256").digest())
    return hashlib.sha256(b"".join(digests)).hexdigest()[:16]


def survey_topics(files: Sequence[Path]) -> dict[str, tuple[str, int, bytes]]:
    """Return the topics of a bag by name: type, number of messages, and the first message."""
    kinds: dict[str, str] = {}
    firsts: dict[str, bytes] = {}
    counts: Counter[str] = Counter()
    for message in read_messages(files, None):
        counts[message.topic] += 1
        if message.topic not in kinds:
            kinds[message.topic] = message.kind
            firsts[message.topic] = message.data
    return {topic: (kind, counts[topic], firsts[topic]) for topic, kind in kinds.items()}


def choose_topics(
    path: Path,
    found: dict[str, tuple[str, int, bytes]],
    given: Sequence[str],
    robot: RobotConfig,
) -> dict[str, str]:
    """Choose a bag's topic for each role of `ROLES` that it has.

    Raises:
        ConfigError: there are no wheel speeds, or several topics of a role.
    """
    listed = ", ".join(f"{name} ({kind})" for name, (kind, _, _) in sorted(found.items()))
    for name in given:
        if not any(is_below(topic, name) for topic in found):
            raise ConfigError(
                f"{path}: has no topic {show_value(name)}: it has {escape_unprintable(listed, 300)}"
            )
    chosen: dict[str, str] = {}
    for role, (kinds, usual) in ROLES.items():
        names = [
            name
            for name, (kind, _, first) in found.items()
            if kind in kinds
            and (not given or any(is_below(name, wanted) for wanted in given))
            and (role != "joint states" or find_wheels(_joint_names(first), robot))
        ]
        if role == "odometry" and "joint states" in chosen:
            continue
        usual_names = [name for name in names if name == usual] or [
            name for name in names if name.endswith(usual)
        ]
        names = usual_names or names
        if len(names) > 1:
            topics = escape_unprintable(", ".join(sorted(names)), 300)
            raise ConfigError(
                f"{path}: has several topics with {role}: {topics}: "
                "choose with --topics NAME or --topics /NAMESPACE"
            )
        if names:
            chosen[role] = names[0]
    if not {"joint states", "odometry"} & set(chosen):
        joints = [
            name
            for _, (kind, _, first) in found.items()
            if kind == JOINT_STATE
            for name in _joint_names(first)
        ]
        holds = ""
        if joints:
            listed_joints = escape_unprintable(", ".join(joints), 300)
            holds = f"its joints are {listed_joints}; write the wheels' into ros2.joints of --robot"
        holds = holds or f"it has {escape_unprintable(listed, 300) or 'no messages'}"
        raise ConfigError(
            f"{path}: has no wheel speeds, neither joint states of the robot's wheels nor an "
            f"odometry: {holds}"
        )
    return chosen


def is_below(topic: str, name: str) -> bool:
    """Whether a topic has a name, or is in a namespace of that name."""
    plain = "/" + name.strip("/")
    return topic == plain or topic.startswith(f"{plain}/")


def deserialize(message: bytes, kind: str) -> Any:
    """Decode a message; None where it is broken."""
    try:
        return messages.load_typestore().deserialize_cdr(message, kind)
    except Exception:  # noqa: BLE001 - a broken message can make it raise anything
        return None


def _joint_names(data: bytes) -> list[str]:
    state = deserialize(data, JOINT_STATE)
    return [] if state is None else [str(name) for name in state.name]


def find_wheels(names: Sequence[str], robot: RobotConfig) -> tuple[int, ...] | None:
    """Find the robot's `ros_joints` of the wheels a, b, c, d. None if a joint is missing."""
    joints = robot.ros_joints
    return tuple(map(names.index, joints)) if {*joints} <= {*names} else None


def read_messages(files: Sequence[Path], topics: set[str] | None) -> Iterator[BagMessage]:
    """Yield the messages of a bag; ConfigError where a file can't be read."""
    for path in files:
        if path.is_dir():
            reader: Callable[[Path, set[str] | None], Iterator[BagMessage]] = _read_folder
        else:
            reader = _read_sqlite if path.suffix == ".db3" else _read_mcap
        yield from reader(path, topics)


def _read_mcap(path: Path, topics: set[str] | None) -> Iterator[BagMessage]:
    """Read an MCAP file, also one without its end."""
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with open_file(path) as file:
        stream = RecordStream(file, channels)
        try:
            for opcode, content in stream:
                if opcode == SCHEMA:
                    schema = parse_record("Schema", content)
                    schemas[schema.id] = schema.name
                elif opcode == CHANNEL:
                    channel = parse_record("Channel", content)
                    is_wanted = topics is None or channel.topic in topics
                    if is_wanted and channel.message_encoding == "cdr":
                        kind = schemas.get(channel.schema_id, "")
                        channels[channel.id] = channel.topic, kind
                elif opcode == MESSAGE:
                    number, _, time, _ = MESSAGE_HEAD.unpack_from(content)
                    if number in channels:
                        yield BagMessage(*channels[number], time, content[MESSAGE_HEAD.size :])
        except FileCut:
            problems = ["the file is cut: what followed is missing"]
        else:
            problems = []
    problems += [f"is damaged: left out {damage}" for damage in stream.damages]
    if problems and topics is not None:  # which is the second time
        text = escape_unprintable(f"{path}: {', '.join(problems[:3])}")
        warnings.warn(text, RecordingWarning, stacklevel=2)


def _read_sqlite(path: Path, topics: set[str] | None) -> Iterator[BagMessage]:
    with open_file(path):  # only regular files
        pass
    query = (
        "SELECT topics.name, topics.type, messages.timestamp, messages.data FROM messages "
        "JOIN topics ON messages.topic_id = topics.id "
        "WHERE topics.serialization_format = 'cdr' ORDER BY messages.timestamp"
    )
    try:
        address = f"{path.absolute().as_uri()}?mode=ro&immutable=1"
        with closing(sqlite3.connect(address, uri=True)) as database:
            for topic, kind, time, data in database.execute(query):
                if topics is None or topic in topics:
                    yield BagMessage(str(topic), str(kind), int(time), bytes(data))
    except (sqlite3.Error, TypeError, ValueError, OverflowError) as error:
        raise ConfigError(f"{path}: isn't a ROS 2 bag: {explain_error(error)}") from error


def _read_folder(path: Path, topics: set[str] | None) -> Iterator[BagMessage]:
    """Read a whole folder of rosbag2, packed or not."""
    with require_extra("reading a ROS 2 bag", "record"):
        from rosbags.rosbag2 import Reader  # noqa: PLC0415 - optional
    try:
        with Reader(path) as reader:
            for connection, time, data in reader.messages():
                if topics is None or connection.topic in topics:
                    yield BagMessage(connection.topic, connection.msgtype, time, bytes(data))
    except Exception as error:  # whatever the library raises
        raise ConfigError(f"{path}: can't be read: {explain_error(error)}") from error


class BagConverter:
    """Makes events of a robot's messages, as a recorder gets them.

    Attributes: `has_feedback`, whether there were wheel speeds.
    """

    def __init__(self, robot: RobotConfig, topics: dict[str, str]) -> None:
        self.has_feedback = False
        self._robot = robot
        self._odometry = Odometry.of(robot)
        roles = {name: role for role, name in topics.items()}
        makers: dict[str, Callable[[Any, float], list[Event]]] = {
            "joint states": self._take_joints,
            "odometry": self._take_odometry,
            "commands": self._take_command,
            "scans": self._take_scan,
        }
        self._makers = {name: makers[role] for name, role in roles.items()}
        self._first = -1
        self._newest = self._before = 0.0
        self._number = 0
        self._sent: list[tuple[float, bytes]] = []
        self._asked = (math.nan, math.nan)
        self._command = (0.0, 0.0)
        self._names: list[str] | None = None
        self._wheels: tuple[int, ...] | None = None
        self._positions: tuple[float, NDArray[np.float64]] | None = None
        lidar = robot.lidar
        self._rays = RaySpec(lidar.rays, lidar.max_range, lidar.field_of_view)

    def take(self, message: BagMessage) -> list[Event]:
        """Return the events of a message."""
        content = deserialize(message.data, message.kind)
        if content is None or not 0 <= message.time < MAX_TIME:
            return []
        events: list[Event] = []
        if self._first < 0:
            self._first = message.time
            events.append(Began(0.0, message.time, {}))
        self._newest = max(self._newest, (message.time - self._first) / 1e9)
        return events + self._makers[message.topic](content, self._newest)

    def finish(self) -> list[Event]:
        """Return what was sent after the last wheel speeds."""
        return [Written(tuple(self._sent))] if self._sent else []

    def _take_command(self, content: Any, stamp: float) -> list[Event]:
        twist = getattr(content, "twist", content)
        linear, angular = float(twist.linear.x), float(twist.angular.z)
        if math.isfinite(linear) and math.isfinite(angular):
            self._asked = self._command = linear, angular
            speeds, letters = self._make_speeds(linear, angular), self._robot.wheels.motors
            line = encode(speeds if letters is None else letters.to_wire(speeds))
            self._sent.append((stamp, line))
        return []

    def _make_speeds(self, linear: float, angular: float) -> Speeds:
        radii = self._robot.wheel_radii
        right, left = kinematics.compute_sides(
            linear, angular, *radii, self._robot.effective_separation, FASTEST_WHEEL
        )
        return right, left, left, right

    def _take_odometry(self, content: Any, stamp: float) -> list[Event]:
        twist = content.twist.twist
        linear, angular = float(twist.linear.x), float(twist.angular.z)
        if not (math.isfinite(linear) and math.isfinite(angular)):
            return []
        return self._exchange(self._make_speeds(linear, angular), stamp)

    def _take_joints(self, content: Any, stamp: float) -> list[Event]:
        names = list(content.name)
        if names != self._names:
            self._names, self._wheels = names, find_wheels(names, self._robot)
            self._positions = None
        if self._wheels is None:
            return []
        places = list(self._wheels)
        speeds = np.full(4, math.nan)
        if len(content.velocity) == len(names):
            speeds = np.asarray(content.velocity, np.float64)[places]
        if len(content.position) == len(names):
            now = content.header.stamp.sec + content.header.stamp.nanosec / 1e9
            positions = np.asarray(content.position, np.float64)[places]
            before, self._positions = self._positions, (now, positions)
            if not np.isfinite(speeds).all() and before is not None and now > before[0]:
                turned = positions - before[1]
                turned = np.where(  # joints that wrap
                    np.abs(turned) > math.pi, np.angle(np.exp(1j * turned)), turned
                )
                speeds = turned / (now - before[0])
        if not np.isfinite(speeds).all():
            return []
        a, b, c, d = np.clip(speeds, -FASTEST_WHEEL, FASTEST_WHEEL).tolist()
        return self._exchange((a, b, c, d), stamp)

    def _exchange(self, speeds: Speeds, stamp: float) -> list[Event]:
        """A feedback line, and the tick that it ends."""
        self.has_feedback = True
        self._odometry.update(speeds, stamp - self._before)
        self._before = stamp
        letters = self._robot.wheels.encoders
        line = encode(speeds if letters is None else letters.to_wire(speeds))
        exchange = Exchange(self._number, stamp, tuple(self._sent), ((stamp, line),), None, None)
        tick = Tick(
            self._number,
            stamp,
            self._odometry.pose,
            self._odometry.twist,
            speeds,
            self._odometry.wheel_positions,
            self._asked,
            self._command,
            0,
            None,
            0.0,
            0,
        )
        self._number += 1
        self._sent = []
        return [exchange, tick]

    def _take_scan(self, content: Any, stamp: float) -> list[Event]:
        """A scan, sorted into the rays of the robot's LiDAR; and as it was measured."""
        distances = np.asarray(content.ranges, np.float64)
        if not (self._number and len(distances)):
            return []
        increment = float(content.angle_increment)
        bearings = float(content.angle_min) + increment * np.arange(len(distances))
        least, most = max(float(content.range_min), 1e-6), float(content.range_max)
        with np.errstate(invalid="ignore"):
            valid = np.isfinite(distances) & (distances >= least) & (distances <= most)
        if not np.isfinite(bearings).all() or np.abs(bearings).max() > 4.0 * math.pi:
            return []
        distances = np.where(valid, distances, 0.0)
        ranges, step = np.full(self._rays.rays, self._rays.reach), self._rays.step
        off = np.mod(bearings - self._rays.angles()[0] + step / 2.0, 2.0 * math.pi)
        rays = np.floor(off / step).astype(int)
        hits = valid & (rays < len(ranges))
        np.minimum.at(ranges, rays[hits], distances[hits])
        revolution = bearings, distances, np.full(len(distances), stamp), stamp
        return [Scanned(self._number - 1, stamp, ranges, revolution)]
