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
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.robot import hash_config
from acsar_gym.errors import require_extra
from acsar_gym.lidar.scan import ray_spec
from acsar_gym.odometry import POSE_COVARIANCE
from acsar_gym.protocol import WHEELS
from acsar_gym.recording.blocks import FORMAT
from acsar_gym.recording.events import Table, Tables
from acsar_gym.resources import package_version

Floats = NDArray[np.float64]

NANOSECONDS = 1_000_000_000  # in a second
BASE_FOOTPRINT = "base_footprint"  # frame on the ground below the base frame (odometry moves it)
WORLD_FRAME = "world"  # frame of the ground truth
JOINT_NAMES = [f"{wheel}_wheel_joint" for wheel in WHEELS]  # as in acsar.urdf
SHOWN_RATE = 10.0  # how often a second reasons, lateness and movers are shown [Hz]
NODE_NAME = "acsar_gym"  # what reports errors
LOG_ERROR = 40  # level of a rcl_interfaces/msg/Log
MARKER = {
    "ns": "movers",
    "type": 3,
    "pose.position.z": 0.85,
    "pose.orientation.w": 1.0,
    "scale.z": 1.7,
    "color.r": 0.56,
    "color.g": 0.27,
    "color.b": 0.68,
    "color.a": 0.8,
}
"""The cylinder that shows a mover, 1.7 m high [m]."""
PROBE = 0x5A5A0000  # a whole number that no message contains
WORST = {"/safety_reason": "reason", "/lateness": "lateness", "/feedback_age": "feedback_age"}

ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TWIST = "geometry_msgs/msg/Twist"
FLOATS = "std_msgs/msg/Float32MultiArray"
KINDS = {
    "/odom": ODOMETRY,
    "/tf": TRANSFORMS,
    "/joint_states": "sensor_msgs/msg/JointState",
    "/cmd_vel": TWIST,
    "/cmd_vel_sent": TWIST,
    **dict.fromkeys(WORST, "std_msgs/msg/Float64"),
    "/tf_static": TRANSFORMS,
    "/scan": "sensor_msgs/msg/LaserScan",
    "/truth": ODOMETRY,
    "/movers": "visualization_msgs/msg/MarkerArray",
    "/observation": FLOATS,
    "/action": FLOATS,
    "/time_reference": "sensor_msgs/msg/TimeReference",
    "/rosout": "rcl_interfaces/msg/Log",
}
"""All topics of a recording, and the types of their messages."""
UNMEASURED = 1e3
"""Variance of what wheels don't measure, such as roll. robot_localization ("Preparing Your Data")
takes a zero for nearly certain, and from this order on leaves such a part to another sensor."""
MEASURED = POSE_COVARIANCE[0]
POSE_VARIANCES = (MEASURED, MEASURED, UNMEASURED, UNMEASURED, UNMEASURED, MEASURED)
TWIST_VARIANCES = (MEASURED, *[UNMEASURED] * 4, MEASURED)
"""Variances along x, y and z, then those of roll, pitch and yaw, and of their rates."""
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


def to_plain_json(value: Any) -> Any:
    """Return what JSON can hold of a value: NaN and infinity become null, objects their text."""
    text = json.dumps(value, default=_simplify)
    return json.loads(text, parse_constant=lambda name: None)


def _simplify(value: Any) -> Any:
    # A seed may be a number of NumPy.
    return value.item() if isinstance(value, np.number) else str(value)


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
    pose: Sequence[float] | None = None, twist: Sequence[float] | None = None
) -> tuple[Floats, Floats]:
    """Make the covariances of an odometry, row-major 6 x 6 matrices (36,).

    Args:
        pose: Six variances of the pose, as in diff_drive_controller. None for those of the robot's
            own driver, and `UNMEASURED` for what wheels don't measure.
        twist: Six variances of the twist likewise.
    """
    return np.diag(pose or POSE_VARIANCES).ravel(), np.diag(twist or TWIST_VARIANCES).ravel()


@cache
def load_typestore() -> Any:
    """Return the messages of ROS 2 Humble. Raises MissingExtraError without rosbags."""
    with require_extra("recording", "record"):
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - optional
    return get_typestore(Stores.ROS2_HUMBLE)


@cache
def define(kind: str) -> bytes:
    """Return the definition of a type, and of all types in it."""
    # Programs of other distributions of ROS read the types from the file.
    text: str = load_typestore().generate_msgdef(kind, ros_version=2)[0]
    return text.encode()


@cache
def prepare_messages() -> None:
    """Define all types and generate their serializers, for a recording that opens.

    This takes 0.1 s. In the writer's thread it would hold Python's lock while the robot drives.
    """
    for kind in KINDS.values():
        define(kind)
        load_typestore().serialize_cdr(make_message(kind), kind)


def make_message(kind: str, **fields: Any) -> Any:
    """Make a message of zeros and empty lists, such as of "std_msgs/msg/Header".

    Args:
        kind: Type of the message.
        fields: Fields that have another value, by their paths, such as "pose.position.x".
    """
    store = load_typestore()
    blank: dict[str, Any] = {}
    for name, (node, details) in store.fielddefs[kind][1]:
        if node.name == "NAME":
            blank[name] = make_message(details)
        elif node.name == "BASE":
            blank[name] = {"string": "", "bool": False}.get(details[0], 0)
        else:
            (element, base), length = details
            is_plain = element.name == "BASE" and base[0] != "string"
            blank[name] = np.zeros(length, base[0]) if is_plain else []

    message = store.types[kind](**blank)
    for path, value in fields.items():
        setattr(*find_field(message, path), value)
    return message


def find_field(message: Any, path: str) -> tuple[Any, str]:
    """Return the owner and the name of a field such as "pose.position.x" or "markers.0.id"."""
    *parents, name = path.split(".")
    for parent in parents:
        message = message[int(parent)] if parent.isdigit() else getattr(message, parent)
    return message, name


def find_stamped(message: Any) -> Iterator[Any]:
    """Yield all parts of a message that have a `stamp`."""
    if hasattr(message, "stamp"):
        yield message
    fields = message if isinstance(message, list) else getattr(message, "__dict__", {}).values()
    for field in fields:
        yield from find_stamped(field)


class Template:
    """Makes messages of one form: the bytes of one message, with other numbers at their places.

    The place of a number is found by its value in a serialized message.

    Args:
        message: A message of the form.
        numbers: Columns of numbers by path, with a row for each message.
    """

    def __init__(self, message: Any, numbers: Mapping[str, Table]) -> None:
        fields = [find_field(message, path) for path in numbers]
        stamped = list(find_stamped(message))
        fields += [(owner.stamp, name) for owner in stamped for name in ("sec", "nanosec")]
        self._stamps = len(stamped)

        # Each number gets a value that is nowhere else in the message.
        probes: list[Table] = []
        columns = self._add_stamps(numbers, np.zeros(1, np.int64))
        for (owner, name), column in zip(fields, columns, strict=True):
            probe = np.array(PROBE + len(probes), np.int32)
            if column.dtype.kind != "i":
                kind = getattr(getattr(owner, name), "dtype", np.float64)
                probe = np.full(column.shape[1:], len(probes) + 1.0 / 3.0, kind)
            setattr(owner, name, probe if probe.ndim else probe.item())
            probes.append(probe)
        data = bytes(load_typestore().serialize_cdr(message, message.__msgtype__))
        self._places = [(probe.dtype, data.index(probe.tobytes())) for probe in probes]
        self._plain = np.frombuffer(data, np.uint8)

    def _add_stamps(self, numbers: Mapping[str, Table], times: NDArray[np.int64]) -> list[Table]:
        return [*numbers.values(), *self._stamps * np.divmod(times, NANOSECONDS)]

    def fill(self, times: NDArray[np.int64], numbers: Mapping[str, Table]) -> list[bytes]:
        """Make one message for each time [ns], with a row of the numbers."""
        # One row of bytes for each message, whose numbers are overwritten column by column.
        messages = np.tile(self._plain, (len(times), 1))
        columns = self._add_stamps(numbers, times)
        for (kind, place), column in zip(self._places, columns, strict=True):
            data = np.ascontiguousarray(column, kind).view(np.uint8).reshape(len(times), -1)
            messages[:, place : place + data.shape[1]] = data
        return [message.tobytes() for message in messages]


Series = tuple[str, Floats, Mapping[str, Table]]
"""Messages of a topic, one for each row unless its first numbers are NaN: the topic, stamps (n,)
[s], and columns (n, ...) of numbers by path."""


class Publisher:
    """Makes the messages of a robot's tables."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._every = max(1, round(config.control_rate / SHOWN_RATE))
        self._templates: dict[Hashable, Template] = {}

    def make_messages(
        self, head: Mapping[str, Any], tables: Tables
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time [ns] and content of the messages of a block. See `Sink.write`."""
        for topic, stamps, columns in self._list_series(head, tables):
            # The first numbers are NaN in rows that other programs needn't see.
            first = next(iter(columns.values()), stamps)
            is_shown = ~np.isnan(first).all(axis=tuple(range(1, first.ndim)))
            if not is_shown.any():
                continue
            numbers = {path: column[is_shown] for path, column in columns.items()}

            # Messages of one form differ in their numbers only.
            shapes = [values.shape[1:] for values in numbers.values()]
            form = (topic, tables["faults_bytes"].tobytes(), *shapes)
            if form not in self._templates:
                message = make_message(KINDS[topic], **self._fix(topic, tables))
                self._templates[form] = Template(message, numbers)
            times = np.rint(stamps[is_shown] * 1e9).astype(np.int64) + head["offset"]
            times = np.maximum(times, 0)
            messages = self._templates[form].fill(times, numbers)
            for moment, data in zip(times.tolist(), messages, strict=True):
                yield topic, moment, data

    def _list_series(self, head: Mapping[str, Any], tables: Tables) -> Iterator[Series]:
        """Yield what is shown of a block, topic by topic."""
        ticks = tables["ticks"]
        stamps = ticks["stamp"]
        if len(ticks):
            place = "transforms.0.transform"
            moved = _list_pose(ticks, f"{place}.translation", f"{place}.rotation")
            joints = {"position": ticks["angles"], "velocity": ticks["speeds"]}
            yield ("/odom", stamps, _list_odometry(ticks))
            yield ("/tf", stamps, moved)
            yield ("/joint_states", stamps, joints)
            yield ("/cmd_vel", stamps, _list_twist(ticks["asked"]))
            yield ("/cmd_vel_sent", stamps, _list_twist(ticks["sent"]))
            # The worst of some ticks, as plain numbers.
            firsts = np.arange(0, len(ticks), self._every)
            for topic, name in WORST.items():
                worst = np.fmax.reduceat(ticks[name].astype(float), firsts)
                yield (topic, stamps[firsts], {"data": worst})

        clocks = tables["clocks"]
        ranges = tables["ranges"]
        shown = np.where(ranges >= self._config.lidar.max_range, np.inf, ranges)
        exchanges = tables["exchanges"]
        yield ("/tf_static", clocks["stamp"][clocks["stamp"] == head["start"]], {})
        yield ("/scan", tables["scans"]["stamp"], {"ranges": shown.astype(np.float32)})
        yield ("/truth", exchanges["stamp"], _list_odometry(exchanges))

        # Movers are recorded in each period, which is more than a viewer needs.
        movers = tables["movers"]
        rows = movers["exchange"] % self._every == 0
        states = tables["mover_states"][rows]
        if len(states):
            yield ("/movers", movers["stamp"][rows], _place_movers(states, head))

        steps = tables["steps"]["stamp"]
        seconds, nanoseconds = np.divmod(clocks["wall"], NANOSECONDS)
        wall = {"time_ref.sec": seconds, "time_ref.nanosec": nanoseconds}
        yield ("/observation", steps, {"data": tables["observations"]})
        yield ("/action", steps, {"data": tables["actions"]})
        yield ("/time_reference", clocks["stamp"], wall)
        yield ("/rosout", tables["faults"]["stamp"][:1], {})  # several are one message

    def _fix(self, topic: str, tables: Tables) -> dict[str, Any]:
        """Return what is the same in all messages of a topic, by path."""
        config = self._config
        fields: dict[str, Any] = {}

        match topic:
            case "/odom":
                pose, twist = make_covariances()
                fields = {
                    "header.frame_id": config.odom_frame,
                    "child_frame_id": BASE_FOOTPRINT,
                    "pose.covariance": pose,
                    "twist.covariance": twist,
                }
            case "/truth":
                # It is exact: its covariances are zero.
                fields = {"header.frame_id": WORLD_FRAME, "child_frame_id": BASE_FOOTPRINT}
            case "/tf":
                fields = {"transforms": [_make_transform(config.odom_frame, BASE_FOOTPRINT)]}
            case "/tf_static":
                # The base is above the ground by a wheel's radius, the LiDAR is on the base.
                base = config.base_frame
                mount = (config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset)
                axle = (0.0, 0.0, config.wheel_radius)
                fields = {
                    "transforms": [
                        _make_transform(BASE_FOOTPRINT, base, axle),
                        _make_transform(base, config.lidar_frame, mount),
                    ]
                }
            case "/joint_states":
                fields = {"name": JOINT_NAMES}
            case "/scan":
                # No time passes between rays: all are as from the robot's pose at the stamp.
                spec = ray_spec(config)
                angles = spec.angles()
                fields = {
                    "header.frame_id": config.lidar_frame,
                    "angle_min": angles[0],
                    "angle_max": angles[-1],
                    "angle_increment": spec.step,
                    "scan_time": 1.0 / config.lidar.rate,
                    "range_min": config.lidar.min_range,
                    "range_max": config.lidar.max_range,
                }
            case "/movers":
                # A cylinder for each mover.
                kind = "visualization_msgs/msg/Marker"
                marker = {"header.frame_id": config.odom_frame, **MARKER}
                count = tables["mover_states"].shape[1]
                fields = {"markers": [make_message(kind, id=n, **marker) for n in range(count)]}
            case "/time_reference":
                fields = {"source": "wall clock"}
            case "/rosout":
                text = tables["faults_bytes"].tobytes().decode()
                fields = {"level": LOG_ERROR, "name": NODE_NAME, "msg": text}
        return fields


def _list_pose(table: Table, place: str, turn: str) -> dict[str, Table]:
    """The numbers of poses, whose place and quaternion have these paths."""
    x, y, theta = table["pose"].T
    half = theta / 2.0
    return {f"{place}.x": x, f"{place}.y": y, f"{turn}.z": np.sin(half), f"{turn}.w": np.cos(half)}


def _list_twist(twists: Table, path: str = "") -> dict[str, Table]:
    return {f"{path}linear.x": twists[:, 0], f"{path}angular.z": twists[:, 1]}


def _list_odometry(table: Table) -> dict[str, Table]:
    pose = _list_pose(table, "pose.pose.position", "pose.pose.orientation")
    return pose | _list_twist(table["twist"], "twist.twist.")


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


def _make_transform(
    parent: str, child: str, place: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Any:
    """Make a transform without a turn, which a moving frame gets later."""
    message = make_message(
        "geometry_msgs/msg/TransformStamped",
        **{"header.frame_id": parent, "child_frame_id": child, "transform.rotation.w": 1.0},
    )
    translation = message.transform.translation
    translation.x, translation.y, translation.z = place
    return message
