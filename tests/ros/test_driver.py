"""`acsar-gym ros driver`: a robot as ROS sees robots, and what it doesn't drive."""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros_tools
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from ros_tools import Client, Heard, Program, StartProgram
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from acsar_gym import RobotConfig
from acsar_gym.odometry import POSE_COVARIANCE, TWIST_COVARIANCE
from acsar_gym.testing import EmulatedBoard, emulated_board

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
STANDING = 0.2
"""Wheels that are slower stand: an encoder tells 0.1 [rad/s] while they run out."""
TIMEOUT = 0.5
"""After which a twist doesn't count any more [s]."""
JOINTS = ["right_front", "left_front", "left_rear", "right_rear"]

WALL = {
    "start": {"x": 0.0, "y": 0.0},
    "goal": {"x": 1.0, "y": 0.0},
    "segments": [[3.0, -2.0, 3.0, 2.0]],
}
"""A world as of a file."""

StartDriver = Callable[..., Program]


@pytest.fixture
def config() -> RobotConfig:
    """The robot, with the patience that a busy machine needs."""
    return RobotConfig.preset("acsar").with_(
        connect_timeout=20.0, feedback_timeout=5.0, watchdog_timeout=2.0
    )


@pytest.fixture
def start_driver(
    start_program: StartProgram,
    client: Client,
    namespace: str,
    tmp_path: Path,
    config: RobotConfig,
) -> StartDriver:
    """`start_driver("--link", "planar", ...)`: found already, with a robot that stands."""
    file = tmp_path / "robot.yaml"
    file.write_text(yaml.safe_dump(config.model_dump(mode="json")), encoding="utf-8")

    def start(*options: object) -> Program:
        command = ("-m", "acsar_gym", "ros", "driver", "--robot", file, "--namespace", namespace)
        driver = start_program(*command, *options)
        states = client.hear(JointState, "joint_states")
        client.wait(lambda: len(states.messages) > 3, "the driver", 60.0)
        return driver

    return start


def stamped(client: Client, linear: float, angular: float = 0.0, **changes: Any) -> TwistStamped:
    message = TwistStamped()
    stamp = client.node.get_clock().now().nanoseconds + round(1e9 * changes.get("ahead", 0.0))
    message.header.stamp = Time(nanoseconds=stamp).to_msg()
    message.header.frame_id = changes.get("frame", "")
    message.twist.linear.x, message.twist.angular.z = linear, angular
    message.twist.linear.y = changes.get("aside", 0.0)
    return message


def twist(linear: float, angular: float = 0.0) -> Twist:
    message = Twist()
    message.linear.x, message.angular.z = linear, angular
    return message


def publish(
    client: Client, duration: float, *sources: tuple[Any, Callable[[], Any]], rate: float = 20.0
) -> None:
    """Publish what each source makes, for a time [s]."""
    end = time.monotonic() + duration
    while time.monotonic() < end:
        for publisher, make in sources:
            publisher.publish(make())
        client.spin(1.0 / rate)


def seconds(stamp: Any) -> float:
    return float(Time.from_msg(stamp).nanoseconds * 1e-9)


def fastest(messages: list[Any]) -> float:
    """The fastest wheel of joint states [rad/s]."""
    return float(max(abs(speed) for message in messages for speed in message.velocity))


def diagnosed(heard: Heard) -> dict[str, str]:
    """The newest diagnostics of the driver."""
    status = heard.messages[-1].status[0]
    return {value.key: value.value for value in status.values} | {"message": status.message}


def warned(driver: Program) -> list[str]:
    """Lines of warnings and errors."""
    return [line for line in driver.printed.splitlines() if "[INFO]" not in line]


def test_topics_are_those_of_ros(
    start_driver: StartDriver, client: Client, namespace: str, config: RobotConfig
) -> None:
    mounts = client.hear(TFMessage, "/tf_static", LATCHED)
    start_driver("--link", "planar", "--lidar", "simulated")
    odometry, joints = client.hear(Odometry, "odom"), client.hear(JointState, "joint_states")
    scans, transforms = client.hear(LaserScan, "scan"), client.hear(TFMessage, "/tf")
    diagnostics = client.hear(DiagnosticArray, "/diagnostics")
    publisher = client.publisher(TwistStamped, "cmd_vel")
    publish(client, 1.0, (publisher, lambda: stamped(client, 0.2, 0.5, stamp=None)))
    client.wait(lambda: bool(scans.messages and diagnostics.messages), "scans and diagnostics")
    types = dict(client.node.get_topic_names_and_types())
    for topic, kind in {
        "odom": "nav_msgs/msg/Odometry",
        "joint_states": "sensor_msgs/msg/JointState",
        "scan": "sensor_msgs/msg/LaserScan",
    }.items():
        assert types[f"{namespace}/{topic}"] == [kind]
        (info,) = client.node.get_publishers_info_by_topic(f"{namespace}/{topic}")
        assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert info.qos_profile.durability == DurabilityPolicy.VOLATILE
    for topic in ("/tf", "/tf_static", "/diagnostics", "/clock"):
        assert topic in types
    assert {*types[f"{namespace}/cmd_vel"]} == {
        "geometry_msgs/msg/Twist",
        "geometry_msgs/msg/TwistStamped",
    }
    newest = odometry.messages[-1]
    assert newest.header.frame_id == config.odom_frame == "odom"
    assert newest.child_frame_id == config.base_frame == "base_link"
    assert list(newest.pose.covariance) == list(POSE_COVARIANCE)
    assert list(newest.twist.covariance) == list(TWIST_COVARIANCE)
    assert list(joints.messages[-1].name) == list(config.ros_joints)
    (mount,) = mounts.messages[0].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", config.lidar_frame)
    assert mount.transform.translation.x == config.lidar_x_offset
    assert scans.messages[-1].header.frame_id == config.lidar_frame
    (moved,) = transforms.messages[-1].transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "base_link")
    assert diagnostics.messages[-1].status[0].name == "acsar_driver: link"
    assert diagnosed(diagnostics)["emergency stop"] == "false"


def test_twists_are_driven_until_the_time_out(start_driver: StartDriver, client: Client) -> None:
    driver = start_driver("--link", "planar")
    odometry = client.hear(Odometry, "odom")
    joints = client.hear(JointState, "joint_states")
    for kind, make in (
        (TwistStamped, lambda: stamped_now(0.2, 0.4)),
        (TwistStamped, lambda: stamped_now(0.2, 0.4, "base_link")),
        (Twist, lambda: twist(0.2, 0.4)),
    ):
        publisher = client.publisher(kind, "cmd_vel")
        publish(client, 1.0, (publisher, make))
        moving = odometry.messages[-1].twist.twist
        assert moving.linear.x == pytest.approx(0.2, abs=0.02)
        assert moving.angular.z == pytest.approx(0.4, abs=0.05)
        last = time.monotonic()
        client.spin(TIMEOUT + 0.8)
        after = [
            message
            for message, when in zip(joints.messages, joints.times, strict=True)
            if when > last + TIMEOUT + 0.5  # wheels take a while
        ]
        assert fastest(after) < STANDING
        client.node.destroy_publisher(publisher)
    assert not warned(driver)


def stamped_now(linear: float, angular: float, frame: str = "") -> TwistStamped:
    """A twist without a stamp, which means now."""
    message = TwistStamped(twist=twist(linear, angular))
    message.header.frame_id = frame
    return message


def test_bad_commands_are_refused_with_one_line_each(
    start_driver: StartDriver,
    client: Client,
    config: RobotConfig,
    namespace: str,
    programs: list[Program],
) -> None:
    with emulated_board(config) as board, ros_tools.client(namespace, programs) as another:
        driver = start_driver("--link", board.device, "--without-estop")
        joints = client.hear(JointState, "joint_states")
        diagnostics = client.hear(DiagnosticArray, "/diagnostics")
        publisher = client.publisher(TwistStamped, "cmd_vel")
        other = client.publisher(TwistStamped, "cmd_vel")
        third = another.publisher(Twist, "cmd_vel")
        good = (publisher, lambda: stamped(client, 0.2))
        for words, *sources in (
            ("isn't finite", (publisher, lambda: stamped(client, math.nan))),
            ("isn't finite", (publisher, lambda: stamped(client, 0.2, math.inf))),
            ("isn't finite", (publisher, lambda: stamped(client, 0.2, aside=math.nan))),
            ("isn't finite", (third, lambda: twist(-math.inf))),
            ("in another frame", (publisher, lambda: stamped(client, 0.2, frame="map"))),
            ("do the clocks agree", (publisher, lambda: stamped(client, 0.2, ahead=-3.0))),
            ("do the clocks agree", (publisher, lambda: stamped(client, 0.2, ahead=3.0))),
            ("two publishers", good, (other, lambda: stamped(client, -0.2))),
            ("two publishers", good, (third, lambda: twist(0.2))),
        ):
            publish(client, 0.3, *sources)
            begin = len(joints.messages)
            diagnostics.messages.clear()
            publish(client, 1.2, *sources)
            assert fastest(joints.messages[begin:]) < STANDING, words
            assert words in diagnosed(diagnostics)["commands"]
            client.spin(TIMEOUT + 0.1)
        publish(client, 0.8, good)
        assert fastest(joints.messages[-5:]) > 1.0
        assert not [c for c in board.commands() if min(s or 0.0 for s in c) < -0.01]
    lines = [line for line in warned(driver) if "cmd_vel: refused" in line]
    assert 4 <= len(lines) <= 8  # four kinds, each reported again after 10 s
    assert lines == [line for line in warned(driver) if "lost while in use" not in line]


def test_estop_and_release(start_driver: StartDriver, client: Client, config: RobotConfig) -> None:
    with emulated_board(config) as board:
        start_driver("--link", board.device, "--without-estop")
        joints = client.hear(JointState, "joint_states")
        diagnostics = client.hear(DiagnosticArray, "/diagnostics")
        drive = (client.publisher(TwistStamped, "cmd_vel"), lambda: stamped(client, 0.2))
        publish(client, 0.8, drive)
        assert fastest(joints.messages[-5:]) > 1.0
        answer = client.call(Trigger, "acsar_driver/estop")
        assert answer.success
        assert "release" in answer.message
        publish(client, 1.0, drive)
        begin = len(joints.messages)
        publish(client, 1.2, drive)
        assert fastest(joints.messages[begin:]) < STANDING
        assert diagnosed(diagnostics)["emergency stop"] == "true"
        assert diagnostics.messages[-1].status[0].level == b"\x02"
        assert client.call(Trigger, "acsar_driver/release").success
        publish(client, 1.2, drive)
        assert fastest(joints.messages[-5:]) > 1.0
        assert diagnosed(diagnostics)["emergency stop"] == "false"


def test_odometry_is_reset_while_it_drives(start_driver: StartDriver, client: Client) -> None:
    start_driver("--link", "planar")
    odometry = client.hear(Odometry, "odom")
    drive = (client.publisher(TwistStamped, "cmd_vel"), lambda: stamped_now(0.3, 0.0))
    publish(client, 1.5, drive)
    before = odometry.messages[-1].pose.pose.position.x
    assert before > 0.2
    assert client.call(Trigger, "acsar_driver/reset_odometry").success
    client.spin(0.1)
    assert abs(odometry.messages[-1].pose.pose.position.x) < 0.15


def test_scenes_and_the_clock_over_resets(start_driver: StartDriver, client: Client) -> None:
    driver = start_driver("--link", "planar", "--lidar", "simulated", "--realtime", 2.0)
    clocks = client.hear(Clock, "/clock")
    scans = client.hear(LaserScan, "scan")
    odometry = client.hear(Odometry, "odom")
    wall = {"start": [1.0, 0.0, 0.0], "world": WALL}
    answer = client.set_scene(json.dumps(wall))
    assert answer.success, answer.message
    scans.messages.clear()
    client.wait(lambda: len(scans.messages) > 3, "scans")
    scan = scans.messages[-1]
    ahead = round(-scan.angle_min / scan.angle_increment)
    assert scan.ranges[ahead] == pytest.approx(2.0 - 0.0, abs=0.2)
    for bad in ("nonsense", '{"start": [0]}', '{"world": "missing.yaml"}'):
        answer = client.set_scene(bad)
        assert not answer.success
        assert answer.message
        assert "\n" not in answer.message
    assert client.set_scene("").success
    client.spin(1.0)
    times = [seconds(message.clock) for message in clocks.messages]
    assert np.diff(times).min() > 0.0
    stamps = [seconds(message.header.stamp) for message in odometry.messages]
    assert np.diff(stamps).min() > 0.0
    assert not warned(driver)


def test_simulated_time_passes_as_fast_as_asked(start_driver: StartDriver, client: Client) -> None:
    start_driver("--link", "planar", "--realtime", 2.0)
    clocks = client.hear(Clock, "/clock")
    client.spin(2.0)
    span = seconds(clocks.messages[-1].clock) - seconds(clocks.messages[0].clock)
    assert span / (clocks.times[-1] - clocks.times[0]) == pytest.approx(2.0, rel=0.05)


def test_parameters_come_from_a_file(
    start_driver: StartDriver, client: Client, tmp_path: Path
) -> None:
    values = {
        "odom_frame": "odometry",
        "base_frame": "base_footprint",
        "lidar_frame": "laser",
        "lidar_x_offset": 0.25,
        "max_linear": 0.1,
        "wheel_radius": 0.06,
        "control_rate": 50,
        "cmd_vel_timeout": 0.2,
        "link": "planar",
        "publish_tf": False,
    }
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
    mounts = client.hear(TFMessage, "/tf_static", LATCHED)
    transforms = client.hear(TFMessage, "/tf")
    start_driver("--ros-args", "--params-file", file)
    odometry, joints = client.hear(Odometry, "odom"), client.hear(JointState, "joint_states")
    publisher = client.publisher(Twist, "cmd_vel")
    publish(client, 1.5, (publisher, lambda: twist(5.0)))
    newest = odometry.messages[-1]
    assert (newest.header.frame_id, newest.child_frame_id) == ("odometry", "base_footprint")
    assert newest.twist.twist.linear.x == pytest.approx(0.1, abs=0.01)
    assert joints.messages[-1].velocity[0] == pytest.approx(0.1 / 0.06, rel=0.1)
    stamps = [seconds(message.header.stamp) for message in joints.messages]
    assert np.median(np.diff(stamps)) == pytest.approx(0.02, abs=1e-6)
    client.spin(0.2 + 0.25)
    begin = len(joints.messages)
    client.spin(0.2)
    assert fastest(joints.messages[begin:]) < STANDING
    (mount,) = mounts.messages[0].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_footprint", "laser")
    assert mount.transform.translation.x == 0.25
    assert not transforms.messages


def test_a_subscriber_that_stalls_does_not_stall_the_robot(
    start_driver: StartDriver, start_program: StartProgram, client: Client, namespace: str
) -> None:
    start_driver("--link", "planar", "--lidar", "simulated")
    joints = client.hear(JointState, "joint_states")
    stalled = start_program(
        "-c",
        "import rclpy, sys\n"
        "from sensor_msgs.msg import JointState, LaserScan\n"
        "rclpy.init()\n"
        "node = rclpy.create_node('stalled', namespace=sys.argv[1])\n"
        "node.create_subscription(JointState, 'joint_states', print, 1)\n"
        "node.create_subscription(LaserScan, 'scan', lambda _: None, 1)\n"
        "rclpy.spin(node)\n",
        namespace,
    )
    client.wait(lambda: "JointState" in stalled.printed, "a subscriber")
    stalled.send(signal.SIGSTOP)
    begin = len(joints.times)
    client.spin(3.0)
    times = np.array(joints.times[begin:])
    assert len(times) > 0.9 * 3.0 * 100.0
    assert np.diff(times).max() < 0.2
    stalled.send(signal.SIGCONT)


def test_wheels_stop_where_the_node_hangs(
    client: Client, namespace: str, tmp_path: Path, config: RobotConfig
) -> None:
    """Nobody reads what the driver logs: a line blocks the thread of its node for good."""
    file = tmp_path / "robot.yaml"
    config.save(file)
    _, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    command = (sys.executable, "-m", "acsar_gym", "ros", "driver", "--robot", str(file))
    with emulated_board(config) as board, contextlib.ExitStack() as stack:
        process = subprocess.Popen(
            [*command, "--namespace", namespace, "--link", board.device, "--without-estop"],
            stderr=write,
            stdout=subprocess.DEVNULL,
        )
        stack.callback(process.wait)
        stack.callback(process.kill)
        joints = client.hear(JointState, "joint_states")
        client.wait(lambda: len(joints.messages) > 3, "the driver")
        drive = (client.publisher(TwistStamped, "cmd_vel"), lambda: stamped(client, 0.2))
        publish(client, 0.8, drive)
        assert fastest(joints.messages[-5:]) > 1.0
        os.set_blocking(write, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(write, b"." * 64)
        os.set_blocking(write, True)
        nan = (drive[0], lambda: stamped(client, math.nan))
        publish(client, 0.3, nan)
        hung = time.monotonic()
        publish(client, 1.5, drive)
        assert is_stopped_since(board, hung + TIMEOUT + 0.25)


def is_stopped_since(board: EmulatedBoard, when: float) -> bool:
    """Whether the board heard nothing but zeros since then."""
    late = "".join(event.get("rx", "") for event in board.events() if event["t"] > when)
    return all(character in "abcdpn0.,\r\n" for character in late)
