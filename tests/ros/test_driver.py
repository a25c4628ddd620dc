"""`acsar-gym ros driver`: topics, commands, services, scenes and parameters of a robot's node."""

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
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.time import Time
from ros_tools import BEST_EFFORT, Client, Program, StartProgram
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from acsar_gym import RobotConfig
from acsar_gym.odometry import Odometry as WheelOdometry
from acsar_gym.testing import EmulatedBoard, emulated_board
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.files import save_world

pytestmark = pytest.mark.usefixtures("deadline")

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RELIABLE = QoSProfile(depth=1000)
DRIVER = ("-m", "acsar_gym", "ros", "driver")
SIMULATED = ("--link", "planar", "--lidar", "simulated")
CONFIG = RobotConfig.preset("acsar").with_(
    connect_timeout=20.0, feedback_timeout=5.0, watchdog_timeout=2.0
)
"""The robot, with the patience that a busy machine needs."""
WALL = 3.0
"""Place of a long wall ahead of the robot [m]."""


def stamped(linear: float, angular: float = 0.0, frame: str = "") -> Any:
    """A TwistStamped without a stamp, which means now."""
    message = TwistStamped()
    message.header.frame_id = frame
    message.twist.linear.x = linear
    message.twist.angular.z = angular
    return message


class Driver:
    """A driver's process, and what a node hears of it."""

    def __init__(self, client: Client, program: Program) -> None:
        self.client = client
        self.program = program
        self.publisher: Any = None
        self.joints = client.hear(JointState, "joint_states", RELIABLE)
        self.odometry = client.hear(Odometry, "odom", RELIABLE)
        self.diagnostics = client.hear(DiagnosticArray, "/diagnostics")
        client.wait(lambda: len(self.odometry.messages) > 3, "the driver", 60.0)

    def drive_until(self, condition: Callable[[], bool], what: str, command: Any = None) -> None:
        """Publish a command at 20 Hz until a condition holds."""
        if self.publisher is None:
            self.publisher = self.client.publisher(TwistStamped, "cmd_vel")
        command = command or stamped(0.2)
        due = 0.0

        def is_done() -> bool:
            nonlocal due
            if time.monotonic() > due:
                due = time.monotonic() + 0.05
                self.publisher.publish(command)
            return condition()

        self.client.wait(is_done, what)

    def turns(self) -> bool:
        """Whether the fastest wheel turns now."""
        return bool(max(map(abs, self.joints.messages[-1].velocity)) > 1.0)

    def stands(self) -> bool:
        """Whether no wheel is faster than an encoder's resolution of 0.1 rad/s."""
        return bool(max(map(abs, self.joints.messages[-1].velocity)) < 0.2)

    def place(self) -> float:
        """Newest x of the odometry [m]."""
        return float(self.odometry.messages[-1].pose.pose.position.x)

    def rates(self) -> tuple[float, float]:
        """Newest twist of the odometry [m/s, rad/s]."""
        newest = self.odometry.messages[-1].twist.twist
        return newest.linear.x, newest.angular.z

    def read_diagnostics(self) -> dict[str, str]:
        status = self.diagnostics.messages[-1].status[0]
        return {value.key: value.value for value in status.values}

    @property
    def warnings(self) -> list[str]:
        return [line for line in self.program.printed.splitlines() if "[INFO]" not in line]


StartDriver = Callable[..., Driver]


@pytest.fixture
def robot_file(tmp_path: Path) -> Path:
    CONFIG.save(tmp_path / "robot.yaml")
    return tmp_path / "robot.yaml"


@pytest.fixture
def wall_file(tmp_path: Path) -> Path:
    """A world with a wall."""
    start = Region(0.0, 0.0, 0.0, 0.0)
    segments = np.array([[WALL, -20.0, WALL, 20.0]])
    save_world(World(segments=segments, start=start, goal=Region(1.0, 0.0)), tmp_path / "wall.yaml")
    return tmp_path / "wall.yaml"


@pytest.fixture
def start_driver(
    start_program: StartProgram, client: Client, namespace: str, robot_file: Path
) -> StartDriver:
    """`start_driver("--link", "planar", ...)`: returns when it publishes odometry."""

    def start(*options: object) -> Driver:
        files = ("--robot", robot_file, "--namespace", namespace)
        return Driver(client, start_program(*DRIVER, *files, *options))

    return start


def test_driver_describes_the_same_drive_on_all_topics(
    start_driver: StartDriver, client: Client, namespace: str, wall_file: Path
) -> None:
    mounts = client.hear(TFMessage, "/tf_static", LATCHED)
    transforms = client.hear(TFMessage, "/tf", RELIABLE)
    scans = client.hear(LaserScan, "scan", RELIABLE)
    driver = start_driver(*SIMULATED, "--scene", wall_file)
    client.wait(lambda: bool(scans.messages), "scans", 60.0)
    types = dict(client.node.get_topic_names_and_types())
    assert types[f"{namespace}/scan"] == ["sensor_msgs/msg/LaserScan"]
    assert types[f"{namespace}/cmd_vel"] == ["geometry_msgs/msg/TwistStamped"]
    (info,) = client.node.get_publishers_info_by_topic(f"{namespace}/odom")
    assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE

    twists = [(0.0, 0.0, 0.5), (0.3, 0.0, 1.5), (0.1, 0.8, 1.5), (0.2, -0.5, 1.0), (0.0, 0.0, 0.5)]
    for linear, angular, duration in twists:
        end = time.monotonic() + duration
        command = stamped(linear, angular)
        driver.drive_until(lambda end=end: time.monotonic() > end, "a drive", command)  # type: ignore[misc]
    client.wait(lambda: bool(driver.diagnostics.messages), "diagnostics")
    assert driver.read_diagnostics()["emergency stop"] == "false"

    odometry = driver.odometry.messages
    check_frames(odometry[-1], mounts.messages[0], scans.messages[-1])
    times = stamps_of(odometry)
    poses = read_poses(odometry)
    check_directions(odometry, times, poses)
    check_transforms(odometry, transforms.messages)
    check_wheels(times, poses, driver.joints.messages)
    check_walls(times, poses, scans.messages)


def header_of(message: Any) -> Any:
    return (message.transforms[0] if hasattr(message, "transforms") else message).header


def stamps_of(messages: list[Any]) -> Any:
    """Stamps [ns], which grow."""
    stamps = np.array([Time.from_msg(header_of(message).stamp).nanoseconds for message in messages])
    assert np.diff(stamps).min() > 0
    return stamps


def read_poses(odometry: list[Any]) -> Any:
    """(messages, 3): x, y [m] and yaw [rad] without jumps."""
    rows = []
    for message in odometry:
        pose = message.pose.pose
        turn = pose.orientation
        rows.append((pose.position.x, pose.position.y, 2.0 * math.atan2(turn.z, turn.w)))
    poses = np.array(rows)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses


def check_frames(odometry: Any, mounts: Any, scan: Any) -> None:
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    unmeasured = 1e3
    pose = odometry.pose.covariance.reshape(6, 6)
    assert pose.diagonal().tolist() == [0.01, 0.01, unmeasured, unmeasured, unmeasured, 0.01]
    twist = odometry.twist.covariance.reshape(6, 6).diagonal()
    assert twist.tolist() == [0.01, unmeasured, unmeasured, unmeasured, unmeasured, 0.01]
    (mount,) = mounts.transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", CONFIG.lidar_frame)
    assert mount.transform.translation.x == CONFIG.lidar_x_offset
    assert scan.header.frame_id == CONFIG.lidar_frame


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
    moved = transforms[-1].transforms[0]
    assert (moved.header.frame_id, moved.child_frame_id) == ("odom", "base_link")
    placed = dict(zip(stamps_of(transforms).tolist(), transforms, strict=True))
    stamps = stamps_of(odometry).tolist()
    pairs = [(m.pose.pose, placed[t]) for t, m in zip(stamps, odometry, strict=True) if t in placed]
    assert len(pairs) > 0.95 * len(odometry)
    for pose, message in pairs:
        place = message.transforms[0].transform
        assert (place.translation.x, place.translation.y) == (pose.position.x, pose.position.y)
        assert place.rotation == pose.orientation


def check_wheels(times: Any, poses: Any, joints: list[Any]) -> None:
    """Odometry is that of the wheels' speeds, and their angles are the sums of these."""
    odometry = WheelOdometry.of(CONFIG)
    odometry.pose = (*poses[0],)
    wheels = dict(zip(stamps_of(joints).tolist(), joints, strict=True))
    for previous, now, pose in zip(times, times[1:], poses[1:], strict=False):
        odometry.update(wheels[now].velocity, (now - previous) * 1e-9)
        assert odometry.pose[:2] == pytest.approx(pose[:2], abs=1e-6)
    turned = np.array(wheels[times[-1]].position) - wheels[times[0]].position
    assert odometry.wheel_positions == pytest.approx(turned, abs=1e-6)


def check_walls(times: Any, poses: Any, scans: list[Any]) -> None:
    """The wall is at its place, as seen from the LiDAR's place."""
    hits: list[float] = []
    for stamp, scan in zip(stamps_of(scans), scans, strict=True):
        rays = np.arange(len(scan.ranges))
        ranges = np.array(scan.ranges)
        when = stamp + rays * scan.time_increment * 1e9
        is_hit = np.isfinite(ranges) & (when >= times[0]) & (when <= times[-1])
        x, _, yaw = (np.interp(when, times, values) for values in poses.T)
        angles = yaw + scan.angle_min + rays * scan.angle_increment
        mount = CONFIG.lidar_x_offset * np.cos(yaw) - CONFIG.lidar_y_offset * np.sin(yaw)
        hits += (x + mount + ranges * np.cos(angles))[is_hit].tolist()
    assert len(hits) > 500
    assert np.median(hits) == pytest.approx(WALL, abs=0.02)
    assert np.percentile(np.abs(np.array(hits) - WALL), 95) < 0.15


def test_driver_drives_twists_of_any_frame_and_reports_publishers_that_disturb(
    start_driver: StartDriver, client: Client
) -> None:
    driver = start_driver("--link", "planar")
    silent = PublisherEventCallbacks(use_default_callbacks=False)
    client.node.create_publisher(TwistStamped, "cmd_vel", BEST_EFFORT, event_callbacks=silent)
    qos = "incompatible QoS (reliability)"
    client.wait(lambda: qos in driver.program.printed, qos)

    def is_driven() -> bool:
        linear, angular = driver.rates()
        return abs(linear - 0.2) < 0.02 and abs(angular - 0.4) < 0.05

    for frame in ("base_link", "odom", "teleop_twist_joy"):
        driver.drive_until(is_driven, f"twists in {frame}", stamped(0.2, 0.4, frame))
        client.wait(driver.stands, "wheels at rest after the time-out")
    for warning in ("twists in 'odom' are driven as if in 'base_link'", "cmd_vel: 2 publishers"):
        assert warning in driver.program.printed
    assert len(driver.warnings) == 3


def test_driver_takes_twists_without_stamps_and_other_names(
    start_driver: StartDriver, client: Client, namespace: str
) -> None:
    options = ("-p", "stamped:=false", "-r", "__node:=base", "-r", "base:cmd_vel:=drive")
    driver = start_driver("--link", "planar", "--ros-args", *options)
    assert ("base", namespace) in client.node.get_node_names_and_namespaces()
    types = dict(client.node.get_topic_names_and_types())
    assert types[f"{namespace}/drive"] == ["geometry_msgs/msg/Twist"]
    assert f"{namespace}/cmd_vel" not in types
    driver.publisher = client.publisher(Twist, "drive")
    driver.drive_until(driver.turns, "turning wheels", stamped(0.2).twist)


def test_driver_stops_by_its_services_and_a_refused_command(
    start_driver: StartDriver, client: Client
) -> None:
    with emulated_board(CONFIG) as board:
        driver = start_driver("--link", board.device)
        driver.drive_until(lambda: driver.place() > 0.3, "a robot ahead")
        assert client.call(Trigger, "acsar_driver/reset_odometry").success
        driver.drive_until(lambda: driver.place() < 0.2, "a new origin")

        answer = client.call(Trigger, "acsar_driver/estop")
        assert answer.success
        assert "release" in answer.message
        diagnostics = driver.diagnostics.messages
        diagnostics.clear()
        driver.drive_until(lambda: bool(diagnostics) and driver.stands(), "a stop")
        assert driver.read_diagnostics()["emergency stop"] == "true"
        assert float(driver.read_diagnostics()["latest tick [s]"]) > 0.0
        assert diagnostics[-1].status[0].level == b"\x02"
        assert client.call(Trigger, "acsar_driver/release").success
        driver.drive_until(driver.turns, "turning wheels")

        def is_refused() -> bool:
            return "isn't finite" in driver.read_diagnostics()["commands"]

        driver.drive_until(is_refused, "a refusal", stamped(math.nan))
        client.wait(driver.stands, "wheels at rest")


def test_driver_reset_changes_the_scene_and_stamps_grow(
    start_driver: StartDriver, client: Client, wall_file: Path
) -> None:
    driver = start_driver(*SIMULATED, "--realtime", 2.0)
    clocks = client.hear(Clock, "/clock")
    scans = client.hear(LaserScan, "scan")
    answer = client.set_scene(str(wall_file), (1.0, 0.0, 0.0))
    assert answer.success, answer.message
    scans.messages.clear()
    client.wait(lambda: len(scans.messages) > 3, "scans")
    scan = scans.messages[-1]
    ahead = round(-scan.angle_min / scan.angle_increment)
    assert scan.ranges[ahead] == pytest.approx(WALL - 1.0, abs=0.2)

    answer = client.set_scene("nosuch:1")
    assert not answer.success
    assert answer.message
    assert "\n" not in answer.message
    assert client.set_scene("clutter:7").success
    count = len(clocks.messages)
    client.wait(lambda: len(clocks.messages) > count + 100, "a second")
    times = [1e-9 * Time.from_msg(message.clock).nanoseconds for message in clocks.messages]
    assert np.diff(times).min() > 0.0
    rate = (times[-1] - times[count]) / (clocks.times[-1] - clocks.times[count])
    assert 1.0 < rate < 2.1  # a busy machine is slower than --realtime
    stamps_of(driver.odometry.messages)
    assert not driver.warnings


def test_driver_parameters_of_a_file_and_options_count(
    start_driver: StartDriver, client: Client, tmp_path: Path
) -> None:
    robot_file = tmp_path / "robot.yaml"
    RobotConfig.preset("acsar").with_(ros2={"wheel_separation": 0.5}).save(robot_file)
    values = {
        "robot": str(robot_file),
        "odom_frame": "odometry",
        "base_frame": "base_footprint",
        "lidar_frame": "laser",
        "lidar_x_offset": 0.25,
        "max_linear": 0.1,
        "wheel_radius": 0.06,
        "wheel_radus": 0.08,
        "control_rate": 50,
        "link": "bullet",
        "publish_tf": False,
        "use_sim_time": True,
        "pose_covariance_diagonal": [0.001, 0.001, 1e6, 1e6, 1e6, 0.03],
    }
    file = tmp_path / "parameters.yaml"
    file.write_text(yaml.safe_dump({"/**": {"ros__parameters": values}}))
    mounts = client.hear(TFMessage, "/tf_static", LATCHED)
    transforms = client.hear(TFMessage, "/tf")
    ros_arguments = ("--params-file", file, "-p", "wheel_separation:=0.4", "--")
    driver = start_driver("--ros-args", *ros_arguments, "--link", "planar")
    request = GetParameters.Request(names=["link", "wheel_radius", "wheel_separation"])
    answer = client.call(GetParameters, "acsar_driver/get_parameters", request)
    assert [*map(parameter_value_to_python, answer.values)] == ["planar", 0.06, 0.4]
    assert "wheel_radus: doesn't exist; did you mean 'wheel_radius'?" in driver.program.printed
    assert "are another controller's" in driver.program.printed
    change = Parameter("wheel_radius", value=0.3).to_parameter_msg()
    answer = client.call(
        SetParameters, "acsar_driver/set_parameters", SetParameters.Request(parameters=[change])
    )
    assert "read-only" in answer.results[0].reason

    driver.drive_until(lambda: driver.rates()[0] > 0.09, "a robot that drives", stamped(5.0))
    newest = driver.odometry.messages[-1]
    assert (newest.header.frame_id, newest.child_frame_id) == ("odometry", "base_footprint")
    assert newest.twist.twist.linear.x < 0.11
    diagonal = newest.pose.covariance.reshape(6, 6).diagonal()
    assert diagonal.tolist() == values["pose_covariance_diagonal"]
    fastest = max(map(abs, driver.joints.messages[-1].velocity))
    assert fastest == pytest.approx(0.1 / 0.06, rel=0.15)
    assert np.median(np.diff(stamps_of(driver.joints.messages))) == pytest.approx(2e7, abs=1e3)
    (mount,) = mounts.messages[0].transforms
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_footprint", "laser")
    assert mount.transform.translation.x == 0.25
    assert not transforms.messages


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (("-p", "wheel_radius:=abc"), "wheel_radius = 'abc': must be a valid number"),
        (("-p", "publish_tf:=1"), "publish_tf = 1: must be of type bool"),
        (("-p", "twist_covariance_diagonal:=[0.1]"), "must be six variances"),
        (("-p", "base_frame:=odom"), "must be three different names"),
        (("-p", "link:=planar", "-p", "start:=[a, b, c]"), "must be finite numbers"),
        (("-p", "link:=planar", "-p", "scene:=nosuch:1-1"), "nosuch"),
        (("--nosuch",), "unknown arguments of ROS: ['--nosuch']"),
    ],
)
def test_driver_refuses_a_wrong_parameter(
    start_program: StartProgram, arguments: tuple[str, ...], reason: str
) -> None:
    driver = start_program(*DRIVER, "--ros-args", *arguments)
    assert driver.wait() == 2
    assert driver.printed.startswith("acsar-gym: ")
    assert driver.printed.count("\n") == 1
    assert reason in driver.printed


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
    driver = start_driver(*SIMULATED)
    stalled = start_program("-c", STALLED, namespace)
    client.wait(lambda: "JointState" in stalled.printed, "a subscriber")
    stalled.send(signal.SIGSTOP)
    count = len(driver.joints.messages)
    client.wait(lambda: len(driver.joints.messages) > count + 300, "three seconds of joint states")
    stalled.send(signal.SIGCONT)


def test_watchdog_stops_the_wheels_if_the_node_hangs(
    client: Client, namespace: str, robot_file: Path
) -> None:
    """No process reads the driver's log, so that a line blocks the thread of its node forever."""
    _, write = os.pipe()
    fcntl.fcntl(write, fcntl.F_SETPIPE_SZ, 4096)
    files = ("--robot", str(robot_file), "--namespace", namespace)
    with emulated_board(CONFIG) as board, contextlib.ExitStack() as stack:
        process: Any = subprocess.Popen(
            [sys.executable, *DRIVER, *files, "--link", board.device],
            stderr=write,
            stdout=subprocess.DEVNULL,
        )
        stack.callback(process.wait)
        stack.callback(process.kill)
        driver = Driver(client, process)
        driver.drive_until(driver.turns, "turning wheels")

        os.set_blocking(write, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(write, b"." * 64)
        os.set_blocking(write, True)
        driver.publisher.publish(stamped(math.nan))
        client.spin(0.3)
        driver.drive_until(
            lambda: is_stopped_since(board, time.monotonic() - 0.5),
            "zeros for half a second, though the node is commanded",
        )


def is_stopped_since(board: EmulatedBoard, when: float) -> bool:
    """Whether the board has received only zeros since then."""
    late = "".join(event.get("rx", "") for event in board.events() if event["t"] > when)
    return bool(late) and all(character in "abcdpn0.,\r\n" for character in late)
