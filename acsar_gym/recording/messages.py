"""What a recording is made of: its header, its topics, and how their ROS 2 messages are packed.

The header is what is needed to read, repeat and align a recording:

| key | content |
|---|---|
| `format` | number of this format |
| `config`, `config_sha256` | the robot, and the hash of its whole config |
| `versions` | of acsar_gym, python, numpy |
| `process` | id of the process that records, which listens for an emergency stop on hardware |
| `created` | `wall` clock [ns since 1970] and `monotonic` clock [ns] at the same moment; |
| | /time_reference repeats the wall clock every second |
| `about` | what the program says about it: `env` (id, kwargs), `task`, `observation` (names of |
| | its numbers), `policy` (file, sha256), |
| | `link`, `command`. /acsar/episode tells seed, goal and start of each episode |

A message whose strings and lists have a fixed length has each of its numbers at a fixed place. So
many messages are one numpy array with one row each, which costs about as much as one message.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import struct
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.robot import hash_config
from acsar_gym.errors import require_extra
from acsar_gym.protocol import WHEELS

MCAP_MAGIC = b"\x89MCAP0\r\n"
RECORDING_FORMAT = 1
HEADER_RECORD = "acsar_gym"  # name of the metadata record that holds the header
END_RECORD = "acsar_gym_end"  # name of the metadata record at the end of a complete recording


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
        "format": RECORDING_FORMAT,
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


def seal_text(name: str, data: Mapping[str, Any]) -> dict[str, str]:
    """Metadata with JSON by name, and its hash."""
    text = json.dumps(data)
    return {name: text, "sha256": hashlib.sha256(text.encode()).hexdigest()}


Axes = tuple[float, float, float]  # x, y, z
MESSAGE_ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"
BASE_FOOTPRINT = "base_footprint"  # frame on the ground below the base frame; odometry moves it
WORLD_FRAME = "world"  # frame of the ground truth
JOINT_NAMES = tuple(f"{wheel}_wheel_joint" for wheel in WHEELS)  # as in acsar.urdf
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

EXCHANGE_COLUMNS = (
    *("number", "stamp", "writes", "pieces", "lateness", "true_x", "true_y", "true_theta"),
    *("true_linear", "true_angular", "true_contact"),
)
"""One row for each control period of the wire: its number in the episode, its end on the link's
clock [s], how many writes (/wire/sent) and pieces (/wire/received) belong to it, how long after its
deadline it ended [s], and the ground truth in the frame of the world; NaN where unknown."""
TICK_COLUMNS = (
    *("exchange", "stamp", "x", "y", "theta", "linear", "angular"),
    *("speed_a", "speed_b", "speed_c", "speed_d", "angle_a", "angle_b", "angle_c", "angle_d"),
    *("asked_linear", "asked_angular", "sent_linear", "sent_angular", "reason"),
    *("lateness", "feedback_age", "refused"),
)
"""One row for each tick of the robot: odometry, wheels, commands, and the safety layer's reason."""
STEP_COLUMNS = ("step", "stamp", "reward", "terminated", "truncated", "success")
"""One row for each step of the env; step 0 is the reset, without action and reward."""
SCAN_COLUMNS = ("exchange", "stamp", "ranges")
"""One row for each scan: the exchange after which it was read, the time of that [s], and its ranges
[m] from where the robot was then, exactly as the policy got them."""
REVOLUTION_COLUMNS = ("exchange", "stamp", "bearings", "distances", "times")
"""One row for each revolution that scans are made of: the exchange after which it was read, its end
[s], and of its n measurements all bearings [rad], then all distances [m], 0 where nothing was
measured, then all times [s]."""
MOVER_COLUMNS = ("exchange", "stamp", "hit", "intrusions", "movers")
"""One row for each control period of the wire where something moves around a simulated robot: the
exchange, its end [s], and what `Crowd` tells of it, of each mover x, y, their rates, and radius."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording."""

    name: str
    kind: str
    """Type, such as "nav_msgs/msg/Odometry"."""
    columns: tuple[str, ...] = ()
    latched: bool = False
    optional: bool = False
    """Whether only a file that has a message of it knows it."""

    @property
    def metadata(self) -> dict[str, str]:
        """What its channel tells besides."""
        metadata = {"offered_qos_profiles": LATCHED_QOS if self.latched else ""}
        return metadata | ({"columns": ",".join(self.columns)} if self.columns else {})


DOUBLES_TYPE = "std_msgs/msg/Float64MultiArray"
SINGLES_TYPE = "std_msgs/msg/Float32MultiArray"
OCTETS_TYPE = "std_msgs/msg/UInt8MultiArray"

ODOM = Topic("/odom", "nav_msgs/msg/Odometry")
TF = Topic("/tf", "tf2_msgs/msg/TFMessage")
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", latched=True)
JOINT_STATES = Topic("/joint_states", "sensor_msgs/msg/JointState")
CMD_VEL = Topic("/cmd_vel", "geometry_msgs/msg/Twist")
CMD_VEL_SENT = Topic("/cmd_vel_sent", "geometry_msgs/msg/Twist")
SCAN = Topic("/scan", "sensor_msgs/msg/LaserScan")
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
TRUTH = Topic("/truth", "nav_msgs/msg/Odometry")
TIME_REFERENCE = Topic("/time_reference", "sensor_msgs/msg/TimeReference")
WIRE_SENT = Topic("/wire/sent", OCTETS_TYPE)
WIRE_RECEIVED = Topic("/wire/received", OCTETS_TYPE)
OBSERVATION = Topic("/observation", SINGLES_TYPE)
ACTION = Topic("/action", SINGLES_TYPE)
EPISODE = Topic("/acsar/episode", "std_msgs/msg/String", latched=True)
EXCHANGES = Topic("/acsar/exchanges", DOUBLES_TYPE, EXCHANGE_COLUMNS)
TICKS = Topic("/acsar/ticks", DOUBLES_TYPE, TICK_COLUMNS)
STEPS = Topic("/acsar/steps", DOUBLES_TYPE, STEP_COLUMNS)
SCANS = Topic("/acsar/scans", DOUBLES_TYPE, SCAN_COLUMNS)
REVOLUTIONS = Topic("/acsar/revolutions", DOUBLES_TYPE, REVOLUTION_COLUMNS)
MARKERS = Topic("/movers", "visualization_msgs/msg/MarkerArray", optional=True)
MOVERS = Topic("/acsar/movers", DOUBLES_TYPE, MOVER_COLUMNS, optional=True)

TOPICS = (
    *(ODOM, TF, TF_STATIC, JOINT_STATES, CMD_VEL, CMD_VEL_SENT, SCAN, DIAGNOSTICS, TRUTH),
    *(TIME_REFERENCE, WIRE_SENT, WIRE_RECEIVED, OBSERVATION, ACTION),
    *(EPISODE, EXCHANGES, TICKS, STEPS, SCANS, REVOLUTIONS, MARKERS, MOVERS),
)
"""All of them; those under /acsar are what this project reads back, bit for bit."""


@cache
def load_typestore() -> Any:
    """Return the messages of ROS 2 Humble; MissingExtraError without rosbags."""
    with require_extra("recording", "record"):
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - optional
    return get_typestore(Stores.ROS2_HUMBLE)


def make_message(kind: str, **fields: Any) -> Any:
    """Make a message, such as "std_msgs/msg/Header"."""
    return load_typestore().types[kind](**fields)


def pack_message(kind: str, **fields: Any) -> bytes:
    """Make a message, and serialise it in CDR."""
    return bytes(load_typestore().serialize_cdr(make_message(kind, **fields), kind))


def type_definition(kind: str) -> bytes:
    """Return the definition of a type and of all types in it."""
    text: str = load_typestore().generate_msgdef(kind, ros_version=2)[0]
    return text.encode()


def make_time(nanoseconds: int) -> Any:
    """Return a builtin_interfaces/Time."""
    seconds, nanosec = divmod(nanoseconds, 1_000_000_000)
    return make_message("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanosec)


def make_ros_header(nanoseconds: int, frame: str = "") -> Any:
    """Return a std_msgs/Header."""
    return make_message("std_msgs/msg/Header", stamp=make_time(nanoseconds), frame_id=frame)


MARKER_HEIGHT = 1.7  # of the cylinder that shows a mover [m]
MARKER_COLOUR = {"r": 0.56, "g": 0.27, "b": 0.68, "a": 0.8}
CYLINDER, LINE_LIST = 3, 5  # types of markers


def pack_markers(nanoseconds: int, frame: str, movers: NDArray[np.float64]) -> bytes:
    """Pack visualization_msgs/MarkerArray: a cylinder for each mover, and lines of velocities.

    Args:
        nanoseconds: time of the file.
        frame: of the places.
        movers: (movers, 5): x, y [m], their rates [m/s], radius [m].
    """
    header, top = make_ros_header(nanoseconds, frame), MARKER_HEIGHT
    markers, ends = [], []
    for number, (x, y, vx, vy, radius) in enumerate(movers.tolist()):
        size = 2.0 * radius, 2.0 * radius, top
        markers.append(_make_marker(header, number, CYLINDER, (x, y, top / 2.0), size, []))
        ends += [_make_axes("Point", x, y, top), _make_axes("Point", x + vx, y + vy, top)]
    lines = LINE_LIST, (0.0, 0.0, 0.0), (0.05, 0.0, 0.0), ends
    markers.append(_make_marker(header, len(movers), *lines))
    return pack_message(MARKERS.kind, markers=markers)


def _make_marker(
    header: Any, number: int, kind: int, place: Axes, size: Axes, points: list[Any]
) -> Any:
    turned = make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    octets = np.zeros(0, np.uint8)
    return make_message(
        "visualization_msgs/msg/Marker",
        header=header,
        ns="movers",
        id=number,
        type=kind,
        action=0,
        pose=make_message(
            "geometry_msgs/msg/Pose", position=_make_axes("Point", *place), orientation=turned
        ),
        scale=_make_axes("Vector3", *size),
        color=make_message("std_msgs/msg/ColorRGBA", **MARKER_COLOUR),
        lifetime=make_message("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=points,
        colors=[],
        texture_resource="",
        texture=make_message(
            "sensor_msgs/msg/CompressedImage", header=header, format="", data=octets
        ),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=make_message("visualization_msgs/msg/MeshFile", filename="", data=octets),
        mesh_use_embedded_materials=False,
    )


def _make_axes(kind: str, x: float, y: float, z: float) -> Any:
    return make_message(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


LITTLE_ENDIAN = b"\x00\x01\x00\x00"  # begins a CDR message; alignment counts from behind it
ARRAY_HEADER = struct.Struct("<4sIII")
Field = tuple[str, str, Any]  # name, numpy's type, value that is the same in all messages or None


class Packer:
    """Packs messages of one kind, whose fields have fixed sizes."""

    def __init__(self, *fields: Field) -> None:
        kinds = [np.dtype(kind) for _, kind, _ in fields]
        end, offsets = len(LITTLE_ENDIAN), []
        for kind in kinds:
            if kind.kind != "S":
                end += -(end - len(LITTLE_ENDIAN)) % kind.base.itemsize
            offsets.append(end)
            end += kind.itemsize
        names = [name for name, _, _ in fields]
        row = np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": end})
        self._blank = np.frombuffer(bytearray(LITTLE_ENDIAN.ljust(end, b"\0")), row)
        for name, _, value in fields:
            if value is not None:
                self._blank[name] = value

    def pack(self, count: int, fields: Mapping[str, Any]) -> list[bytes]:
        """Make so many messages of fields by name, (count,) or (count, length) each."""
        rows = np.repeat(self._blank, count)
        for name, values in fields.items():
            rows[name] = values
        data, size = rows.tobytes(), rows.itemsize
        return [data[first : first + size] for first in range(0, count * size, size)]


def _numbers(names: str) -> list[Field]:
    return [(name, "<f8", None) for name in names.split()]


def _text(name: str, text: str) -> list[Field]:
    data = text.encode() + b"\0"
    return [(f"{name}.length", "<u4", len(data)), (name, f"S{len(data)}", data)]


def _sequence(name: str, kind: str, count: int) -> list[Field]:
    """A list of numbers, which begins with its length."""
    numbers: list[Field] = [(name, f"({count},){kind}", None)] if count else []
    return [(f"{name}.length", "<u4", count), *numbers]


def _header(frame: str) -> list[Field]:
    return [("sec", "<i4", None), ("nanosec", "<u4", None), *_text("frame", frame)]


POSE = _numbers("px py pz qx qy qz qw")
TWIST = _numbers("vx vy vz wx wy wz")


def odometry_packer(frame: str, child: str) -> Packer:
    """nav_msgs/Odometry, with fields px py pz qx qy qz qw, vx .. wz, pose_cov, twist_cov."""
    head = *_header(frame), *_text("child", child)
    matrices = ("pose_cov", "(36,)<f8", None), ("twist_cov", "(36,)<f8", None)
    return Packer(*head, *POSE, matrices[0], *TWIST, matrices[1])


def transform_packer(frame: str, child: str) -> Packer:
    """tf2_msgs/TFMessage with one transform, with fields px py pz qx qy qz qw."""
    return Packer(("count", "<u4", 1), *_header(frame), *_text("child", child), *POSE)


def joint_packer() -> Packer:
    """sensor_msgs/JointState of the wheels, with fields position and velocity."""
    names = [field for number, name in enumerate(JOINT_NAMES) for field in _text(f"{number}", name)]
    lists = ("position", 4), ("velocity", 4), ("effort", 0)
    numbers = [field for name, count in lists for field in _sequence(name, "<f8", count)]
    return Packer(*_header(""), ("names", "<u4", len(JOINT_NAMES)), *names, *numbers)


@lru_cache(maxsize=32)
def array_packer(kind: str, columns: int) -> Packer:
    """std_msgs/Float64MultiArray ("<f8") or Float32MultiArray ("<f4"), with the field data."""
    head = ("dimensions", "<u4", 0), ("data_offset", "<u4", 0)
    return Packer(*head, *_sequence("data", kind, columns))


def scan_packer(config: RobotConfig, step: float, rays: int) -> Packer:
    """sensor_msgs/LaserScan, with the fields ranges, (rays,), and scan_time [s].

    All rays are as from one pose, that of the robot at the stamp: no time passes between them.
    """
    lidar, first = config.lidar, -config.lidar.field_of_view / 2.0
    values = {
        "angle_min": first,
        "angle_max": first + (rays - 1) * step,
        "angle_increment": step,
        "time_increment": 0.0,
        "scan_time": None,
        "range_min": lidar.min_range,
        "range_max": lidar.max_range,
    }
    numbers = [(name, "<f4", value) for name, value in values.items()]
    lists = *_sequence("ranges", "<f4", rays), *_sequence("intensities", "<f4", 0)
    return Packer(*_header(config.lidar_frame), *numbers, *lists)


def pack_octets(data: bytes) -> bytes:
    """Pack std_msgs/UInt8MultiArray."""
    return ARRAY_HEADER.pack(LITTLE_ENDIAN, 0, 0, len(data)) + data


def pack_text(data: str) -> bytes:
    """Pack std_msgs/String."""
    encoded = data.encode() + b"\0"
    return LITTLE_ENDIAN + struct.pack("<I", len(encoded)) + encoded


def stamp_fields(nanoseconds: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """The fields `sec` and `nanosec` of headers."""
    return {"sec": nanoseconds // 1_000_000_000, "nanosec": nanoseconds % 1_000_000_000}


def pose_fields(poses: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """The fields of poses (n, 3): x [m], y [m], theta [rad]."""
    half = poses[:, 2] / 2.0
    return {"px": poses[:, 0], "py": poses[:, 1], "qz": np.sin(half), "qw": np.cos(half)}


def twist_fields(twists: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """The fields of twists (n, 2): linear [m/s], angular [rad/s]."""
    return {"vx": twists[:, 0], "wz": twists[:, 1]}
