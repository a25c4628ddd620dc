"""The fixed frames of the robot, and the wall clock, as ROS 2 messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from acsar_gym.config import RobotConfig
from acsar_gym.recording.topics import BASE_FOOTPRINT
from acsar_gym.recording.typesystem import header, make, packed, time_of


def static_transforms(config: RobotConfig) -> Callable[[int], bytes]:
    """Return what makes /tf_static at a time [ns]: base_footprint, base frame, LiDAR.

    The base frame is at the height of the axles.
    """
    base, lidar = config.base_frame, config.lidar_frame
    at = config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset
    edges = (BASE_FOOTPRINT, base, (0.0, 0.0, config.wheel_radius)), (base, lidar, at)

    def make_them(time: int) -> bytes:
        transforms = [_transform(time, *edge) for edge in edges]
        return packed(make("tf2_msgs/msg/TFMessage", transforms=transforms))

    return make_them


def time_reference(time: int, wall: int) -> bytes:
    """Pack sensor_msgs/TimeReference: what the wall clock showed [ns] at a time of the file."""
    return packed(
        make(
            "sensor_msgs/msg/TimeReference",
            header=header(time),
            time_ref=time_of(wall),
            source="wall clock",
        )
    )


def _transform(time: int, parent: str, child: str, at: tuple[float, float, float]) -> Any:
    """A geometry_msgs/TransformStamped without rotation."""
    x, y, z = at
    moved = make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
    turned = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(time, parent),
        child_frame_id=child,
        transform=make("geometry_msgs/msg/Transform", translation=moved, rotation=turned),
    )
