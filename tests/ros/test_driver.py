"""`acsar-gym ros driver`: topics, commands, services and scenes of a robot's node."""

from __future__ import annotations

import contextlib
import fcntl
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
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from ros_tools import BEST_EFFORT, Client, Heard, Program, StartProgram
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from acsar_gym import RobotConfig
from acsar_gym.testing import EmulatedBoard, emulated_board
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.files import save_world

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
AT_REST = 0.2
"""Slower wheels are at rest, as an encoder's resolution is 0.1 [rad/s]."""
TIMEOUT = 0.5
"""Time after which a twist has no effect any more [s]."""

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
    """`start_driver("--link", "planar", ...)`: returns when it publishes joint states."""
    file = tmp_path / "robot.yaml"
    config.save(file)

    def start(*options: object) -> Program:
        command = ("-m", "acsar_gym", "ros", "driver", "--robot", file, "--namespace", namespace)
        driver = start_program(*command, *options)
        states = client.hear(JointState, "joint_states")
        client.wait(lambda: len(states.messages) > 3, "the driver", 60.0)
        return driver

    return start


def twist(linear: float, angular: float = 0.0) -> Twist:
    message = Twist()
    message.linear.x = linear
    message.angular.z = angular
    return message


def stamped(linear: float, angular: float = 0.0, frame: str = "", stamp: float = 0.0) -> Any:
    """A TwistStamped. Without a stamp, it means now."""
    message = TwistStamped(twist=twist(linear, angular))
    message.header.frame_id = frame
    message.header.stamp = Time(nanoseconds=round(1e9 * stamp)).to_msg()
    return message


def publish_until(
    client: Client,
    publisher: Any,
    make: Callable[[], Any],
    condition: Callable[[], bool],
    what: str,
) -> None:
    """Publish at 20 Hz until a condition holds."""
    due = 0.0

    def is_done() -> bool:
        nonlocal due
        if time.monotonic() > due:
            due = time.monotonic() + 0.05
            publisher.publish(make())
        return condition()

    client.wait(is_done, what)


def seconds(stamp: Any) -> float:
    return float(Time.from_msg(stamp).nanoseconds * 1e-9)


def speed(states: Heard) -> float:
    """Speed of the fastest wheel in the newest joint states [rad/s]. NaN if there are none."""
    return max(map(abs, states.messages[-1].velocity)) if states.messages else math.nan


def place(odometry: Heard) -> float:
    """Newest x of the odometry [m]. NaN if there is none."""
    return odometry.messages[-1].pose.pose.position.x if odometry.messages else math.nan


def rates(odometry: Heard) -> tuple[float, float]:
    """Newest twist of the odometry [m/s, rad/s]. NaN if there is none."""
    if not odometry.messages:
        return math.nan, math.nan
    newest = odometry.messages[-1].twist.twist
    return newest.linear.x, newest.angular.z


def read_diagnostics(heard: Heard) -> dict[str, str]:
    """The newest diagnostics of the driver."""
    status = heard.messages[-1].status[0]
    return {value.key: value.value for value in status.values} | {"message": status.message}


def list_warnings(driver: Program) -> list[str]:
    return [line for line in driver.printed.splitlines() if "[INFO]" not in line]


def test_driver_publishes_the_types_and_frames_of_ros(
    start_driver: StartDriver, client: Client, namespace: str, config: RobotConfig
) -> None:
    mounts = client.hear(TFMessage, "/tf_static", LATCHED)
    start_driver("--link", "planar", "--lidar", "simulated")
    odometry = client.hear(Odometry, "odom")
    scans = client.hear(LaserScan, "scan")
    transforms = client.hear(TFMessage, "/tf")
    diagnostics = client.hear(DiagnosticArray, "/diagnostics")
    client.wait(lambda: bool(scans.messages and diagnostics.messages), "scans and diagnostics")

    types = dict(client.node.get_topic_names_and_types())
    for topic, kind in {
        "odom": "nav_msgs/msg/Odometry",
        "joint_states": "sensor_msgs/msg/JointState",
        "scan": "sensor_msgs/msg/LaserScan",
        "cmd_vel": "geometry_msgs/msg/TwistStamped",
    }.items():
        assert types[f"{namespace}/{topic}"] == [kind]
    (info,) = client.node.get_publishers_info_by_topic(f"{namespace}/odom")
    assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    assert client.node.get_node_names().count("acsar_driver") == 1

    newest = odometry.messages[-1]
    assert newest.header.frame_id == config.odom_frame == "odom"
    assert newest.child_frame_id == config.base_frame == "base_link"
    unmeasured = 1e3
    pose = newest.pose.covariance.reshape(6, 6)
    assert pose.diagonal().tolist() == [0.01, 0.01, unmeasured, unmeasured, unmeasured, 0.01]
    twist = newest.twist.covariance.reshape(6, 6).diagonal()
    assert twist.tolist() == [0.01, unmeasured, unmeasured, unmeasured, unmeasured, 0.01]
    (mount,) = mounts.messages[0].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", config.lidar_frame)
    assert mount.transform.translation.x == config.lidar_x_offset
    assert scans.messages[-1].header.frame_id == config.lidar_frame
    (moved,) = transforms.messages[-1].transforms
    assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "base_link")
    assert read_diagnostics(diagnostics)["emergency stop"] == "false"


def test_driver_drives_twists_of_any_frame_until_the_time_out(
    start_driver: StartDriver, client: Client
) -> None:
    driver = start_driver("--link", "planar")
    odometry = client.hear(Odometry, "odom")
    joints = client.hear(JointState, "joint_states")
    publisher = client.publisher(TwistStamped, "cmd_vel")
    for frame in ("base_link", "odom", "teleop_twist_joy"):

        def is_driven() -> bool:
            linear, angular = rates(odometry)
            return abs(linear - 0.2) < 0.02 and abs(angular - 0.4) < 0.05

        make = lambda frame=frame: stamped(0.2, 0.4, frame)  # noqa: E731
        publish_until(client, publisher, make, is_driven, f"a robot that drives twists in {frame}")
        client.wait(lambda: speed(joints) < AT_REST, "wheels at rest")
    (line,) = list_warnings(driver)
    assert "twists in 'odom' are driven as if in 'base_link'" in line


def test_driver_reports_publishers_that_disturb(
    start_driver: StartDriver, client: Client, namespace: str, programs: list[Program]
) -> None:
    driver = start_driver("--link", "planar")
    joints = client.hear(JointState, "joint_states")
    with ros_tools.client(namespace, programs) as second:
        silent = PublisherEventCallbacks(use_default_callbacks=False)
        client.node.create_publisher(TwistStamped, "cmd_vel", BEST_EFFORT, event_callbacks=silent)
        client.wait(lambda: "incompatible QoS (reliability)" in driver.printed, "a warning")
        publisher = second.publisher(TwistStamped, "cmd_vel")
        client.wait(lambda: "cmd_vel: 2 publishers" in driver.printed, "a warning")
        publish_until(
            client, publisher, lambda: stamped(0.2), lambda: speed(joints) > 1.0, "turning wheels"
        )
    assert len(list_warnings(driver)) == 2


def test_driver_takes_twists_without_stamps_and_other_names(
    start_driver: StartDriver, client: Client, namespace: str
) -> None:
    options = ("-p", "stamped:=false", "-r", "__node:=base", "-r", "base:cmd_vel:=drive")
    start_driver("--link", "planar", "--ros-args", *options)
    joints = client.hear(JointState, "joint_states")
    assert ("base", namespace) in client.node.get_node_names_and_namespaces()
    types = dict(client.node.get_topic_names_and_types())
    assert types[f"{namespace}/drive"] == ["geometry_msgs/msg/Twist"]
    assert f"{namespace}/cmd_vel" not in types
    publisher = client.publisher(Twist, "drive")
    publish_until(
        client, publisher, lambda: twist(0.2), lambda: speed(joints) > 1.0, "turning wheels"
    )


def test_driver_stops_by_its_services_and_a_refused_command(
    start_driver: StartDriver, client: Client, config: RobotConfig
) -> None:
    with emulated_board(config) as board:
        start_driver("--link", board.device)
        joints = client.hear(JointState, "joint_states")
        odometry = client.hear(Odometry, "odom")
        diagnostics = client.hear(DiagnosticArray, "/diagnostics")
        publisher = client.publisher(TwistStamped, "cmd_vel")

        def drive_until(condition: Callable[[], bool], what: str) -> None:
            publish_until(client, publisher, lambda: stamped(0.2), condition, what)

        drive_until(lambda: place(odometry) > 0.3, "a robot ahead")
        assert client.call(Trigger, "acsar_driver/reset_odometry").success
        drive_until(lambda: place(odometry) < 0.2, "a new origin")

        answer = client.call(Trigger, "acsar_driver/estop")
        assert answer.success
        assert "release" in answer.message
        diagnostics.messages.clear()
        drive_until(lambda: bool(diagnostics.messages) and speed(joints) < AT_REST, "a stop")
        assert read_diagnostics(diagnostics)["emergency stop"] == "true"
        assert diagnostics.messages[-1].status[0].level == b"\x02"
        assert client.call(Trigger, "acsar_driver/release").success
        drive_until(lambda: speed(joints) > 1.0, "turning wheels")

        def is_refused() -> bool:
            return "isn't finite" in read_diagnostics(diagnostics)["commands"]

        publish_until(client, publisher, lambda: stamped(math.nan), is_refused, "a refusal")
        client.wait(lambda: speed(joints) < AT_REST, "wheels at rest")


def test_reset_changes_the_scene_and_stamps_grow(
    start_driver: StartDriver, client: Client, tmp_path: Path
) -> None:
    driver = start_driver(*("--link", "planar", "--lidar", "simulated"), "--realtime", 2.0)
    clocks = client.hear(Clock, "/clock")
    scans = client.hear(LaserScan, "scan")
    odometry = client.hear(Odometry, "odom")
    wall = World(
        segments=np.array([[3.0, -2.0, 3.0, 2.0]]),
        start=Region(0.0, 0.0, 0.0, 0.0),
        goal=Region(1.0, 0.0),
    )
    save_world(wall, tmp_path / "wall.yaml")
    answer = client.set_scene(str(tmp_path / "wall.yaml"), (1.0, 0.0, 0.0))
    assert answer.success, answer.message
    scans.messages.clear()
    client.wait(lambda: len(scans.messages) > 3, "scans")
    scan = scans.messages[-1]
    ahead = round(-scan.angle_min / scan.angle_increment)
    assert scan.ranges[ahead] == pytest.approx(2.0, abs=0.2)

    for name in ("nosuch:1", "missing.yaml"):
        answer = client.set_scene(name)
        assert not answer.success
        assert answer.message
        assert "\n" not in answer.message
    assert client.set_scene("clutter:7").success
    count = len(clocks.messages)
    client.wait(lambda: len(clocks.messages) > count + 100, "a second")
    times = [seconds(message.clock) for message in clocks.messages]
    assert np.diff(times).min() > 0.0
    rate = (times[-1] - times[count]) / (clocks.times[-1] - clocks.times[count])
    assert 1.0 < rate < 2.1  # a busy machine is slower than --realtime
    stamps = [seconds(message.header.stamp) for message in odometry.messages]
    assert np.diff(stamps).min() > 0.0
    assert not list_warnings(driver)


def test_parameters_of_a_file_count(
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
        "link": "planar",
        "publish_tf": False,
        "pose_covariance_diagonal": [0.001, 0.001, 1e6, 1e6, 1e6, 0.03],
    }
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
    mounts = client.hear(TFMessage, "/tf_static", LATCHED)
    transforms = client.hear(TFMessage, "/tf")
    start_driver("--ros-args", "--params-file", file)
    odometry = client.hear(Odometry, "odom")
    joints = client.hear(JointState, "joint_states")
    publisher = client.publisher(TwistStamped, "cmd_vel")

    def is_driven() -> bool:
        return rates(odometry)[0] > 0.09

    publish_until(client, publisher, lambda: stamped(5.0), is_driven, "a robot that drives")
    newest = odometry.messages[-1]
    assert (newest.header.frame_id, newest.child_frame_id) == ("odometry", "base_footprint")
    assert newest.twist.twist.linear.x < 0.11
    diagonal = newest.pose.covariance.reshape(6, 6).diagonal()
    assert diagonal.tolist() == values["pose_covariance_diagonal"]
    assert speed(joints) == pytest.approx(0.1 / 0.06, rel=0.15)
    stamps = [seconds(message.header.stamp) for message in joints.messages]
    assert np.median(np.diff(stamps)) == pytest.approx(0.02, abs=1e-6)
    (mount,) = mounts.messages[0].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_footprint", "laser")
    assert mount.transform.translation.x == 0.25
    assert not transforms.messages


STALLED = """
import rclpy, sys
from sensor_msgs.msg import JointState, LaserScan

rclpy.init()
node = rclpy.create_node("stalled", namespace=sys.argv[1])
node.create_subscription(JointState, "joint_states", print, 1)
node.create_subscription(LaserScan, "scan", lambda _: None, 1)
rclpy.spin(node)
"""


def test_driver_goes_on_if_a_subscriber_stalls(
    start_driver: StartDriver, start_program: StartProgram, client: Client, namespace: str
) -> None:
    start_driver("--link", "planar", "--lidar", "simulated")
    joints = client.hear(JointState, "joint_states")
    stalled = start_program("-c", STALLED, namespace)
    client.wait(lambda: "JointState" in stalled.printed, "a subscriber")
    stalled.send(signal.SIGSTOP)
    count = len(joints.messages)
    client.wait(lambda: len(joints.messages) > count + 300, "three seconds of joint states")
    stalled.send(signal.SIGCONT)


def test_watchdog_stops_the_wheels_if_the_node_hangs(
    client: Client, namespace: str, tmp_path: Path, config: RobotConfig
) -> None:
    """No process reads the driver's log, so that a line blocks the thread of its node forever."""
    file = tmp_path / "robot.yaml"
    config.save(file)
    _, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    command = (sys.executable, "-m", "acsar_gym", "ros", "driver", "--robot", str(file))
    with emulated_board(config) as board, contextlib.ExitStack() as stack:
        process = subprocess.Popen(
            [*command, "--namespace", namespace, "--link", board.device],
            stderr=write,
            stdout=subprocess.DEVNULL,
        )
        stack.callback(process.wait)
        stack.callback(process.kill)
        joints = client.hear(JointState, "joint_states")
        client.wait(lambda: len(joints.messages) > 3, "the driver")
        publisher = client.publisher(TwistStamped, "cmd_vel")

        def is_driven() -> bool:
            return speed(joints) > 1.0

        publish_until(client, publisher, lambda: stamped(0.2), is_driven, "turning wheels")
        os.set_blocking(write, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(write, b"." * 64)
        os.set_blocking(write, True)
        publisher.publish(stamped(math.nan))
        client.spin(0.3)
        publish_until(
            client,
            publisher,
            lambda: stamped(0.2),
            lambda: is_stopped_since(board, time.monotonic() - 0.5),
            "zeros for half a second, though the node is commanded",
        )


def is_stopped_since(board: EmulatedBoard, when: float) -> bool:
    """Whether the board has received only zeros since then."""
    late = "".join(event.get("rx", "") for event in board.events() if event["t"] > when)
    return bool(late) and all(character in "abcdpn0.,\r\n" for character in late)
