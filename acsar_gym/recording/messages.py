"""What other programs read of a recording: its ROS 2 messages, made of its tables.

The header, in the first block, is what is needed to read, repeat and align a recording:

| key | content |
|---|---|
| `format` | number of this format |
| `config`, `config_sha256` | the robot, and the hash of its whole config |
| `versions` | of acsar_gym, python, numpy |
| `process` | id of the process that records, which listens for an emergency stop on hardware |
| `created` | `wall` clock [ns since 1970] and `monotonic` clock [ns] at the same moment. |
| | the table `clocks` repeats the wall clock every second |
| `about` | what the program states: `env` (id, kwargs), `task`, `observation` (names of its |
| | numbers), `policy` (file, sha256), `link`, `command` |
| `source` | in a recording that was made of a ROS 2 bag: a hash of the bag |

A message whose strings and lists have a fixed length has each of its numbers at a fixed place. So
many messages are one NumPy array with one row each, which costs about as much as one message.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Hashable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib import metadata
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.robot import hash_config
from acsar_gym.errors import require_extra
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.odometry import POSE_COVARIANCE, TWIST_COVARIANCE
from acsar_gym.protocol import WHEELS
from acsar_gym.recording.blocks import FORMAT
from acsar_gym.recording.events import Table, Tables, split_columns

Floats = NDArray[np.float64]

NANOSECONDS = 1_000_000_000  # in a second
BASE_FOOTPRINT = "base_footprint"  # frame on the ground below the base frame (odometry moves it)
WORLD_FRAME = "world"  # frame of the ground truth
JOINT_NAMES = [f"{wheel}_wheel_joint" for wheel in WHEELS]  # as in acsar.urdf
SHOWN_RATE = 10.0  # how often a second reasons, lateness and movers are shown [Hz]
NODE_NAME = "acsar_gym"  # what reports errors
LOG_ERROR = 40  # level of a rcl_interfaces/msg/Log
MARKER_HEIGHT = 1.7  # of the cylinder that shows a mover [m]
MARKER_COLOUR = {"r": 0.56, "g": 0.27, "b": 0.68, "a": 0.8}
CYLINDER = 3  # type of a marker
UNMEASURED_VARIANCE = 1e3
"""Variance of what wheels don't measure, such as roll. robot_localization ("Preparing Your Data")
takes a zero for nearly certain, and from this order on leaves such a part to another sensor."""
DIAGONAL = np.arange(0, 36, 7)  # places of the variances in a row-major 6 x 6 matrix
UNMEASURED = DIAGONAL[2:5]  # z, roll and pitch
UNMEASURED_RATES = DIAGONAL[1:5]  # velocities along y and z, rates of roll and pitch
LATCHED_QOS = """- history: 3
  depth: 0
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""
"""Quality of service for topics whose newest message late listeners get, as rosbag2 writes it."""


def package_version() -> str:
    """Return the version of this package."""
    try:
        return metadata.version("acsar_gym")
    except metadata.PackageNotFoundError:  # used from its folder, not installed
        return "unknown"


def to_plain_json(value: Any) -> Any:
    """Return what JSON can hold of a value: NaN and infinity become null, objects their text."""
    return json.loads(json.dumps(value, default=str), parse_constant=lambda name: None)


def make_header(config: RobotConfig, about: Mapping[str, Any]) -> dict[str, Any]:
    """Make the header of a recording that begins now."""
    return {
        "format": FORMAT,
        "config": config.model_dump(mode="json"),
        "config_sha256": hash_config(config),
        "versions": {
            "acsar_gym": package_version(),
            "numpy": np.__version__,
            "python": platform.python_version(),
        },
        "process": os.getpid(),
        "created": {"wall": time.time_ns(), "monotonic": time.monotonic_ns()},
        "about": to_plain_json(dict(about)),
    }


def make_covariances(
    pose_diagonal: Sequence[float] | None = None, twist_diagonal: Sequence[float] | None = None
) -> tuple[Floats, Floats]:
    """Make the covariances of an odometry, row-major 6 x 6 matrices (36,).

    Args:
        pose_diagonal: Six variances of the pose, as in diff_drive_controller. None for those of
            the robot's own driver, and `UNMEASURED_VARIANCE` for what wheels don't measure.
        twist_diagonal: Six variances of the twist likewise.
    """
    pose = np.array(POSE_COVARIANCE)
    pose[UNMEASURED] = UNMEASURED_VARIANCE
    if pose_diagonal is not None:
        pose[DIAGONAL] = pose_diagonal

    twist = np.array(TWIST_COVARIANCE)
    twist[UNMEASURED_RATES] = UNMEASURED_VARIANCE
    if twist_diagonal is not None:
        twist[DIAGONAL] = twist_diagonal
    return pose, twist


@cache
def load_typestore() -> Any:
    """Return the messages of ROS 2 Humble. Raises MissingExtraError without rosbags."""
    with require_extra("recording", "record"):
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - optional
    return get_typestore(Stores.ROS2_HUMBLE)


def define(kind: str) -> bytes:
    """Return the definition of a type, and of all types in it."""
    text: str = load_typestore().generate_msgdef(kind, ros_version=2)[0]
    return text.encode()


def make_blank(kind: str, **fixed: Any) -> Any:
    """Make a message of zeros and empty lists, such as of "std_msgs/msg/Header".

    Args:
        kind: Type of the message.
        fixed: Fields that have another value.
    """
    store = load_typestore()
    fields: dict[str, Any] = {}
    for name, (node, details) in store.fielddefs[kind][1]:
        if node.name == "NAME":
            fields[name] = make_blank(details)
        elif node.name == "BASE":
            fields[name] = {"string": "", "bool": False}.get(details[0], 0)
        else:
            (element, base), length = details
            is_plain = element.name == "BASE" and base[0] != "string"
            fields[name] = np.zeros(length, base[0]) if is_plain else []
    return store.types[kind](**fields | fixed)


def split_path(message: Any, path: str) -> tuple[Any, str]:
    """Return the owner and the name of a field such as "pose.position.x" or "markers.0.id"."""
    *parents, name = path.split(".")
    for parent in parents:
        message = message[int(parent)] if parent.isdigit() else getattr(message, parent)
    return message, name


def set_field(message: Any, path: str, value: Any) -> None:
    """Set a field by its path."""
    owner, name = split_path(message, path)
    setattr(owner, name, value)


def find_stamped(message: Any) -> Iterator[Any]:
    """Yield all parts of a message that have a `stamp`."""
    if hasattr(message, "stamp"):
        yield message
    fields = message if isinstance(message, list) else getattr(message, "__dict__", {}).values()
    for field in fields:
        yield from find_stamped(field)


class Template:
    """Makes messages of one form: the bytes of one message, with other numbers at their places.

    The place of a number is found by serializing the message without it and with it.

    Args:
        kind: Type of the messages.
        fixed: Fields that are the same in all messages, by path.
        numbers: Columns of numbers by path, with a row for each message.
    """

    def __init__(self, kind: str, fixed: Mapping[str, Any], numbers: Mapping[str, Table]) -> None:
        message = make_blank(kind)
        for path, value in fixed.items():
            set_field(message, path, value)
        fields = [split_path(message, path) for path in numbers]
        for (owner, name), column in zip(fields, numbers.values(), strict=True):
            if column.ndim > 1:  # a list, which has a length from now on
                setattr(owner, name, np.zeros(column.shape[1:], getattr(owner, name).dtype))
        stamped = list(find_stamped(message))
        fields += [(owner.stamp, name) for owner in stamped for name in ("sec", "nanosec")]
        serialize = partial(load_typestore().serialize_cdr, message, kind)
        self._plain = np.frombuffer(serialize(), np.uint8)
        self._stamps = len(stamped)
        self._places: list[tuple[str, int]] = []

        columns = self._add_stamps(numbers, np.zeros(1, np.int64))
        for (owner, name), column in zip(fields, columns, strict=True):
            # No byte of these is zero, as a float of any size and as an integer.
            is_integer = column.dtype.kind == "i"
            blank = getattr(owner, name)
            setattr(owner, name, blank + (0x01010101 if is_integer else 1.0 / 3.0))
            changed = np.frombuffer(serialize(), np.uint8)
            setattr(owner, name, blank)
            places = np.flatnonzero(self._plain != changed)
            size = len(places) // column[0].size
            self._places.append((f"<{'i' if is_integer else 'f'}{size}", int(places[0])))

    def _add_stamps(self, numbers: Mapping[str, Table], times: NDArray[np.int64]) -> list[Table]:
        return [*numbers.values(), *self._stamps * [times // NANOSECONDS, times % NANOSECONDS]]

    def fill(self, times: NDArray[np.int64], numbers: Mapping[str, Table]) -> list[bytes]:
        """Make one message for each time [ns], with a row of the numbers."""
        messages = np.tile(self._plain, (len(times), 1))
        columns = self._add_stamps(numbers, times)
        for (kind, place), column in zip(self._places, columns, strict=True):
            data = np.ascontiguousarray(column, kind).view(np.uint8).reshape(len(times), -1)
            messages[:, place : place + data.shape[1]] = data
        return [message.tobytes() for message in messages]


POSE = {
    "pose.pose.position.x": "x",
    "pose.pose.position.y": "y",
    "pose.pose.orientation.z": "sin",
    "pose.pose.orientation.w": "cos",
    "twist.twist.linear.x": "linear",
    "twist.twist.angular.z": "angular",
}
TRANSFORM = {
    "transforms.0.transform.translation.x": "x",
    "transforms.0.transform.translation.y": "y",
    "transforms.0.transform.rotation.z": "sin",
    "transforms.0.transform.rotation.w": "cos",
}
JOINTS = {"position": "angles", "velocity": "speeds"}
ASKED = {"linear.x": "asked_linear", "angular.z": "asked_angular"}
SENT = {"linear.x": "sent_linear", "angular.z": "sent_angular"}
WALL_TIME = {"time_ref.sec": "sec", "time_ref.nanosec": "nanosec"}


class Topic(NamedTuple):
    """A topic: one message for each row of a table of `list_shown`, unless its numbers are NaN."""

    kind: str
    table: str
    numbers: Mapping[str, str] | None = None
    """Column of each number of the message, by its path. None if columns are named by paths."""


TOPICS = {
    "/odom": Topic("nav_msgs/msg/Odometry", "ticks", POSE),
    "/tf": Topic("tf2_msgs/msg/TFMessage", "ticks", TRANSFORM),
    "/tf_static": Topic("tf2_msgs/msg/TFMessage", "resets", {}),
    "/joint_states": Topic("sensor_msgs/msg/JointState", "ticks", JOINTS),
    "/cmd_vel": Topic("geometry_msgs/msg/Twist", "ticks", ASKED),
    "/cmd_vel_sent": Topic("geometry_msgs/msg/Twist", "ticks", SENT),
    "/safety_reason": Topic("std_msgs/msg/Float64", "worst", {"data": "reason"}),
    "/lateness": Topic("std_msgs/msg/Float64", "worst", {"data": "lateness"}),
    "/feedback_age": Topic("std_msgs/msg/Float64", "worst", {"data": "feedback_age"}),
    "/scan": Topic("sensor_msgs/msg/LaserScan", "scans"),
    "/truth": Topic("nav_msgs/msg/Odometry", "exchanges", POSE),
    "/movers": Topic("visualization_msgs/msg/MarkerArray", "movers"),
    "/observation": Topic("std_msgs/msg/Float32MultiArray", "steps", {"data": "observation"}),
    "/action": Topic("std_msgs/msg/Float32MultiArray", "steps", {"data": "action"}),
    "/time_reference": Topic("sensor_msgs/msg/TimeReference", "clocks", WALL_TIME),
    "/rosout": Topic("rcl_interfaces/msg/Log", "faults", {}),
}
LATCHED = ("/tf_static",)


def list_shown(
    tables: Tables, head: Mapping[str, Any], config: RobotConfig
) -> dict[str, dict[str, Table]]:
    """Return columns of what is shown of a block, with a `stamp` of each row [s]."""
    ticks = tables["ticks"]
    clocks = tables["clocks"]
    steps = {"observation": tables["observations"], "action": tables["actions"]}
    ranges = tables["ranges"]
    reach = config.lidar.max_range

    shown = {
        "ticks": {**_split_poses(ticks), "angles": ticks["angles"], "speeds": ticks["speeds"]},
        "exchanges": _split_poses(tables["exchanges"]),
        "steps": {"stamp": tables["steps"]["stamp"], **steps},
        "scans": {
            "stamp": tables["scans"]["stamp"],
            "ranges": np.where(ranges >= reach, np.inf, ranges).astype(np.float32),
        },
        "clocks": {
            "stamp": clocks["stamp"],
            "sec": clocks["wall"] // NANOSECONDS,
            "nanosec": clocks["wall"] % NANOSECONDS,
        },
        "resets": {"stamp": clocks["stamp"][clocks["stamp"] == head["start"]]},
        "faults": {"stamp": tables["faults"]["stamp"][:1]},  # several in a block are one message
    }

    every = max(1, round(config.control_rate / SHOWN_RATE))
    if len(ticks):
        begins = np.arange(0, len(ticks), every)
        names = ("reason", "lateness", "feedback_age")
        worst = {name: np.fmax.reduceat(ticks[name].astype(float), begins) for name in names}
        shown["worst"] = {"stamp": ticks["stamp"][begins], **worst}
    if len(tables["movers"]):
        rows = tables["movers"]["exchange"] % every == 0
        states = tables["mover_states"][rows]
        shown["movers"] = {"stamp": tables["movers"]["stamp"][rows], **_place_movers(states, head)}
    return shown


def _split_poses(table: Table) -> dict[str, Table]:
    """Columns of a table with poses, and those of their quaternions."""
    columns = split_columns(table)
    half = columns["theta"] / 2.0
    return {**columns, "sin": np.sin(half), "cos": np.cos(half)}


def _place_movers(states: Table, head: Mapping[str, Any]) -> dict[str, Table]:
    """The numbers of a marker for each mover, in the frame of the odometry."""
    x, y, theta = head["info"].get("start", (0.0, 0.0, 0.0))
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    places = (states[:, :, :2] - (x, y)) @ turn
    columns: dict[str, Table] = {}
    for number in range(states.shape[1]):
        for axis, name in enumerate("xy"):
            columns[f"markers.{number}.pose.position.{name}"] = places[:, number, axis]
            columns[f"markers.{number}.scale.{name}"] = 2.0 * states[:, number, 4]
    return columns


def fix_fields(tables: Tables, config: RobotConfig) -> dict[str, dict[str, Any]]:
    """Return what is the same in all messages of a topic, by path."""
    pose, twist = make_covariances()
    odometry = {
        "header.frame_id": config.odom_frame,
        "child_frame_id": BASE_FOOTPRINT,
        "pose.covariance": pose,
        "twist.covariance": twist,
    }
    lidar = config.lidar
    spec = ray_spec(config)
    angles = spec.angles()
    axle = (0.0, 0.0, config.wheel_radius)
    mount = (config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset)

    return {
        "/odom": odometry,
        "/truth": odometry | {"header.frame_id": WORLD_FRAME},
        "/tf": {"transforms": [_make_transform(config.odom_frame, BASE_FOOTPRINT)]},
        "/tf_static": {
            "transforms": [
                _make_transform(BASE_FOOTPRINT, config.base_frame, axle, turn=1.0),
                _make_transform(config.base_frame, config.lidar_frame, mount, turn=1.0),
            ]
        },
        "/joint_states": {"name": JOINT_NAMES},
        # All rays are as from the robot's pose at the stamp: no time passes between them.
        "/scan": {
            "header.frame_id": config.lidar_frame,
            "angle_min": angles[0],
            "angle_max": angles[-1],
            "angle_increment": spec.step,
            "scan_time": 1.0 / lidar.rate,
            "range_min": lidar.min_range,
            "range_max": lidar.max_range,
        },
        "/movers": {
            "markers": [
                _make_marker(number, config) for number in range(tables["mover_states"].shape[1])
            ]
        },
        "/time_reference": {"source": "wall clock"},
        "/rosout": {
            "level": LOG_ERROR,
            "name": NODE_NAME,
            "msg": tables["faults_bytes"].tobytes().decode(),
        },
    }


def _make_transform(
    parent: str, child: str, place: Sequence[float] = (0.0, 0.0, 0.0), turn: float = 0.0
) -> Any:
    transform = make_blank("geometry_msgs/msg/TransformStamped", child_frame_id=child)
    transform.header.frame_id = parent
    transform.transform.rotation.w = turn
    for axis, value in zip("xyz", place, strict=True):
        set_field(transform, f"transform.translation.{axis}", float(value))
    return transform


def _make_marker(number: int, config: RobotConfig) -> Any:
    """A cylinder for a mover."""
    marker = make_blank("visualization_msgs/msg/Marker", ns="movers", id=number, type=CYLINDER)
    marker.header.frame_id = config.odom_frame
    marker.color = make_blank("std_msgs/msg/ColorRGBA", **MARKER_COLOUR)
    marker.pose.orientation.w = 1.0
    marker.pose.position.z = MARKER_HEIGHT / 2.0
    marker.scale.z = MARKER_HEIGHT
    return marker


class Publisher:
    """Makes the messages of a robot's tables."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._templates: dict[Hashable, Template] = {}

    def make_messages(
        self, head: Mapping[str, Any], tables: Tables
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time [ns] and content of the messages of a block. See `Sink.write`."""
        shown = list_shown(tables, head, self._config)
        for name, topic in TOPICS.items():
            columns = dict(shown.get(topic.table, {"stamp": np.zeros(0)}))
            stamps = columns.pop("stamp")
            if not len(stamps):
                continue
            paths = topic.numbers
            numbers = columns if paths is None else {p: columns[paths[p]] for p in paths}
            for column in list(numbers.values())[:1]:
                is_known = ~np.isnan(column.reshape(len(stamps), -1)).all(axis=1)
                stamps = stamps[is_known]
                numbers = {path: values[is_known] for path, values in numbers.items()}
            if not len(stamps):
                continue

            # Messages of one form differ in their numbers only.
            shapes = [values.shape[1:] for values in numbers.values()]
            form = (name, tables["faults_bytes"].tobytes(), *shapes)
            if form not in self._templates:
                fixed = fix_fields(tables, self._config).get(name, {})
                self._templates[form] = Template(topic.kind, fixed, numbers)
            times = np.rint(stamps * 1e9).astype(np.int64) + head["offset"]
            times = np.maximum(times, 0)
            messages = self._templates[form].fill(times, numbers)
            for moment, data in zip(times.tolist(), messages, strict=True):
                yield name, moment, data
