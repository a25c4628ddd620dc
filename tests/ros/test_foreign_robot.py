"""The robot that stands for those of others does what its options say."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from ros_tools import Client, ForeignRobot, Program, StartRobot
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState, LaserScan
from std_msgs.msg import Float64MultiArray
from tf2_msgs.msg import TFMessage

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RADIUS, SEPARATION = 0.05, 0.3
ROOM = (-2.0, -1.5, 4.0, 2.5)


def stamped(client: Client, linear: float, angular: float = 0.0) -> TwistStamped:
    message = TwistStamped()
    message.header.stamp = client.node.get_clock().now().to_msg()
    message.twist.linear.x, message.twist.angular.z = linear, angular
    return message


def seconds(message: Any) -> float:
    return float(Time.from_msg(message.header.stamp).nanoseconds * 1e-9)


def drive(client: Client, publisher: Any, linear: float, angular: float, duration: float) -> None:
    end = time.monotonic() + duration
    while time.monotonic() < end:
        publisher.publish(stamped(client, linear, angular))
        client.spin(0.02)


def quick(robot: ForeignRobot) -> list[dict[str, Any]]:
    return [state for state in robot.states if max(map(abs, state["speeds"])) > 0.01]


def test_commands_turn_the_wheels_of_each_side(start_robot: StartRobot, client: Client) -> None:
    robot = start_robot("--joints", "arm", "x=c", "y=d", "z=a", "w=b", "--multiplier", 1.5)
    joints = client.hear(JointState, "joint_states")
    odometry = client.hear(Odometry, "odom")
    drive(client, client.publisher(TwistStamped, "cmd_vel"), 0.2, 1.0, 0.5)
    turning = max(robot.states, key=lambda state: max(state["speeds"]))
    half = SEPARATION * 1.5 / 2.0
    left, right = (0.2 - half) / RADIUS, (0.2 + half) / RADIUS
    assert turning["speeds"] == pytest.approx([left, right, right, left], abs=0.05)
    last = joints.messages[-1]
    assert list(last.name) == ["arm", "x", "y", "z", "w"]
    logged = min(robot.states, key=lambda state: abs(state["stamp"] - seconds(last)))
    assert list(last.velocity) == [0.0, *logged["speeds"]]
    assert len(last.position) == 5
    twist = odometry.messages[-1].twist.twist
    assert (twist.linear.x, twist.angular.z) == pytest.approx((0.2, 1.0), abs=0.01)


@pytest.mark.parametrize(
    ("command", "message"),
    [("twist", Twist()), ("wheel_speeds", Float64MultiArray(data=[4.0, 4.0]))],
)
def test_other_types_of_commands(
    command: str, message: Any, start_robot: StartRobot, client: Client
) -> None:
    if command == "twist":
        message.linear.x = 0.2
    robot = start_robot("--joints", "left_wheel=left", "right_wheel=right", "--command", command)
    client.publisher(type(message), "cmd_vel").publish(message)
    client.wait(lambda: bool(quick(robot)), "turning wheels")
    client.wait(robot.stands, "the time-out of commands")
    assert max(state["speeds"][0] for state in robot.states) == pytest.approx(4.0, abs=0.05)
    assert robot.states[-1]["pose"][0] == pytest.approx(0.5 * 0.2, abs=0.001)


def test_dead_time_and_time_out(start_robot: StartRobot, client: Client) -> None:
    robot = start_robot("--delay", 0.15, "--cmd-vel-timeout", 0.3, "--time-constant", 0.0)
    client.publisher(TwistStamped, "cmd_vel").publish(stamped(client, 0.2))
    client.wait(lambda: bool(quick(robot)), "turning wheels")
    client.wait(robot.stands, "the time-out of commands")
    begun = quick(robot)[0]["monotonic"] - robot.commands[0]["monotonic"]
    ended = robot.stood_at() - robot.commands[0]["monotonic"]
    assert 0.15 <= begun <= 0.15 + 0.02 + 1e-6
    assert 0.45 <= ended <= 0.45 + 0.02 + 1e-6


def test_what_is_old_or_not_finite_is_refused(start_robot: StartRobot, client: Client) -> None:
    robot = start_robot()
    publisher = client.publisher(TwistStamped, "cmd_vel")
    old = stamped(client, 0.2)
    old.header.stamp.sec -= 1
    publisher.publish(old)
    publisher.publish(stamped(client, math.nan))
    client.wait(lambda: len(robot.commands) == 2, "both commands")
    assert "s old" in robot.commands[0]["refused"]
    assert robot.commands[1]["refused"] == "not finite"
    assert robot.stands()


@pytest.mark.parametrize("upside_down", [False, True], ids=["upright", "upside_down"])
@pytest.mark.parametrize("direction", ["cw", "ccw"])
@pytest.mark.parametrize("mast", [False, True], ids=["fixed", "mast"])
def test_scan_is_that_of_the_room(
    direction: str, upside_down: bool, mast: bool, start_robot: StartRobot, client: Client
) -> None:
    flags = [*["--upside-down"] * upside_down, *["--mast"] * mast]
    robot = start_robot(
        *("--scan-rate", 10, "--scan-time-increment", 0.0002, "--scan-holes", "--scan-yaw", 0.7),
        *("--scan-direction", direction, *flags),
    )
    # Latched: who comes late still gets it.
    mounts = client.hear(TFMessage, "/tf_static", LATCHED)
    scans = client.hear(LaserScan, "scan")
    drive(client, client.publisher(TwistStamped, "cmd_vel"), 0.3, 1.0, 1.0)
    client.wait(lambda: bool(mounts.messages and len(scans.messages) > 5), "scans")
    turns, place = np.eye(3), np.zeros(3)
    for hop in mounts.messages[0].transforms:
        moved, q = hop.transform.translation, hop.transform.rotation
        place = place + turns @ (moved.x, moved.y, moved.z)
        turns = turns @ rotation(q.w, np.array([q.x, q.y, q.z]))
    assert hop.child_frame_id == "laser"
    scan = scans.messages[-1]
    assert (scan.angle_increment < 0.0) == (direction == "cw")
    states = robot.states
    stamps = np.array([state["stamp"] for state in states])
    poses = np.array([state["pose"] for state in states]).T
    hits = 0
    for index, distance in enumerate(scan.ranges):
        if not math.isfinite(distance):
            continue
        angle = scan.angle_min + index * scan.angle_increment
        ray = turns @ (math.cos(angle), math.sin(angle), 0.0) * distance + place
        when = seconds(scan) + index * scan.time_increment
        x, y, theta = (np.interp(when, stamps, values) for values in poses)
        hit_x = x + ray[0] * math.cos(theta) - ray[1] * math.sin(theta)
        hit_y = y + ray[0] * math.sin(theta) + ray[1] * math.cos(theta)
        walls = (hit_x - ROOM[0], hit_y - ROOM[1], hit_x - ROOM[2], hit_y - ROOM[3])
        assert min(map(abs, walls)) < 0.01
        hits += 1
    assert hits == 360 - 36


def rotation(w: float, axis: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """The matrix of a quaternion."""
    cross = np.cross(np.eye(3), axis)
    return np.asarray(np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross)


def test_simulated_time_runs_as_fast_as_asked(start_robot: StartRobot, client: Client) -> None:
    start_robot("--sim-time", 3.0)
    clocks = client.hear(Clock, "/clock")
    joints = client.hear(JointState, "joint_states")
    client.wait(lambda: len(joints.messages) > 150, "a second")
    times = [Time.from_msg(message.clock).nanoseconds * 1e-9 for message in clocks.messages]
    assert 100.0 <= times[0] < 200.0
    ran = (times[-1] - times[0]) / (clocks.times[-1] - clocks.times[0])
    assert ran == pytest.approx(3.0, rel=0.1)
    stamps = [seconds(message) for message in joints.messages]
    assert np.diff(stamps) == pytest.approx(1.0 / 50.0, abs=1e-6)


def test_faults_begin_after_the_first_command(start_robot: StartRobot, client: Client) -> None:
    robot = start_robot(
        *("--nan-after", 0.2, "--missing-joint", "left_rear", "--missing-after", 0.4),
        *("--clock-jump-after", 0.6, "--drop-after", 0.8),
    )
    joints = client.hear(JointState, "joint_states")
    drive(client, client.publisher(TwistStamped, "cmd_vel"), 0.1, 0.0, 1.2)
    messages = joints.messages
    assert any(math.isnan(message.velocity[0]) for message in messages)
    assert {len(message.name) for message in messages} == {3, 4}
    assert np.diff([seconds(message) for message in messages]).min() < -4.0
    begun = robot.commands[0]["monotonic"]
    assert 0.75 < joints.times[-1] - begun < 1.1
    assert robot.states[-1]["monotonic"] - begun > 1.0


def test_joints_without_speeds_and_none_at_all(
    start_robot: StartRobot, client: Client, programs: list[Program]
) -> None:
    start_robot("--positions-only")
    joints = client.hear(JointState, "joint_states")
    client.wait(lambda: bool(joints.messages), "joint states")
    assert not joints.messages[0].velocity
    assert len(joints.messages[0].position) == 4
    programs[0].kill()
    start_robot("--odom-only", "--frame", "base_footprint")
    odometry = client.hear(Odometry, "odom")
    count = len(joints.messages)
    client.wait(lambda: len(odometry.messages) > 5, "odometry")
    assert len(joints.messages) == count
    assert odometry.messages[-1].child_frame_id == "base_footprint"
