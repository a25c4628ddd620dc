"""How the messages of each topic are packed, for one robot."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.protocol import WHEELS
from acsar_gym.recording.layouts import LITTLE_ENDIAN, Layout, Packer
from acsar_gym.recording.topics import BASE_FOOTPRINT, EXCHANGE_COLUMNS, STEP_COLUMNS, TICK_COLUMNS

WORLD = "world"
"""Frame of the ground truth."""
JOINTS = tuple(f"{wheel}_wheel_joint" for wheel in WHEELS)
"""Names of the wheels' joints, as in assets/robots/acsar.urdf."""
_BYTES = struct.Struct("<4sIII")


@dataclass(frozen=True)
class Formats:
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
    def of(cls, config: RobotConfig) -> Formats:
        """Return the formats for a robot's frames."""
        return cls(
            odometry=odometry(config.odom_frame, BASE_FOOTPRINT),
            truth=odometry(WORLD, BASE_FOOTPRINT),
            transform=transform(config.odom_frame, BASE_FOOTPRINT),
            joints=joint_state(),
            twist=_twist(Layout(), "").done(),
            exchanges=table(len(EXCHANGE_COLUMNS)),
            ticks=table(len(TICK_COLUMNS)),
            steps=table(len(STEP_COLUMNS)),
        )


def odometry(frame: str, child: str) -> Packer:
    """nav_msgs/Odometry, with fields px py pz qx qy qz qw, vx .. wz, pose_cov, twist_cov."""
    layout = Layout().header(frame).text("child", child)
    _numbers(layout, "px py pz qx qy qz qw").numbers("f8", "pose_cov", 36)
    return _twist(layout, "").numbers("f8", "twist_cov", 36).done()


def transform(frame: str, child: str) -> Packer:
    """tf2_msgs/TFMessage with one transform, with fields px py pz qx qy qz qw."""
    layout = Layout().number("u4", "count", 1).header(frame).text("child", child)
    return _numbers(layout, "px py pz qx qy qz qw").done()


def joint_state() -> Packer:
    """sensor_msgs/JointState of the wheels, with fields position and velocity."""
    layout = Layout().header("").texts("name", JOINTS)
    layout.sequence("f8", "position", 4).sequence("f8", "velocity", 4)
    return layout.sequence("f8", "effort", 0).done()


def table(columns: int) -> Packer:
    """std_msgs/Float64MultiArray, with the field data, (columns,)."""
    return _array("f8", columns)


@lru_cache(maxsize=16)
def singles(columns: int) -> Packer:
    """std_msgs/Float32MultiArray, with the field data, (columns,)."""
    return _array("f4", columns)


@lru_cache(maxsize=16)
def doubles(columns: int) -> Packer:
    """std_msgs/Float64MultiArray, with the field data, (columns,)."""
    return _array("f8", columns)


def _array(kind: str, columns: int) -> Packer:
    """A MultiArray without dimensions."""
    layout = Layout().number("u4", "dimensions", 0).number("u4", "data_offset", 0)
    return layout.sequence(kind, "data", columns).done()


def laser_scan(config: RobotConfig, step: float, rays: int) -> Packer:
    """sensor_msgs/LaserScan, with the field ranges, (rays,)."""
    lidar, first = config.lidar, -config.lidar.field_of_view / 2.0
    layout = Layout().header(config.lidar_frame)
    layout.number("f4", "angle_min", first).number("f4", "angle_max", first + (rays - 1) * step)
    layout.number("f4", "angle_increment", step).number("f4", "time_increment", 0.0)
    layout.number("f4", "scan_time", 1.0 / lidar.rate).number("f4", "range_min", lidar.min_range)
    layout.number("f4", "range_max", lidar.max_range).sequence("f4", "ranges", rays)
    return layout.sequence("f4", "intensities", 0).done()


def octets(data: bytes) -> bytes:
    """Pack std_msgs/UInt8MultiArray."""
    return _BYTES.pack(LITTLE_ENDIAN, 0, 0, len(data)) + data


def text(data: str) -> bytes:
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


def _twist(layout: Layout, prefix: str) -> Layout:
    """Add the fields vx vy vz wx wy wz."""
    return _numbers(layout, "vx vy vz wx wy wz")


def _numbers(layout: Layout, names: str) -> Layout:
    """Add numbers by name."""
    for name in names.split():
        layout.number("f8", name)
    return layout
