"""Everything that the driver publishes describes the same drive."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from ros_tools import Client, StartProgram
from sensor_msgs.msg import JointState, LaserScan
from tf2_msgs.msg import TFMessage

from acsar_gym import RobotConfig
from acsar_gym.odometry import Odometry
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.files import save_world

TYPES = {"odom": OdometryMessage, "/tf": TFMessage, "joint_states": JointState, "scan": LaserScan}
WALL = 3.0
"""Place of a long wall ahead of the robot [m]."""
DRIVES = [(0.0, 0.0, 0.5), (0.3, 0.0, 1.5), (0.1, 0.8, 1.5), (0.2, -0.5, 1.0), (0.0, 0.0, 0.5)]
"""Twists [m/s, rad/s], and how long each is driven [s]."""
CONFIG = RobotConfig.preset("acsar")

Messages = dict[str, list[Any]]


@pytest.fixture
def messages(
    client: Client, namespace: str, start_program: StartProgram, tmp_path: Path
) -> Messages:
    """Messages of a drive towards a wall, by topic."""
    wall = World(
        segments=np.array([[WALL, -20.0, WALL, 20.0]]),
        start=Region(0.0, 0.0, 0.0, 0.0),
        goal=Region(1.0, 0.0),
    )
    save_world(wall, tmp_path / "wall.yaml")
    start_program(
        *("-m", "acsar_gym", "ros", "driver", "--link", "planar", "--lidar", "simulated"),
        *("--namespace", namespace, "--scene", tmp_path / "wall.yaml"),
    )
    heard = {
        topic: client.hear(kind, topic, QoSProfile(depth=1000)) for topic, kind in TYPES.items()
    }
    client.wait(lambda: bool(heard["scan"].messages), "scans", 60.0)

    publisher = client.publisher(TwistStamped, "cmd_vel")
    for linear, angular, duration in DRIVES:
        command = TwistStamped()
        command.twist.linear.x = linear
        command.twist.angular.z = angular
        end = time.monotonic() + duration
        while time.monotonic() < end:
            publisher.publish(command)
            client.spin(0.05)
    return {topic: messages.messages for topic, messages in heard.items()}


def stamp_of(message: Any) -> int:
    stamp = (message.transforms[0] if hasattr(message, "transforms") else message).header.stamp
    return int(stamp.sec * 10**9 + stamp.nanosec)


def read_poses(odometry: list[Any]) -> NDArray[np.float64]:
    """(messages, 3): x, y [m] and yaw [rad] without jumps."""
    rows = []
    for message in odometry:
        pose = message.pose.pose
        turn = pose.orientation
        rows.append((pose.position.x, pose.position.y, 2.0 * math.atan2(turn.z, turn.w)))
    poses = np.array(rows)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses


def test_driver_describes_the_same_drive_on_all_topics(messages: Messages) -> None:
    for topic, heard in messages.items():
        assert np.diff([stamp_of(message) for message in heard]).min() > 0, topic
    odometry = messages["odom"]
    times = np.array([stamp_of(message) for message in odometry])
    poses = read_poses(odometry)
    check_directions(odometry, times, poses)
    check_transforms(odometry, messages["/tf"])
    check_wheels(times, poses, messages["joint_states"])
    check_walls(times, poses, messages["scan"])


def check_directions(odometry: list[Any], times: Any, poses: Any) -> None:
    """REP 103: x forward, y left, counter-clockwise positive, in m, rad and s."""
    turns = np.array([message.twist.twist.angular.z for message in odometry])
    first_turn = int(np.argmax(np.abs(turns) > 0.05))
    assert poses[first_turn, 0] > 0.3
    assert abs(poses[first_turn, 1]) < 0.01
    steps = np.diff(times) * 1e-9
    assert poses[-1, 2] - poses[0, 2] == pytest.approx(float(turns[1:] @ steps), abs=1e-6)
    assert poses[:, 2].max() > 0.8
    assert poses[:, 1].max() > 0.05


def check_transforms(odometry: list[Any], transforms: list[Any]) -> None:
    """REP 105: the transform from odom to base_link is the odometry."""
    placed = {stamp_of(message): message.transforms[0].transform for message in transforms}
    pairs = [(m.pose.pose, placed[stamp_of(m)]) for m in odometry if stamp_of(m) in placed]
    assert len(pairs) > 0.95 * len(odometry)
    for pose, place in pairs:
        assert (place.translation.x, place.translation.y) == (pose.position.x, pose.position.y)
        assert place.rotation == pose.orientation


def check_wheels(times: Any, poses: Any, joints: list[Any]) -> None:
    """Odometry is that of the wheels' speeds, and their angles are the sums of these."""
    odometry = Odometry.of(CONFIG)
    odometry.pose = (*poses[0],)
    wheels = {stamp_of(message): message for message in joints}
    for previous, now, pose in zip(times, times[1:], poses[1:], strict=False):
        odometry.update(wheels[now].velocity, (now - previous) * 1e-9)
        assert odometry.pose[:2] == pytest.approx(pose[:2], abs=1e-6)
    turned = np.array(wheels[times[-1]].position) - wheels[times[0]].position
    assert odometry.wheel_positions == pytest.approx(turned, abs=1e-6)


def check_walls(times: Any, poses: Any, scans: list[Any]) -> None:
    """The wall is at its place, as seen from the LiDAR's place."""
    hits: list[float] = []
    for scan in scans:
        rays = np.arange(len(scan.ranges))
        ranges = np.array(scan.ranges)
        when = stamp_of(scan) + rays * scan.time_increment * 1e9
        is_hit = np.isfinite(ranges) & (when >= times[0]) & (when <= times[-1])
        x, _, yaw = (np.interp(when, times, values) for values in poses.T)
        angles = yaw + scan.angle_min + rays * scan.angle_increment
        mount = CONFIG.lidar_x_offset * np.cos(yaw) - CONFIG.lidar_y_offset * np.sin(yaw)
        hits += (x + mount + ranges * np.cos(angles))[is_hit].tolist()
    assert len(hits) > 500
    assert np.median(hits) == pytest.approx(WALL, abs=0.02)
    assert np.percentile(np.abs(np.array(hits) - WALL), 95) < 0.15
