"""What a recording is made of: its header, its topics, and how their ROS 2 messages are packed."""

from __future__ import annotations

import json
import os
import platform
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib import metadata
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.robot import hash_config
from acsar_gym.errors import MissingExtraError
from acsar_gym.protocol import WHEELS

LITTLE_ENDIAN = b"\x00\x01\x00\x00"
"""What a CDR message begins with; alignment counts from behind it."""
NUMBER_SIZES = {"i1": 1, "u1": 1, "i4": 4, "u4": 4, "f4": 4, "f8": 8}
NANOSECONDS = 1_000_000_000


class MessageLayout:
    """The fields of one kind of message, in the order of its definition.

    Each method adds the next field and returns the layout. `packed` then makes messages.
    """

    def __init__(self) -> None:
        self._names: list[str] = []
        self._formats: list[Any] = []
        self._offsets: list[int] = []
        self._fixed: dict[str, Any] = {}
        self._size = 0

    def number(self, kind: str, name: str, fixed: float | None = None) -> MessageLayout:
        """Add a number of `kind` (a key of SIZES), with the same value in all messages if given."""
        self._place(name, f"<{kind}", NUMBER_SIZES[kind], NUMBER_SIZES[kind])
        if fixed is not None:
            self._fixed[name] = fixed
        return self

    def numbers(self, kind: str, name: str, count: int) -> MessageLayout:
        """Add an array of `count` numbers; in a row it is of shape (count,)."""
        if count:
            self._place(
                name, (f"<{kind}", (count,)), NUMBER_SIZES[kind], NUMBER_SIZES[kind] * count
            )
        return self

    def sequence(self, kind: str, name: str, count: int) -> MessageLayout:
        """Add a list of `count` numbers, which begins with its length."""
        self.number("u4", f"{name}.length", count)
        return self.numbers(kind, name, count)

    def text(self, name: str, text: str) -> MessageLayout:
        """Add a string that is the same in all messages."""
        data = text.encode() + b"\0"
        self.number("u4", f"{name}.length", len(data))
        self._place(name, f"S{len(data)}", 1, len(data))
        self._fixed[name] = data
        return self

    def texts(self, name: str, texts: tuple[str, ...]) -> MessageLayout:
        """Add a list of strings that are the same in all messages."""
        self.number("u4", f"{name}.length", len(texts))
        for number, text in enumerate(texts):
            self.text(f"{name}.{number}", text)
        return self

    def header(self, frame: str) -> MessageLayout:
        """Add a std_msgs/Header with fields `sec` and `nanosec`."""
        return self.number("i4", "sec").number("u4", "nanosec").text("frame", frame)

    def _place(self, name: str, form: Any, alignment: int, size: int) -> None:
        """Put a field at the next multiple of its alignment."""
        self._size += -self._size % alignment
        self._names.append(name)
        self._formats.append(form)
        self._offsets.append(self._size + len(LITTLE_ENDIAN))
        self._size += size

    def done(self) -> Packer:
        """Finish the layout."""
        size = self._size + len(LITTLE_ENDIAN)
        kind = np.dtype(
            {
                "names": self._names,
                "formats": self._formats,
                "offsets": self._offsets,
                "itemsize": size,
            }
        )
        blank = np.frombuffer(bytearray(LITTLE_ENDIAN.ljust(size, b"\0")), kind)
        for name, value in self._fixed.items():
            blank[name] = value
        return Packer(blank)


class Packer:
    """Packs messages of one layout.

    Args:
        blank: (1,), a message with all fixed fields.
    """

    def __init__(self, blank: NDArray[np.void]) -> None:
        self._blank = blank
        self.size = blank.dtype.itemsize

    def packed(self, count: int, fields: Mapping[str, Any]) -> list[bytes]:
        """Make messages.

        Args:
            count: how many.
            fields: by name, (count,) or (count, length) each.
        """
        rows = np.repeat(self._blank, count)
        for name, values in fields.items():
            rows[name] = values
        data, size = rows.tobytes(), self.size
        return [data[first : first + size] for first in range(0, count * size, size)]


def stamp_fields(nanoseconds: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
    """The fields `sec` and `nanosec` of headers."""
    return {"sec": nanoseconds // NANOSECONDS, "nanosec": nanoseconds % NANOSECONDS}


MESSAGE_ENCODING = "cdr"
SCHEMA_ENCODING = "ros2msg"
BASE_FOOTPRINT = "base_footprint"
"""Frame on the ground below the base frame; odometry moves it."""
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
"""One row for each scan: the exchange at whose end it was the newest, the end of its revolution
[s], and its ranges [m], exactly as the policy got them."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic of a recording."""

    name: str
    kind: str
    """Type, such as "nav_msgs/msg/Odometry"."""
    columns: tuple[str, ...] = ()
    latched: bool = False

    @property
    def metadata(self) -> dict[str, str]:
        """What its channel tells besides."""
        told = {"offered_qos_profiles": LATCHED_QOS if self.latched else ""}
        return told | ({"columns": ",".join(self.columns)} if self.columns else {})


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

TOPICS = (
    *(ODOM, TF, TF_STATIC, JOINT_STATES, CMD_VEL, CMD_VEL_SENT, SCAN, DIAGNOSTICS, TRUTH),
    *(TIME_REFERENCE, WIRE_SENT, WIRE_RECEIVED, OBSERVATION, ACTION),
    *(EPISODE, EXCHANGES, TICKS, STEPS, SCANS),
)
"""All of them; those under /acsar are what this project reads back, bit for bit."""


RECORDING_FORMAT = 1
HEADER_RECORD = "acsar_gym"
"""Name of the metadata record that holds the header."""
END_RECORD = "acsar_gym_end"
"""Name of the metadata record at the end of a complete recording."""


def package_version() -> str:
    """Return the version of this package."""
    try:
        return metadata.version("acsar_gym")
    except metadata.PackageNotFoundError:  # used from its folder, not installed
        return "unknown"


def to_plain_json(told: Any) -> Any:
    """Return what JSON can hold of something: NaN and infinity become null, objects their text."""
    return json.loads(json.dumps(told, default=str), parse_constant=lambda name: None)


def make_header(config: RobotConfig, about: Mapping[str, Any]) -> dict[str, Any]:
    """Make the header of a recording that begins now.

    Args:
        config: of the robot.
        about: what the program says about it, ready for JSON.
    """
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


@cache
def load_typestore() -> Any:
    """Return the messages of ROS 2 Humble; MissingExtraError without rosbags."""
    try:
        from rosbags.typesys import Stores, get_typestore  # noqa: PLC0415 - optional
    except ImportError:
        raise MissingExtraError("recording", "record") from None
    return get_typestore(Stores.ROS2_HUMBLE)


def make_message(kind: str, **fields: Any) -> Any:
    """Make a message, such as "std_msgs/msg/Header"."""
    return load_typestore().types[kind](**fields)


def pack_message(message: Any) -> bytes:
    """Serialise a message in CDR."""
    return bytes(load_typestore().serialize_cdr(message, message.__msgtype__))


def type_definition(kind: str) -> bytes:
    """Return the definition of a type and of all types in it."""
    text: str = load_typestore().generate_msgdef(kind, ros_version=2)[0]
    return text.encode()


def make_time(nanoseconds: int) -> Any:
    """Return a builtin_interfaces/Time."""
    seconds, rest = divmod(nanoseconds, 1_000_000_000)
    return make_message("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)


def make_ros_header(nanoseconds: int, frame: str = "") -> Any:
    """Return a std_msgs/Header."""
    return make_message("std_msgs/msg/Header", stamp=make_time(nanoseconds), frame_id=frame)


WORLD_FRAME = "world"
"""Frame of the ground truth."""
JOINT_NAMES = tuple(f"{wheel}_wheel_joint" for wheel in WHEELS)
"""Names of the wheels' joints, as in assets/robots/acsar.urdf."""
_BYTES = struct.Struct("<4sIII")


@dataclass(frozen=True)
class MessageFormats:
    """Packers of the topics whose messages have a fixed size."""

    odometry: Packer
    truth: Packer
    transform: Packer
    joints: Packer
    twist: Packer
    exchanges: Packer
    ticks: Packer
    steps: Packer

    @classmethod
    def of(cls, config: RobotConfig) -> MessageFormats:
        """Return the formats for a robot's frames."""
        return cls(
            odometry=odometry_packer(config.odom_frame, BASE_FOOTPRINT),
            truth=odometry_packer(WORLD_FRAME, BASE_FOOTPRINT),
            transform=transform_packer(config.odom_frame, BASE_FOOTPRINT),
            joints=joint_packer(),
            twist=_twist(MessageLayout(), "").done(),
            exchanges=row_packer(len(EXCHANGE_COLUMNS)),
            ticks=row_packer(len(TICK_COLUMNS)),
            steps=row_packer(len(STEP_COLUMNS)),
        )


def odometry_packer(frame: str, child: str) -> Packer:
    """nav_msgs/Odometry, with fields px py pz qx qy qz qw, vx .. wz, pose_cov, twist_cov."""
    layout = MessageLayout().header(frame).text("child", child)
    _numbers(layout, "px py pz qx qy qz qw").numbers("f8", "pose_cov", 36)
    return _twist(layout, "").numbers("f8", "twist_cov", 36).done()


def transform_packer(frame: str, child: str) -> Packer:
    """tf2_msgs/TFMessage with one transform, with fields px py pz qx qy qz qw."""
    layout = MessageLayout().number("u4", "count", 1).header(frame).text("child", child)
    return _numbers(layout, "px py pz qx qy qz qw").done()


def joint_packer() -> Packer:
    """sensor_msgs/JointState of the wheels, with fields position and velocity."""
    layout = MessageLayout().header("").texts("name", JOINT_NAMES)
    layout.sequence("f8", "position", 4).sequence("f8", "velocity", 4)
    return layout.sequence("f8", "effort", 0).done()


def row_packer(columns: int) -> Packer:
    """std_msgs/Float64MultiArray, with the field data, (columns,)."""
    return _array("f8", columns)


@lru_cache(maxsize=16)
def singles_packer(columns: int) -> Packer:
    """std_msgs/Float32MultiArray, with the field data, (columns,)."""
    return _array("f4", columns)


@lru_cache(maxsize=16)
def doubles_packer(columns: int) -> Packer:
    """std_msgs/Float64MultiArray, with the field data, (columns,)."""
    return _array("f8", columns)


def _array(kind: str, columns: int) -> Packer:
    """A MultiArray without dimensions."""
    layout = MessageLayout().number("u4", "dimensions", 0).number("u4", "data_offset", 0)
    return layout.sequence(kind, "data", columns).done()


def scan_packer(config: RobotConfig, step: float, rays: int) -> Packer:
    """sensor_msgs/LaserScan, with the field ranges, (rays,)."""
    lidar, first = config.lidar, -config.lidar.field_of_view / 2.0
    layout = MessageLayout().header(config.lidar_frame)
    layout.number("f4", "angle_min", first).number("f4", "angle_max", first + (rays - 1) * step)
    layout.number("f4", "angle_increment", step).number("f4", "time_increment", 0.0)
    layout.number("f4", "scan_time", 1.0 / lidar.rate).number("f4", "range_min", lidar.min_range)
    layout.number("f4", "range_max", lidar.max_range).sequence("f4", "ranges", rays)
    return layout.sequence("f4", "intensities", 0).done()


def pack_octets(data: bytes) -> bytes:
    """Pack std_msgs/UInt8MultiArray."""
    return _BYTES.pack(LITTLE_ENDIAN, 0, 0, len(data)) + data


def pack_text(data: str) -> bytes:
    """Pack std_msgs/String."""
    encoded = data.encode() + b"\0"
    return LITTLE_ENDIAN + struct.pack("<I", len(encoded)) + encoded


def pose_fields(poses: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """The fields of poses (n, 3): x [m], y [m], theta [rad]."""
    half = poses[:, 2] / 2.0
    return {"px": poses[:, 0], "py": poses[:, 1], "qz": np.sin(half), "qw": np.cos(half)}


def twist_fields(twists: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """The fields of twists (n, 2): linear [m/s], angular [rad/s]."""
    return {"vx": twists[:, 0], "wz": twists[:, 1]}


def _twist(layout: MessageLayout, prefix: str) -> MessageLayout:
    """Add the fields vx vy vz wx wy wz."""
    return _numbers(layout, "vx vy vz wx wy wz")


def _numbers(layout: MessageLayout, names: str) -> MessageLayout:
    """Add numbers by name."""
    for name in names.split():
        layout.number("f8", name)
    return layout


def static_transforms(config: RobotConfig) -> Callable[[int], bytes]:
    """Return what makes /tf_static at a time [ns]: base_footprint, base frame, LiDAR.

    The base frame is at the height of the axles.
    """
    base, lidar = config.base_frame, config.lidar_frame
    at = config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset
    edges = (BASE_FOOTPRINT, base, (0.0, 0.0, config.wheel_radius)), (base, lidar, at)

    def make_them(time: int) -> bytes:
        transforms = [_transform(time, *edge) for edge in edges]
        return pack_message(make_message("tf2_msgs/msg/TFMessage", transforms=transforms))

    return make_them


def time_reference(time: int, wall: int) -> bytes:
    """Pack sensor_msgs/TimeReference: what the wall clock showed [ns] at a time of the file."""
    return pack_message(
        make_message(
            "sensor_msgs/msg/TimeReference",
            header=make_ros_header(time),
            time_ref=make_time(wall),
            source="wall clock",
        )
    )


def _transform(time: int, parent: str, child: str, at: tuple[float, float, float]) -> Any:
    """A geometry_msgs/TransformStamped without rotation."""
    x, y, z = at
    moved = make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
    turned = make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    return make_message(
        "geometry_msgs/msg/TransformStamped",
        header=make_ros_header(time, parent),
        child_frame_id=child,
        transform=make_message("geometry_msgs/msg/Transform", translation=moved, rotation=turned),
    )
