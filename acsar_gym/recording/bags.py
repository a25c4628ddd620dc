"""Makes recordings of ROS 2 bags.

A bag has no bytes of a wire. Its messages are written as a recording of this package, which every
tool reads. Joint states, or else the twists of an odometry, become feedback lines. Twists of
/cmd_vel become command lines, by the robot's kinematics. Each line has the time of its message.
"""

from __future__ import annotations

import atexit
import math
import shutil
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.config.sections import WheelLetters
from acsar_gym.errors import (
    ConfigError,
    LidarError,
    RecordingWarning,
    escape_unprintable,
    explain_error,
    show_value,
)
from acsar_gym.lidar.laser_scan import LaserScan, Mount, read_scan
from acsar_gym.lidar.scan import Revolution, ray_spec
from acsar_gym.odometry import Odometry
from acsar_gym.protocol import Speeds, encode
from acsar_gym.reading import open_file
from acsar_gym.recording.bag_files import PACKED, BagFiles, BagMessage
from acsar_gym.recording.blocks import IDENTIFYING_BYTES, MAGIC, find_block
from acsar_gym.recording.events import UNKNOWN_TRUTH, Began, Event
from acsar_gym.recording.messages import load_typestore, make_header
from acsar_gym.recording.writer import RecordingWriter, Tabulator
from acsar_gym.ros.joints import WRAPPING_RANGE, JointReader

JOINT_STATE = "sensor_msgs/msg/JointState"
TWISTS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
ROLES = {
    "joint states": ((JOINT_STATE,), "/joint_states"),
    "odometry": (("nav_msgs/msg/Odometry",), "/odom"),
    "commands": (TWISTS, "/cmd_vel"),
    "scans": (("sensor_msgs/msg/LaserScan",), "/scan"),
}
"""What is read of a bag: types, and the usual name of the topic."""
SCAN_FIELDS = ("angle_min", "angle_increment", "range_min", "range_max")
BATCH = 300  # events of a block
MAX_TIME = 2**62  # times are smaller [ns]
FASTEST_WHEEL = 99.99  # largest speed that a line can express, either sign [rad/s]


def is_recording(path: Path) -> bool:
    """Whether a file is a recording of this package. Raises ConfigError if it can't be read."""
    if path.is_dir() or path.suffix in (".db3", PACKED):
        return False
    with open_file(path) as file:
        is_mcap = file.read(len(MAGIC)) == MAGIC
        # Reading a recording reports what is neither.
        return not is_mcap or find_block(file, 0, IDENTIFYING_BYTES) >= 0


def open_recording(path: Path, robot: RobotConfig | None, topics: Sequence[str] = ()) -> Path:
    """Return a recording: the file itself, or a file that is made of a bag.

    Args:
        path: A recording, or a bag: an MCAP file, a .db3 file, or a folder of rosbag2.
        robot: Robot of a bag.
        topics: Topics of a bag that are used, or namespaces. All if empty.

    Raises:
        ConfigError: It is neither, or the bag has no wheel speeds.
    """
    if is_recording(path):
        if topics:
            raise ConfigError(f"{path}: --topics is for ROS 2 bags; this is a recording")
        return path
    if robot is None:
        raise ConfigError(f"{path}: is a ROS 2 bag: name its robot with --robot PRESET|FILE")
    # Readers take a path, so the recording is a file until the program ends.
    folder = Path(tempfile.mkdtemp(prefix="acsar-gym-bag-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "unpacked").mkdir()
    target = folder / f"{path.stem if path.is_file() else path.name}.mcap"
    import_bag(path, robot, target, topics)
    return target


def import_bag(path: Path, robot: RobotConfig, target: Path, topics: Sequence[str] = ()) -> None:
    """Write a bag as a recording. Arguments and errors are those of `open_recording`."""
    files = BagFiles(path, target.parent / "unpacked")
    surveys = survey_topics(files)
    chosen = choose_topics(path, surveys, topics, robot)
    joints = chosen.get("joint states", "")
    wraps = not joints or surveys[joints].check_wraps(f"{path}: {joints}", robot)
    converter = BagConverter(robot, wraps=wraps)
    roles = {topic: role for role, topic in chosen.items()}

    # The bag has its own clock, and no process that drives.
    header = make_header(robot, {"command": "bag", "bag": path.name, "topics": chosen})
    # By the hash of the bag, a fit that was made of it is recognized.
    header |= {"process": 0, "source": files.compute_hash()}
    header["created"] = {"wall": min(surveys[topic].times[0] for topic in roles), "monotonic": 0}

    # Topics are converted in the order of their messages, as a recorder gets events.
    writer = RecordingWriter(target, robot, header)
    tabulator = Tabulator([writer])
    try:
        for message in files.read_messages():
            if message.topic in roles and 0 <= message.time < MAX_TIME:
                converter.take(roles[message.topic], message.time, deserialize(message))
            if len(converter.events) >= BATCH:
                tabulator.add(converter.events)
                converter.events.clear()
        tabulator.add([*converter.events, {"sent": converter.sent}], is_last=True)
        writer.close(0)
    except OSError as error:
        raise ConfigError(f"{target}: can't be written: {explain_error(error)}") from error
    finally:
        writer.abandon()

    if not converter.periods:
        raise ConfigError(f"{path}: has no wheel speeds on {', '.join(roles)}")
    problems = list(files.problems)
    if converter.refused:
        counts = ", ".join(f"{count:,} {kind}" for kind, count in converter.refused.items())
        problems.append(f"{path}: messages of {joints} were left out: {counts}")
    for problem in problems:
        warnings.warn(escape_unprintable(problem), RecordingWarning, stacklevel=3)


@dataclass
class TopicSurvey:
    """What is known of a topic before it is converted."""

    kind: str
    """Type of its messages."""
    times: list[int] = field(default_factory=list)
    """When its messages were recorded [ns]."""
    joints: list[str] = field(default_factory=list)
    """Names of joints in the first message."""
    has_velocities: bool = False
    """Whether a message has velocities of joints."""
    largest: float = 0.0
    """Largest position in messages without velocities, either sign [rad]."""

    def check_wraps(self, name: str, robot: RobotConfig) -> bool:
        """Whether positions may wrap at full turns.

        Raises:
            ConfigError: It is unknown how far wheels turned between two positions.
        """
        if self.has_velocities or self.largest >= WRAPPING_RANGE:
            return self.has_velocities
        pause = float(np.median(np.diff(self.times))) / 1e9 if len(self.times) > 1 else 0.0
        if pause * robot.max_wheel_speed > math.pi:
            raise ConfigError(
                f"{name} has positions without velocities, {1.0 / pause:.1f} times a "
                f"second: a wheel at {robot.max_wheel_speed:g} rad/s turns by more than half a "
                "turn meanwhile, so its speed is unknown"
            )
        return True


def has_velocities(content: Any) -> bool:
    """Whether joint states have velocities."""
    return len(content.velocity) > 0 and not np.isnan(content.velocity).all()


def survey_topics(files: BagFiles) -> dict[str, TopicSurvey]:
    """Return what is known of each topic of a bag."""
    surveys: dict[str, TopicSurvey] = {}
    for message in files.read_messages():
        survey = surveys.setdefault(message.topic, TopicSurvey(message.kind))
        survey.times.append(message.time)
        if message.kind != JOINT_STATE or survey.has_velocities:
            continue
        # Whether positions wrap is known only after all of them have been seen.
        content = deserialize(message)
        if content is not None:
            survey.joints = survey.joints or [str(name) for name in content.name]
            survey.has_velocities = has_velocities(content)
            positions = np.abs(content.position)
            survey.largest = positions[np.isfinite(positions)].max(initial=survey.largest)
    return surveys


def deserialize(message: BagMessage) -> Any:
    """Decode a message. None if it is broken."""
    try:
        return load_typestore().deserialize_cdr(message.data, message.kind)
    except Exception:  # noqa: BLE001 - a broken message can make it raise anything
        return None


def choose_topics(
    path: Path, surveys: Mapping[str, TopicSurvey], wanted: Sequence[str], robot: RobotConfig
) -> dict[str, str]:
    """Choose a bag's topic for each role of `ROLES` that it has.

    Args:
        path: The bag.
        surveys: What is known of each topic.
        wanted: Topics or namespaces that the user named. All if empty.
        robot: Robot configuration.

    Raises:
        ConfigError: There are no wheel speeds, or several topics of a role.
    """
    topics = ", ".join(f"{name} ({survey.kind})" for name, survey in sorted(surveys.items()))
    content = escape_unprintable(f"it has {topics or 'no messages'}", 300)
    # A misspelt topic would otherwise be a topic that the bag doesn't use.
    for name in wanted:
        if not any(is_below(topic, name) for topic in surveys):
            raise ConfigError(f"{path}: has no topic {show_value(name)}: {content}")

    chosen: dict[str, str] = {}
    for role, (kinds, usual) in ROLES.items():
        if role == "odometry" and chosen:
            continue
        names = [
            name
            for name, survey in surveys.items()
            if survey.kind in kinds
            and (not wanted or any(is_below(name, prefix) for prefix in wanted))
            and (role != "joint states" or {*robot.ros_joints} <= {*survey.joints})
        ]

        # The usual name wins, then the usual name of any robot.
        names = [name for name in names if name.endswith(usual)] or names
        names = [name for name in names if name == usual] or names
        if len(names) > 1:
            raise ConfigError(
                f"{path}: has several topics with {role}: "
                f"{escape_unprintable(', '.join(sorted(names)), 300)}: "
                "choose with --topics NAME or --topics /NAMESPACE"
            )
        if names:
            chosen[role] = names[0]

    if not {"joint states", "odometry"} & set(chosen):
        joints = ", ".join(joint for survey in surveys.values() for joint in survey.joints)
        if joints:
            content = escape_unprintable(f"its joints are {joints}", 200)
            content = f"{content}: write the wheels' into ros2.joints of --robot"
        raise ConfigError(
            f"{path}: has no wheel speeds, neither joint states of the robot's wheels nor an "
            f"odometry: {content}"
        )
    return chosen


def is_below(topic: str, name: str) -> bool:
    """Whether a topic has a name, or is in a namespace of that name."""
    return f"{topic}/".startswith(f"/{name.strip('/')}/")


class BagConverter:
    """Makes events of a robot's messages, as a recorder gets them.

    Args:
        robot: Robot configuration.
        wraps: Whether positions of joints may wrap at full turns.

    Attributes:
        events: The events that were made.
        sent: Command lines since the newest control period, with their times [s].
        periods: Number of control periods, which end with wheel speeds.
        refused: Number of joint states that can't be right, by reason.
    """

    def __init__(self, robot: RobotConfig, *, wraps: bool) -> None:
        self.events: list[Event] = []
        self.sent: list[tuple[float, bytes]] = []
        self.periods = 0
        self._robot = robot
        self._odometry = Odometry.of(robot)
        self._joints = JointReader(robot.ros_joints, wraps=wraps)
        self.refused = self._joints.refused
        self._spec = ray_spec(robot)

        self._first = -1
        self._newest = 0.0
        self._last_feedback = 0.0
        self._asked = (math.nan, math.nan)
        self._has_moved = False

    def take(self, role: str, time: int, content: Any) -> None:
        """Take a message of a role, which was recorded at a time [ns]. None is a broken message."""
        if content is None:
            return
        if self._first < 0:
            self._first = time
            self.events.append(Began(0.0, time, {}))
        self._newest = max(self._newest, (time - self._first) / 1e9)

        if role == "joint states":
            self._end_period(self._read_joints(content))
        elif role == "odometry":
            self._end_period(self._read_twist(content.twist.twist))
        elif role == "scans":
            self._take_scan(content)
        else:
            twist = getattr(content, "twist", content)
            speeds = self._read_twist(twist)
            if speeds is not None:
                self._asked = (float(twist.linear.x), float(twist.angular.z))
                line = self._encode(speeds, self._robot.wheels.motors)
                self.sent.append((self._newest, line))

    def _read_twist(self, twist: Any) -> Speeds | None:
        """Return the wheel speeds of a twist. None if it isn't finite."""
        # A board of this package would get these bytes, so tools read them as its log.
        linear = float(twist.linear.x)
        angular = float(twist.angular.z)
        if not math.isfinite(linear + angular):
            return None
        separation = self._robot.effective_separation
        right_side, left_side = kinematics.compute_sides(
            linear, angular, *self._robot.wheel_radii, separation, FASTEST_WHEEL
        )
        return right_side, left_side, left_side, right_side

    def _encode(self, speeds: Speeds, letters: WheelLetters | None) -> bytes:
        return encode(letters.to_wire(speeds) if letters else speeds)

    def _read_joints(self, content: Any) -> Speeds | None:
        """Return the wheel speeds of joint states. None if they are refused, or have none."""
        # A joint_state_publisher that runs beside the robot's own publisher.
        has_position = bool(np.any(content.position))
        if self._has_moved and not has_position and not has_velocities(content):
            self.refused["with all positions zero"] += 1
            return None
        self._has_moved = self._has_moved or has_position

        # Differences of positions need the time of the measurement, not that of the recording.
        stamp = content.header.stamp
        when = stamp.sec + stamp.nanosec / 1e9
        if has_velocities(content) or not when:
            when = self._first / 1e9 + self._newest
        speeds = self._joints.read(list(content.name), content.position, content.velocity, when)
        if speeds is not None and max(map(abs, speeds)) > FASTEST_WHEEL:
            self.refused["too fast"] += 1
            return None
        return speeds

    def _end_period(self, speeds: Speeds | None) -> None:
        """Add a feedback line of wheel speeds, and the tick that it ends."""
        if speeds is None:
            return
        stamp = self._newest
        # The bag's own odometry may be fused or corrected. A recording has that of the wheels.
        self._odometry.update(speeds, stamp - self._last_feedback)
        self._last_feedback = stamp
        line = self._encode(speeds, self._robot.wheels.encoders)

        tick = (
            self.periods,
            stamp,
            self._odometry.pose,
            self._odometry.twist,
            speeds,
            self._odometry.wheel_positions,
            self._asked,
            np.nan_to_num(self._asked),
            0,
            None,
            0.0,
            0,
        )
        self.events.append(
            {
                "exchanges": (self.periods, stamp, len(self.sent), 1, None, *UNKNOWN_TRUTH),
                "sent": self.sent,
                "received": [(stamp, line)],
                "ticks": tick,
            }
        )
        self.periods += 1
        self.sent = []

    def _take_scan(self, content: Any) -> None:
        """Add a scan, sorted into the rays of the robot's LiDAR, and as it was measured."""
        fields = {name: float(getattr(content, name)) for name in SCAN_FIELDS}
        scan = LaserScan(
            **fields, time_increment=0.0, scan_time=0.0, ranges=content.ranges, stamp=self._newest
        )
        try:
            revolution = read_scan(scan, Mount(), "scan", timeout=math.inf)
        except LidarError:
            return
        # A scan belongs to a control period, and before the first there is none.
        if not self.periods:
            return

        row = (self.periods - 1, self._newest)
        self.events.append(
            {
                "scans": row,
                "ranges": self._sort_into_rays(revolution),
                "revolutions": (*row, len(revolution.times)),
                "measurements": revolution[:3],
            }
        )

    def _sort_into_rays(self, revolution: Revolution) -> NDArray[np.float64]:
        """Return the shortest distance in the direction of each ray."""
        spec = self._spec
        ranges = np.full(spec.rays, spec.reach)
        offsets = np.mod(revolution.bearings - spec.angles()[0] + spec.step / 2.0, math.tau)
        rays = np.floor(offsets / spec.step).astype(int)
        hits = (revolution.distances > 0.0) & (rays < spec.rays)
        np.minimum.at(ranges, rays[hits], revolution.distances[hits])
        return ranges
