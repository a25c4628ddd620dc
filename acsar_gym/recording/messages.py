"""What other programs read of a recording: its ROS 2 messages, made of its tables.

The header, in the first block, is what is needed to read, repeat and align a recording:

| key | content |
|---|---|
| `format` | number of this format |
| `config`, `config_sha256` | the robot, and the hash of its whole config |
| `versions` | of acsar_gym, python, numpy |
| `process` | id of the process that records, which listens for an emergency stop on hardware |
| `created` | `wall` clock [ns since 1970] and `monotonic` clock [ns] at the same moment; |
| | the table `clocks` repeats the wall clock every second |
| `about` | what the program states: `env` (id, kwargs), `task`, `observation` (names of its |
| | numbers), `policy` (file, sha256), `link`, `command` |
| `source` | in a recording that was made of a ROS 2 bag: a hash of the bag |

A message whose strings and lists have a fixed length has each of its numbers at a fixed place. So
many messages are one NumPy array with one row each, which costs about as much as one message.
"""

from __future__ import annotations

import copy
import json
import os
import platform
import time
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import cache, partial
from importlib import metadata
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.robot import hash_config
from acsar_gym.errors import require_extra
from acsar_gym.odometry import POSE_COVARIANCE, TWIST_COVARIANCE
from acsar_gym.protocol import WHEELS
from acsar_gym.recording.blocks import FORMAT
from acsar_gym.recording.events import Tables
from acsar_gym.worlds.geometry import RaySpec

Floats = NDArray[np.float64]

NANOSECONDS = 1_000_000_000  # in a second
BASE_FOOTPRINT = "base_footprint"  # frame on the ground below the base frame; odometry moves it
WORLD_FRAME = "world"  # frame of the ground truth
JOINT_NAMES = [f"{wheel}_wheel_joint" for wheel in WHEELS]  # as in acsar.urdf
SHOWN_RATE = 10.0  # how often a second reasons, lateness and movers are shown [Hz]
MARKER_HEIGHT = 1.7  # of the cylinder that shows a mover [m]
MARKER_COLOUR = {"r": 0.56, "g": 0.27, "b": 0.68, "a": 0.8}
CYLINDER = 3  # type of a marker
NODE_NAME = "acsar_gym"  # what reports errors
LOG_ERROR = 40  # level of a rcl_interfaces/msg/Log
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
    """Return the messages of ROS 2 Humble; MissingExtraError without rosbags."""
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


def get_field(message: Any, path: str) -> Any:
    """Return a field such as "pose.position.x" or "markers.0.id"."""
    for name in path.split(".") if path else ():
        message = message[int(name)] if isinstance(message, list) else getattr(message, name)
    return message


def set_field(message: Any, path: str, value: Any) -> None:
    """Set a field such as "pose.position.x" or "markers.0.id"."""
    parent, _, name = path.rpartition(".")
    setattr(get_field(message, parent), name, value)


def find_stamps(message: Any, path: str = "") -> Iterator[str]:
    """Yield the paths of all times in a message that are named `stamp`."""
    if isinstance(message, list):
        fields = {str(number): entry for number, entry in enumerate(message)}
    else:
        fields = getattr(message, "__dict__", {})
    for name, value in fields.items():
        if name == "stamp":
            yield f"{path}{name}"
        else:
            yield from find_stamps(value, f"{path}{name}.")


def _name_times(paths: Iterable[str], times: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """The numbers of times [ns]."""
    numbers: dict[str, NDArray[Any]] = {}
    for path in paths:
        numbers[f"{path}.sec"] = times // NANOSECONDS
        numbers[f"{path}.nanosec"] = times % NANOSECONDS
    return numbers


class Template:
    """Makes messages that differ in their numbers only.

    The place of each number is found by serializing the message once without it and once with it.

    Args:
        kind: Type of the message.
        fixed: Strings, lists and numbers that are the same in all messages, by path.
        numbers: Numbers that differ, by path: a row for each message.
    """

    def __init__(
        self, kind: str, fixed: Mapping[str, Any], numbers: Mapping[str, NDArray[Any]]
    ) -> None:
        store = load_typestore()
        blank = make_blank(kind)
        for path, value in fixed.items():
            set_field(blank, path, value)
        self._stamps = list(find_stamps(blank))
        numbers = {**numbers, **_name_times(self._stamps, np.zeros(1, np.int64))}
        plain = np.frombuffer(store.serialize_cdr(blank, kind), np.uint8)

        offsets: list[int] = []
        formats: list[Any] = []
        for path, values in numbers.items():
            # No byte of these is zero, as a float of any size and as an integer.
            is_integer = values.dtype.kind == "i"
            probe: Any = 0x01010101 if is_integer else 1.0 / 3.0
            message = copy.deepcopy(blank)
            shape = values.shape[1:]
            set_field(
                message, path, np.full_like(get_field(blank, path), probe) if shape else probe
            )
            changed = np.frombuffer(store.serialize_cdr(message, kind), np.uint8)
            places = np.flatnonzero(plain != changed)
            offsets.append(int(places[0]))
            size = len(places) // int(np.prod(shape))
            formats.append((f"<i{size}" if is_integer else f"<f{size}", shape))

        layout: Any = {"names": list(numbers), "formats": formats, "offsets": offsets}
        layout["itemsize"] = len(plain)
        self._plain = plain
        self._row = np.dtype(layout)

    def fill(self, times: NDArray[np.int64], numbers: Mapping[str, NDArray[Any]]) -> list[bytes]:
        """Make one message for each time [ns], with a row of the numbers."""
        octets = np.tile(self._plain, len(times))
        rows = octets.view(self._row)
        for path, values in {**numbers, **_name_times(self._stamps, times)}.items():
            rows[path] = values
        data = octets.tobytes()
        size = len(self._plain)
        return [data[place : place + size] for place in range(0, len(data), size)]


class Shown(NamedTuple):
    """What is shown of a table: one message for each stamp."""

    stamps: Floats
    """When, on the link's clock [s]."""
    numbers: Mapping[str, NDArray[Any]]
    """Numbers of the messages by path, with a row for each stamp."""
    fixed: Mapping[str, Any] = {}
    """What is the same in all messages, by path."""
    key: Hashable = None
    """What messages of the same form have in common, such as the number of rays."""


Start = Sequence[float]
"""Where an odometry begins in the frame of the world: x [m], y [m], theta [rad]."""
Show = Callable[[Tables, RobotConfig, Start], Shown]


def _name_pose(path: str, poses: NDArray[Any], place: str = "position") -> dict[str, Any]:
    """The numbers of poses (n, 3): x [m], y [m], theta [rad]."""
    half = poses[:, 2] / 2.0
    turned = "orientation" if place == "position" else "rotation"
    return {
        f"{path}.{place}.x": poses[:, 0],
        f"{path}.{place}.y": poses[:, 1],
        f"{path}.{turned}.z": np.sin(half),
        f"{path}.{turned}.w": np.cos(half),
    }


def _name_twist(path: str, twists: NDArray[Any]) -> dict[str, Any]:
    """The numbers of twists (n, 2): linear [m/s], angular [rad/s]."""
    return {f"{path}linear.x": twists[:, 0], f"{path}angular.z": twists[:, 1]}


def _show_odometry(name: str, tables: Tables, config: RobotConfig, start: Start) -> Shown:
    """Show the poses of the ticks by odometry, or the true poses of the exchanges."""
    table = tables[name][~np.isnan(tables[name]["pose"][:, 0])]
    pose, twist = make_covariances()

    return Shown(
        stamps=table["stamp"],
        numbers={
            **_name_pose("pose.pose", table["pose"]),
            **_name_twist("twist.twist.", table["twist"]),
        },
        fixed={
            "header.frame_id": config.odom_frame if name == "ticks" else WORLD_FRAME,
            "child_frame_id": BASE_FOOTPRINT,
            "pose.covariance": pose,
            "twist.covariance": twist,
        },
    )


def _make_transform(parent: str, child: str, place: Sequence[float] = (0.0, 0.0, 0.0)) -> Any:
    transform = make_blank("geometry_msgs/msg/TransformStamped", child_frame_id=child)
    transform.header.frame_id = parent
    for axis, value in zip("xyz", place, strict=True):
        set_field(transform, f"transform.translation.{axis}", float(value))
    return transform


def _show_frame(tables: Tables, config: RobotConfig, start: Start) -> Shown:
    return Shown(
        stamps=tables["ticks"]["stamp"],
        numbers=_name_pose("transforms.0.transform", tables["ticks"]["pose"], "translation"),
        fixed={"transforms": [_make_transform(config.odom_frame, BASE_FOOTPRINT)]},
    )


def _show_mounts(tables: Tables, config: RobotConfig, start: Start) -> Shown:
    """Base frame at the height of the axles, and LiDAR."""
    lidar = (config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset)
    transforms = [
        _make_transform(BASE_FOOTPRINT, config.base_frame, (0.0, 0.0, config.wheel_radius)),
        _make_transform(config.base_frame, config.lidar_frame, lidar),
    ]
    for transform in transforms:
        transform.transform.rotation.w = 1.0
    return Shown(tables["resets"]["stamp"], {}, {"transforms": transforms})


def _show_joints(tables: Tables, config: RobotConfig, start: Start) -> Shown:
    ticks = tables["ticks"]
    zeros = np.zeros(len(WHEELS))
    return Shown(
        stamps=ticks["stamp"],
        numbers={"position": ticks["angles"], "velocity": ticks["speeds"]},
        fixed={"name": JOINT_NAMES, "position": zeros, "velocity": zeros},
    )


def _show_twist(column: str, tables: Tables, config: RobotConfig, start: Start) -> Shown:
    ticks = tables["ticks"][~np.isnan(tables["ticks"][column][:, 0])]
    return Shown(ticks["stamp"], _name_twist("", ticks[column]))


def _show_scans(tables: Tables, config: RobotConfig, start: Start) -> Shown:
    """All rays are as from the robot's pose at the stamp: no time passes between them."""
    lidar = config.lidar
    ranges = tables["ranges"]
    rays = ranges.shape[1]
    spec = RaySpec(rays, lidar.max_range, lidar.field_of_view)
    first = -lidar.field_of_view / 2.0

    return Shown(
        stamps=tables["scans"]["stamp"],
        numbers={"ranges": np.where(ranges >= lidar.max_range, np.inf, ranges)},
        fixed={
            "header.frame_id": config.lidar_frame,
            "angle_min": first,
            "angle_max": first + (rays - 1) * spec.step,
            "angle_increment": spec.step,
            "scan_time": 1.0 / lidar.rate,
            "range_min": lidar.min_range,
            "range_max": lidar.max_range,
            "ranges": np.zeros(rays, np.float32),
        },
        key=rays,
    )


def _count_skipped(config: RobotConfig) -> int:
    """How many ticks there are to each message at SHOWN_RATE."""
    return max(1, round(config.control_rate / SHOWN_RATE))


def _show_worst(column: str, tables: Tables, config: RobotConfig, start: Start) -> Shown:
    """Show the largest value of a tick's column in each tenth of a second."""
    ticks = tables["ticks"]
    begins = np.arange(0, len(ticks), _count_skipped(config))
    worst = np.fmax.reduceat(ticks[column].astype(float), begins)
    is_known = ~np.isnan(worst)
    return Shown(ticks["stamp"][begins][is_known], {"data": worst[is_known]})


def _show_numbers(name: str, tables: Tables, config: RobotConfig, start: Start) -> Shown:
    """Show the numbers that a policy got or gave in each step, but for a reset's action."""
    table = tables[name]
    is_shown = ~np.isnan(table).all(axis=1)  # an empty observation isn't
    size = table.shape[1]
    stamps = tables["steps"]["stamp"][is_shown]
    return Shown(stamps, {"data": table[is_shown]}, {"data": np.zeros(size, np.float32)}, size)


def _show_movers(tables: Tables, config: RobotConfig, start: Start) -> Shown:
    """A cylinder for each mover."""
    x, y, theta = start
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    rows = tables["movers"]["exchange"] % _count_skipped(config) == 0
    states = tables["mover_states"][rows]
    places = (states[:, :, :2] - (x, y)) @ turn

    markers: list[Any] = []
    numbers: dict[str, NDArray[Any]] = {}
    for number in range(states.shape[1]):
        marker = make_blank("visualization_msgs/msg/Marker", ns="movers", id=number, type=CYLINDER)
        marker.header.frame_id = config.odom_frame
        marker.color = make_blank("std_msgs/msg/ColorRGBA", **MARKER_COLOUR)
        marker.pose.orientation.w = 1.0
        marker.pose.position.z = MARKER_HEIGHT / 2.0
        marker.scale.z = MARKER_HEIGHT
        markers.append(marker)
        for axis, name in enumerate("xy"):
            numbers[f"markers.{number}.pose.position.{name}"] = places[:, number, axis]
            numbers[f"markers.{number}.scale.{name}"] = 2.0 * states[:, number, 4]

    stamps = tables["movers"]["stamp"][rows]
    return Shown(stamps, numbers, {"markers": markers}, key=len(markers))


def _show_clocks(tables: Tables, config: RobotConfig, start: Start) -> Shown:
    clocks = tables["clocks"]
    numbers = _name_times(["time_ref"], clocks["wall"])
    return Shown(clocks["stamp"], numbers, {"source": "wall clock"})


def _show_faults(tables: Tables, config: RobotConfig, start: Start) -> Shown:
    """What stopped the robot; several errors in one block are one line."""
    text = tables["faults_bytes"].tobytes().decode()
    fixed = {"level": LOG_ERROR, "name": NODE_NAME, "msg": text}
    return Shown(tables["faults"]["stamp"][:1], {}, fixed, key=text)


class Topic(NamedTuple):
    """One topic of a recording."""

    name: str
    kind: str
    """Type, such as "nav_msgs/msg/Odometry"."""
    table: str
    """The table of which its messages are made."""
    show: Show
    is_latched: bool = False

    @property
    def metadata(self) -> dict[str, str]:
        """Metadata of its channel."""
        return {"offered_qos_profiles": LATCHED_QOS if self.is_latched else ""}


FLOAT = "std_msgs/msg/Float64"
FLOATS = "std_msgs/msg/Float32MultiArray"
TWIST = "geometry_msgs/msg/Twist"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
TOPICS = (
    Topic("/odom", ODOMETRY, "ticks", partial(_show_odometry, "ticks")),
    Topic("/tf", TRANSFORMS, "ticks", _show_frame),
    Topic("/tf_static", TRANSFORMS, "resets", _show_mounts, is_latched=True),
    Topic("/joint_states", "sensor_msgs/msg/JointState", "ticks", _show_joints),
    Topic("/cmd_vel", TWIST, "ticks", partial(_show_twist, "asked")),
    Topic("/cmd_vel_sent", TWIST, "ticks", partial(_show_twist, "sent")),
    Topic("/safety_reason", FLOAT, "ticks", partial(_show_worst, "reason")),
    Topic("/lateness", FLOAT, "ticks", partial(_show_worst, "lateness")),
    Topic("/feedback_age", FLOAT, "ticks", partial(_show_worst, "feedback_age")),
    Topic("/scan", "sensor_msgs/msg/LaserScan", "ranges", _show_scans),
    Topic("/truth", ODOMETRY, "exchanges", partial(_show_odometry, "exchanges")),
    Topic("/movers", "visualization_msgs/msg/MarkerArray", "mover_states", _show_movers),
    Topic("/observation", FLOATS, "observations", partial(_show_numbers, "observations")),
    Topic("/action", FLOATS, "actions", partial(_show_numbers, "actions")),
    Topic("/time_reference", "sensor_msgs/msg/TimeReference", "clocks", _show_clocks),
    Topic("/rosout", "rcl_interfaces/msg/Log", "faults", _show_faults),
)


class Publisher:
    """Makes the messages of a robot's tables."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._templates: dict[Hashable, Template] = {}

    def make_messages(
        self, tables: Tables, start: Sequence[float], offset: int
    ) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield topic, time [ns] and content of each message.

        Args:
            tables: Some tables of an episode; `resets` has the stamp of its reset.
            start: Where its odometry begins in the frame of the world.
            offset: What to add to times of the link's clock for those of the file [ns].
        """
        for topic in TOPICS:
            if topic.table not in tables:
                continue
            shown = topic.show(tables, self._config, start)
            if not len(shown.stamps):
                continue
            times = np.rint(shown.stamps * 1e9).astype(np.int64) + offset
            times = np.maximum(times, 0)
            key = (topic.name, shown.key)
            if key not in self._templates:
                self._templates[key] = Template(topic.kind, shown.fixed, shown.numbers)
            messages = self._templates[key].fill(times, shown.numbers)
            for stamp, data in zip(times.tolist(), messages, strict=True):
                yield topic, stamp, data
