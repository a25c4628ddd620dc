"""Makes recordings of ROS 2 bags.

A bag has no bytes of a wire. Its messages are written as a recording of this package: joint states,
or else an odometry's twists, as feedback lines; twists of /cmd_vel, by the robot's kinematics, as
command lines, each at the time at which the bag has it; and scans. So every tool reads it.
"""

from __future__ import annotations

import atexit
import math
import shutil
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    ConfigError,
    LidarError,
    RecordingWarning,
    escape_unprintable,
    show_value,
)
from acsar_gym.lidar.laser_scan import LaserScan, Mount, read_scan
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.odometry import Odometry
from acsar_gym.protocol import Speeds, encode
from acsar_gym.reading import open_file
from acsar_gym.recording.bag_files import PACKED, BagFiles, BagMessage
from acsar_gym.recording.blocks import MAGIC, find_block
from acsar_gym.recording.events import Began, Event, Exchange, Scanned, Tick, Written
from acsar_gym.recording.messages import load_typestore, make_header
from acsar_gym.recording.writer import RecordingWriter
from acsar_gym.ros.joints import WRAPPING_RANGE, JointReader

JOINT_STATE = "sensor_msgs/msg/JointState"
ODOMETRY = "nav_msgs/msg/Odometry"
TWISTS = ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped")
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ROLES = {
    "joint states": ((JOINT_STATE,), "/joint_states"),
    "odometry": ((ODOMETRY,), "/odom"),
    "commands": (TWISTS, "/cmd_vel"),
    "scans": ((LASER_SCAN,), "/scan"),
}
"""What is read of a bag: types, and the usual name of the topic."""
IDENTIFYING_BYTES = 5_000_000  # a recording of this package has its first block within these
BATCH = 300  # events of a block
MAX_TIME = 2**62  # times are smaller [ns]
FASTEST_WHEEL = 99.99  # largest speed that a line can express, either sign [rad/s]


def is_recording(path: Path) -> bool:
    """Whether a file is a recording of this package; ConfigError if it can't be read."""
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
        topics: Topics of a bag that are used, or namespaces; all if empty.

    Raises:
        ConfigError: It is neither, or the bag has no wheel speeds.
    """
    if is_recording(path):
        if topics:
            raise ConfigError(f"{path}: --topics is for ROS 2 bags; this is a recording")
        return path
    if robot is None:
        raise ConfigError(f"{path}: is a ROS 2 bag: name its robot with --robot PRESET|FILE")
    folder = Path(tempfile.mkdtemp(prefix="acsar-gym-bag-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    (folder / "unpacked").mkdir()
    target = folder / f"{path.stem if path.is_file() else path.name}.mcap"
    import_bag(path, robot, target, topics)
    return target


def import_bag(path: Path, robot: RobotConfig, target: Path, topics: Sequence[str] = ()) -> None:
    """Write a bag as a recording. Arguments and errors are those of `open_recording`."""
    files = BagFiles(path, target.parent / "unpacked")
    survey: dict[str, BagMessage] = {}
    for message in files.read_messages():
        survey.setdefault(message.topic, message)
    chosen = choose_topics(path, survey, topics, robot)
    joints = chosen.get("joint states")
    wraps = joints is None or check_positions(path, files, survey[joints], robot)
    converter = BagConverter(robot, chosen, wraps=wraps)

    header = make_header(robot, {"command": "bag", "bag": path.name, "topics": chosen})
    wanted = set(chosen.values())
    writer: RecordingWriter | None = None
    events: list[Event] = []
    for message in files.read_messages():
        if message.topic not in wanted:
            continue
        if writer is None:
            header |= {"process": 0, "source": files.compute_hash()}
            header["created"] = {"wall": message.time, "monotonic": 0}
            writer = RecordingWriter(target, robot, header)
        events += converter.take(message)
        if len(events) >= BATCH:
            writer.add(events)
            writer.write_block()
            events.clear()

    if writer is None or not converter.has_feedback:
        raise ConfigError(f"{path}: has no wheel speeds on {', '.join(chosen.values())}")
    writer.add([*events, *converter.finish()])
    writer.close(0)
    if converter.refused:
        counts = ", ".join(f"{count:,} {kind}" for kind, count in converter.refused.items())
        text = f"{path}: messages of {joints} were left out: {counts}"
        warnings.warn(escape_unprintable(text), RecordingWarning, stacklevel=3)


def check_positions(path: Path, files: BagFiles, joints: BagMessage, robot: RobotConfig) -> bool:
    """Whether positions of joint states may wrap at full turns.

    Raises:
        ConfigError: There are only positions, and it is unknown how far wheels turned between them.
    """
    content = deserialize(joints.data, JOINT_STATE)
    if content is None or _has_velocities(content):
        return True
    largest = 0.0
    times: list[float] = []
    for message in files.read_messages():
        content = deserialize(message.data, JOINT_STATE) if message.topic == joints.topic else None
        if content is not None:
            if _has_velocities(content):
                return True
            positions = [abs(position) for position in content.position if math.isfinite(position)]
            largest = max(largest, *positions, 0.0)
            times.append(message.time / 1e9)

    if largest >= WRAPPING_RANGE:
        return False
    pause = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if pause * robot.max_wheel_speed > math.pi:
        raise ConfigError(
            f"{path}: {joints.topic} has positions without velocities, {1.0 / pause:.1f} times a "
            f"second: a wheel at {robot.max_wheel_speed:g} rad/s turns by more than half a turn "
            "meanwhile, so its speed is unknown"
        )
    return True


def _has_velocities(content: Any) -> bool:
    return len(content.velocity) > 0 and not np.isnan(content.velocity).all()


def choose_topics(
    path: Path, survey: Mapping[str, BagMessage], wanted: Sequence[str], robot: RobotConfig
) -> dict[str, str]:
    """Choose a bag's topic for each role of `ROLES` that it has.

    Args:
        path: The bag.
        survey: The first message of each topic.
        wanted: Topics or namespaces that the user named; all if empty.
        robot: Robot configuration.

    Raises:
        ConfigError: There are no wheel speeds, or several topics of a role.
    """
    listing = ", ".join(f"{name} ({topic.kind})" for name, topic in sorted(survey.items()))
    for name in wanted:
        if not any(is_below(topic, name) for topic in survey):
            listing = escape_unprintable(listing, 300)
            raise ConfigError(f"{path}: has no topic {show_value(name)}: it has {listing}")

    chosen: dict[str, str] = {}
    for role, (kinds, usual) in ROLES.items():
        if role == "odometry" and chosen:
            continue
        names = [
            name
            for name, topic in survey.items()
            if topic.kind in kinds
            and (not wanted or any(is_below(name, prefix) for prefix in wanted))
            and (role != "joint states" or find_wheels(_joint_names(topic), robot))
        ]
        for usual_names in (
            [n for n in names if n.endswith(usual)],
            [n for n in names if n == usual],
        ):
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
        joints = [joint for topic in survey.values() for joint in _joint_names(topic)]
        holds = f"it has {listing}"
        if joints:
            listing = escape_unprintable(", ".join(joints), 200)
            holds = f"its joints are {listing}: write the wheels' into ros2.joints of --robot"
        raise ConfigError(
            f"{path}: has no wheel speeds, neither joint states of the robot's wheels nor an "
            f"odometry: {escape_unprintable(holds, 300)}"
        )
    return chosen


def is_below(topic: str, name: str) -> bool:
    """Whether a topic has a name, or is in a namespace of that name."""
    plain = "/" + name.strip("/")
    return topic == plain or topic.startswith(f"{plain}/")


def deserialize(message: bytes, kind: str) -> Any:
    """Decode a message; None where it is broken."""
    try:
        return load_typestore().deserialize_cdr(message, kind)
    except Exception:  # noqa: BLE001 - a broken message can make it raise anything
        return None


def _joint_names(message: BagMessage) -> list[str]:
    state = deserialize(message.data, JOINT_STATE) if message.kind == JOINT_STATE else None
    return [] if state is None else [str(name) for name in state.name]


def find_wheels(names: Sequence[str], robot: RobotConfig) -> tuple[int, ...] | None:
    """Find the robot's `ros_joints` of the wheels a, b, c, d. None if a joint is missing."""
    joints = robot.ros_joints
    return tuple(map(names.index, joints)) if {*joints} <= {*names} else None


class BagConverter:
    """Makes events of a robot's messages, as a recorder gets them.

    Args:
        robot: Robot configuration.
        topics: Topics by role.
        wraps: Whether positions of joints may wrap at full turns.

    Attributes:
        has_feedback: Whether there were wheel speeds.
        refused: Number of joint states that can't be right, by reason.
    """

    def __init__(self, robot: RobotConfig, topics: Mapping[str, str], *, wraps: bool) -> None:
        self.has_feedback = False
        self.refused: Counter[str] = Counter()
        self._robot = robot
        self._odometry = Odometry.of(robot)
        self._wraps = wraps
        makers: dict[str, Callable[[Any, float], list[Event]]] = {
            "joint states": self._take_joints,
            "odometry": self._take_odometry,
            "commands": self._take_command,
            "scans": self._take_scan,
        }
        self._makers = {name: makers[role] for role, name in topics.items()}

        self._first = -1
        self._newest = self._last_feedback = 0.0
        self._number = 0
        self._sent: list[tuple[float, bytes]] = []
        self._asked = (math.nan, math.nan)
        self._command = (0.0, 0.0)
        self._joints: JointReader | None = None
        self._has_moved = False
        self._spec = ray_spec(robot)

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
        if self._joints is not None:
            self.refused += self._joints.refused
        return [Written(tuple(self._sent))] if self._sent else []

    def _take_command(self, content: Any, stamp: float) -> list[Event]:
        twist = getattr(content, "twist", content)
        command = (float(twist.linear.x), float(twist.angular.z))
        if all(map(math.isfinite, command)):
            self._asked = self._command = command
            speeds = self._make_speeds(*command)
            letters = self._robot.wheels.motors
            line = encode(speeds if letters is None else letters.to_wire(speeds))
            self._sent.append((stamp, line))
        return []

    def _make_speeds(self, linear: float, angular: float) -> Speeds:
        separation = self._robot.effective_separation
        sides = kinematics.compute_sides(
            linear, angular, *self._robot.wheel_radii, separation, FASTEST_WHEEL
        )
        return sides[0], sides[1], sides[1], sides[0]

    def _take_odometry(self, content: Any, stamp: float) -> list[Event]:
        twist = content.twist.twist
        measured = (float(twist.linear.x), float(twist.angular.z))
        if not all(map(math.isfinite, measured)):
            return []
        return self._exchange(self._make_speeds(*measured), stamp)

    def _take_joints(self, content: Any, stamp: float) -> list[Event]:
        names = list(content.name)
        if self._joints is None:
            wheels = find_wheels(names, self._robot)
            if wheels is None:
                return []
            self._joints = JointReader([names[wheel] for wheel in wheels], wraps=self._wraps)

        # A joint_state_publisher that runs beside the robot's own publisher.
        has_velocities = _has_velocities(content)
        has_position = bool(np.any(content.position))
        if self._has_moved and not has_velocities and not has_position:
            self.refused["with all positions zero"] += 1
            return []
        self._has_moved = self._has_moved or has_position

        when = content.header.stamp.sec + content.header.stamp.nanosec / 1e9
        if has_velocities or not when:
            when = self._first / 1e9 + stamp
        speeds = self._joints.read(names, content.position, content.velocity, when)
        if speeds is None:
            return []
        if max(map(abs, speeds)) > FASTEST_WHEEL:
            self.refused["too fast"] += 1
            return []
        return self._exchange(speeds, stamp)

    def _exchange(self, speeds: Speeds, stamp: float) -> list[Event]:
        """A feedback line, and the tick that it ends."""
        self.has_feedback = True
        self._odometry.update(speeds, stamp - self._last_feedback)
        self._last_feedback = stamp
        letters = self._robot.wheels.encoders
        line = encode(speeds if letters is None else letters.to_wire(speeds))

        exchange = Exchange(
            number=self._number,
            stamp=stamp,
            sent=tuple(self._sent),
            received=((stamp, line),),
            lateness=None,
            truth=None,
        )
        tick = Tick(
            exchange=self._number,
            stamp=stamp,
            pose=self._odometry.pose,
            twist=self._odometry.twist,
            speeds=speeds,
            angles=self._odometry.wheel_positions,
            asked=self._asked,
            sent=self._command,
            reason=0,
            lateness=None,
            feedback_age=0.0,
            refused=0,
        )
        self._number += 1
        self._sent = []
        return [exchange, tick]

    def _take_scan(self, content: Any, stamp: float) -> list[Event]:
        """A scan, sorted into the rays of the robot's LiDAR, and as it was measured."""
        scan = LaserScan(
            angle_min=float(content.angle_min),
            angle_increment=float(content.angle_increment),
            time_increment=0.0,
            scan_time=0.0,
            range_min=float(content.range_min),
            range_max=float(content.range_max),
            ranges=content.ranges,
            stamp=stamp,
        )
        try:
            revolution = read_scan(scan, Mount(), "scan", timeout=math.inf)
        except LidarError:
            return []
        if not self._number:
            return []

        spec = self._spec
        ranges = np.full(spec.rays, spec.reach)
        offsets = np.mod(revolution.bearings - spec.angles()[0] + spec.step / 2.0, math.tau)
        rays = np.floor(offsets / spec.step).astype(int)
        hits = (revolution.distances > 0.0) & (rays < spec.rays)
        np.minimum.at(ranges, rays[hits], revolution.distances[hits])
        return [Scanned(self._number - 1, stamp, ranges, revolution)]
