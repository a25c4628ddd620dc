"""What the driver publishes, recorded as a bag by another tool, says the same thing everywhere."""

from __future__ import annotations

import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry as OdometryMessage
from numpy.typing import NDArray
from rclpy.qos import DurabilityPolicy, QoSProfile
from ros_tools import Client, StartProgram
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState, LaserScan
from tf2_msgs.msg import TFMessage

from acsar_gym import RobotConfig
from acsar_gym.odometry import Odometry

TYPES = {
    "odom": OdometryMessage,
    "/tf": TFMessage,
    "/tf_static": TFMessage,
    "joint_states": JointState,
    "scan": LaserScan,
}
WALL = 3.0
"""Where a long wall is ahead of the robot [m]."""
SCENE = {
    "start": [0.0, 0.0, 0.0],
    "world": {
        "start": {"x": 0.0, "y": 0.0},
        "goal": {"x": 1.0, "y": 0.0},
        "segments": [[WALL, -20.0, WALL, 20.0]],
    },
}
DRIVES = [(0.0, 0.0, 0.5), (0.3, 0.0, 1.5), (0.1, 0.8, 1.5), (0.2, -0.5, 1.0), (0.0, 0.0, 0.5)]
"""Twists [m/s, rad/s], and for how long each is driven [s]."""

Messages = dict[str, list[Any]]


@pytest.fixture
def messages(
    client: Client, namespace: str, start_program: StartProgram, tmp_path: Path
) -> Messages:
    """Messages of a drive before a wall by topic, as rosbags has written and read them."""
    start_program(
        *("-m", "acsar_gym", "ros", "driver", "--link", "planar", "--lidar", "simulated"),
        *("--namespace", namespace),
    )
    raw: list[tuple[str, int, bytes]] = []

    def keep(topic: str) -> Any:
        return lambda data: raw.append((topic, time.time_ns(), data))

    for topic, kind in TYPES.items():
        qos = QoSProfile(depth=1000)
        if topic == "/tf_static":
            qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
        client.node.create_subscription(kind, topic, keep(topic), qos, raw=True)
    client.wait(lambda: any(topic == "scan" for topic, *_ in raw), "scans", 60.0)
    publisher = client.publisher(TwistStamped, "cmd_vel")
    assert client.set_scene(json.dumps(SCENE)).success
    client.spin(0.5)
    raw[:] = [one for one in raw if one[0] == "/tf_static"]
    for linear, angular, duration in DRIVES:
        command = TwistStamped()
        command.twist.linear.x, command.twist.angular.z = linear, angular
        end = time.monotonic() + duration
        while time.monotonic() < end:
            publisher.publish(command)
            client.spin(0.05)
    return read_bag(write_bag(tmp_path / "bag", raw))


def write_bag(path: Path, raw: list[tuple[str, int, bytes]]) -> Path:
    """Write messages as they came to a folder of rosbag2 with an MCAP file."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topics = {
            topic: bag.add_connection(
                topic, f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}", typestore=store
            )
            for topic, kind in TYPES.items()
        }
        for topic, when, data in raw:
            bag.write(topics[topic], when, data)
    return path


def read_bag(path: Path) -> Messages:
    found: Messages = {}
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    return found


def stamp_of(message: Any) -> int:
    stamp = (message.transforms[0] if hasattr(message, "transforms") else message).header.stamp
    return int(stamp.sec * 10**9 + stamp.nanosec)


def yaw_of(q: Any) -> float:
    assert (q.x, q.y) == (0.0, 0.0)
    assert math.hypot(q.z, q.w) == pytest.approx(1.0, abs=1e-9)
    return 2.0 * math.atan2(q.z, q.w)


def times_of(odometry: list[Any]) -> NDArray[np.int64]:
    """Stamps [ns]."""
    return np.array([stamp_of(message) for message in odometry])


def poses_of(odometry: list[Any]) -> NDArray[np.float64]:
    """(messages, 3): x, y [m] and yaw [rad], without jumps."""
    poses = [
        (m.pose.pose.position.x, m.pose.pose.position.y, yaw_of(m.pose.pose.orientation))
        for m in odometry
    ]
    found = np.array(poses)
    found[:, 2] = np.unwrap(found[:, 2])
    return found


def test_a_recorded_drive_is_consistent(messages: Messages) -> None:
    assert {*messages} == {*TYPES}
    for topic, recorded in messages.items():
        stamps = [stamp_of(message) for message in recorded]
        assert topic == "/tf_static" or np.diff(stamps).min() > 0, topic
    odometry = messages["odom"]
    times, poses = times_of(odometry), poses_of(odometry)
    assert np.diff(times).max() < 15_000_000  # none is lost
    check_transforms(odometry, messages["/tf"])
    check_directions(odometry)
    check_wheels(odometry, messages["joint_states"])
    check_walls(poses, times, messages["scan"], messages["/tf_static"])


def check_transforms(odometry: list[Any], recorded: list[Any]) -> None:
    """REP 105: from odom to base_link. The transform is the odometry."""
    transforms = {stamp_of(m): m.transforms for m in recorded}
    both = [(m, transforms[stamp_of(m)]) for m in odometry if stamp_of(m) in transforms]
    assert len(both) > 0.95 * len(odometry)
    for message, (transform,) in both:
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        assert (transform.header.frame_id, transform.child_frame_id) == ("odom", "base_link")
        place, pose = transform.transform, message.pose.pose
        assert (place.translation.x, place.translation.y, place.translation.z) == (
            pose.position.x, pose.position.y, 0.0)  # fmt: skip
        assert (place.rotation.z, place.rotation.w) == (pose.orientation.z, pose.orientation.w)


def check_directions(odometry: list[Any]) -> None:
    """REP 103: x forward, y left, counter-clockwise positive, in m, rad and s."""
    times, poses = times_of(odometry), poses_of(odometry)
    assert poses[0] == pytest.approx([0.0, 0.0, 0.0], abs=1e-9)
    turns = np.array([message.twist.twist.angular.z for message in odometry])
    first_turn = int(np.argmax(np.abs(turns) > 0.05))
    assert 0.3 < poses[first_turn, 0] < 0.6
    assert abs(poses[first_turn, 1]) < 0.01
    steps = np.diff(times) * 1e-9
    assert poses[-1, 2] == pytest.approx(float(turns[1:] @ steps), abs=1e-6)
    assert poses[:, 2].max() > 0.8
    assert poses[:, 1].max() > 0.05
    ahead = np.array([message.twist.twist.linear.x for message in odometry])[1:]
    along = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    assert ahead * steps == pytest.approx(along, abs=1e-6)


def check_wheels(odometry: list[Any], joints: list[Any]) -> None:
    """The wheels say the same as the odometry that is made of them."""
    times, poses = times_of(odometry), poses_of(odometry)
    own = Odometry.of(RobotConfig.preset("acsar"))
    wheels = {stamp_of(message): message for message in joints}
    for before, now, pose in zip(times, times[1:], poses[1:], strict=False):
        a, b, c, d = wheels[now].velocity
        own.update((a, b, c, d), (now - before) * 1e-9)
        assert own.pose[:2] == pytest.approx(pose[:2], abs=1e-6)
    turned = np.array(joints[-1].position) - joints[0].position
    steps = np.diff(times) * 1e-9
    spun = np.array([wheels[now].velocity for now in times[1:]]).T @ steps
    assert turned == pytest.approx(spun, abs=1e-6)


def check_walls(
    poses: NDArray[np.float64], times: NDArray[np.int64], scans: list[Any], mounts: list[Any]
) -> None:
    """Walls are where they are, seen from where the LiDAR sits."""
    config = RobotConfig.preset("acsar")
    (mount,) = mounts[0].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "lidar_link")
    offset, turn = mount.transform.translation, yaw_of(mount.transform.rotation)
    assert (offset.x, offset.z) == (config.lidar_x_offset, config.lidar_z_offset)
    hits = []
    for scan in scans:
        assert scan.header.frame_id == "lidar_link"
        rays = np.arange(len(scan.ranges))
        when = stamp_of(scan) + rays * scan.time_increment * 1e9
        seen = np.isfinite(scan.ranges) & (when >= times[0]) & (when <= times[-1])
        x, _, yaw = (np.interp(when, times, values) for values in poses.T)
        angles = yaw + turn + scan.angle_min + rays * scan.angle_increment
        x = x + offset.x * np.cos(yaw) - offset.y * np.sin(yaw) + scan.ranges * np.cos(angles)
        hits += x[seen].tolist()
    assert len(hits) > 500
    assert np.median(hits) == pytest.approx(WALL, abs=0.02)
    assert np.percentile(np.abs(np.array(hits) - WALL), 95) < 0.15
