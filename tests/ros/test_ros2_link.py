"""`link="ros2"` drives robots of any names and types, and stops if they fail."""

from __future__ import annotations

import math
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from geometry_msgs.msg import TwistStamped
from ros_tools import Client, ForeignRobot, StartProgram, StartRobot

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import BoardSilentError, LinkError

WHEELS = ("right_front", "left_front", "left_rear", "right_rear")
JOINTS: dict[str, Any] = {"joints": list(WHEELS)}
TWO: dict[str, Any] = {"joints": {"left": "l", "right": "r"}}
TWO_WHEELS: dict[str, Any] = {"joints": ["l=left", "r=right"]}
CONTROL_RATE = 50.0


class Variant(NamedTuple):
    """A robot of another maker, and its file."""

    options: Mapping[str, Any] = {}
    ros2: Mapping[str, Any] = JOINTS
    changes: Mapping[str, Any] = {}


PLAIN = Variant()
VARIANTS = {
    "two wheels": Variant(TWO_WHEELS | {"command": "twist"}, TWO),
    "wheel speeds": Variant(
        {"command": "wheel_speeds", "joints": ["arm", "rl=c", "fr=a", "rr=d", "gripper", "fl=b"]},
        {"joints": ["fr", "fl", "rl", "rr"], "command_joints": ["rl", "fr", "rr", "fl"]},
    ),
    "speeds of two wheels": Variant(
        TWO_WHEELS | {"command": "wheel_speeds"}, TWO | {"command_joints": ["l", "r"]}
    ),
    "positions that wrap": Variant({"wrap": 2.0 * math.pi}),
    "odom": Variant(
        {"odom_only": True, "multiplier": 1.4},
        {},
        {"connect_timeout": 3.0, "wheel_separation_multiplier": 1.4},
    ),
    "other topics": Variant(
        {
            "command_topic": "base/cmd_vel",
            "remap": "joint_states:=base/joints",
            "qos": "best_effort",
            "command_qos": "best_effort",
        },
        JOINTS | {"command_topic": "base/cmd_vel", "joint_states_topic": "base/joints"},
    ),
    "simulated time": Variant({"sim_time": 2.0}, changes={"feedback_timeout": 2.0}),
    "slow and late": Variant({"delay": 0.12, "rate": 25.0}),
}


def make_config(variant: Variant, **changes: Any) -> RobotConfig:
    """The file of a robot with the foreign one's wheels."""
    fields: dict[str, Any] = {
        "wheel_radius": 0.05,
        "wheel_separation": 0.3,
        "wheel_separation_multiplier": 1.0,
        "control_rate": CONTROL_RATE,
        "connect_timeout": 20.0,
        "watchdog_timeout": 2.0,
        "ros2": variant.ros2,
    }
    return RobotConfig.preset("acsar").with_(**fields | {**variant.changes} | changes)


def open_robot(namespace: str, variant: Variant = PLAIN, **changes: Any) -> Robot:
    config = make_config(variant, **changes)
    return Robot(open_link(f"ros2:{namespace}", config), config)


def drive(robot: Robot, linear: float, angular: float, seconds: float) -> None:
    for _ in range(round(seconds * CONTROL_RATE)):
        robot.drive(linear, angular)


def drive_ahead(robot: Robot, distance: float = 0.05) -> None:
    """Drive until odometry is this far ahead [m], at most 10 s."""
    for _ in range(round(10.0 * CONTROL_RATE)):
        if robot.odometry.pose[0] > distance:
            return
        robot.drive(0.2, 0.0)
    pytest.fail(f"the robot is at {robot.odometry.pose} after 10 s")


def is_one_line(error: BaseException) -> bool:
    return bool(str(error)) and "\n" not in str(error)


def turned(robot: ForeignRobot) -> bool:
    return any(abs(speed) > 0.05 for state in robot.states for speed in state["speeds"])


@pytest.mark.parametrize("name", VARIANTS)
def test_link_drives_every_robot_with_true_odometry(
    name: str, namespace: str, start_robot: StartRobot, client: Client
) -> None:
    variant = VARIANTS[name]
    foreign = start_robot(**variant.options)
    with open_robot(namespace, variant) as robot:
        drive(robot, 0.2, 0.6, 1.0)
        drive(robot, 0.0, 0.0, 1.0)
        assert max(map(abs, robot.speeds)) < 0.05
        pose = robot.odometry.pose

    client.wait(foreign.stands, "standing wheels")
    assert not [command for command in foreign.commands if "refused" in command]
    assert not any(foreign.commands[-1]["command"])
    x, y, theta = foreign.states[-1]["pose"]
    assert theta > 0.4
    assert math.hypot(pose[0] - x, pose[1] - y) < 0.01
    assert pose[2] == pytest.approx(theta, abs=0.03)


def test_link_drives_only_the_robot_of_its_namespace(
    namespace: str, start_robot: StartRobot, client: Client
) -> None:
    foreign = start_robot()
    neighbour = ForeignRobot(foreign.log.parent, namespace="/other")
    client.programs.append(neighbour)
    client.wait(lambda: bool(neighbour.states), "the other robot")
    with open_robot(namespace) as robot:
        drive_ahead(robot)
    assert turned(foreign)
    assert not neighbour.commands


@pytest.mark.parametrize(
    ("options", "kind", "reason"),
    [
        ({"nan_after": 0.5}, BoardSilentError, "right_front"),
        (
            {"missing_joint": "left_rear", "missing_after": 0.5},
            BoardSilentError,
            "left_rear",
        ),
        ({"drop_after": 0.5}, BoardSilentError, "no message"),
        ({"clock_jump_after": 0.5}, BoardSilentError, "behind"),
        ({"clock_jump_after": 0.5, "sim_time": 1.0}, LinkError, "/clock"),
    ],
    ids=["nan", "missing joint", "silence", "stamps jump back", "the clock jumps back"],
)
def test_link_stops_the_robot_after_a_fault(
    options: dict[str, Any],
    kind: type[LinkError],
    reason: str,
    namespace: str,
    start_robot: StartRobot,
    client: Client,
) -> None:
    foreign = start_robot(cmd_vel_timeout=5.0, **options)
    robot = open_robot(namespace)
    with pytest.raises(kind, match=reason) as raised, robot:
        drive(robot, 0.2, 0.3, 5.0)
    assert is_one_line(raised.value)
    assert all(map(math.isfinite, robot.odometry.pose))
    client.wait(foreign.stands, "standing wheels")
    assert not any(foreign.commands[-1]["command"])


@pytest.mark.parametrize(
    ("sim_time", "reason"), [(0.0, "no message for"), (1.0, "/clock stands still")]
)
def test_link_reports_a_robot_that_ends(
    sim_time: float, reason: str, namespace: str, start_robot: StartRobot
) -> None:
    foreign = start_robot(sim_time=sim_time)
    with pytest.raises(LinkError, match=reason) as raised, open_robot(namespace) as robot:
        drive(robot, 0.1, 0.0, 0.2)
        foreign.kill()
        drive(robot, 0.1, 0.0, 20.0)
    assert is_one_line(raised.value)


@pytest.mark.parametrize(
    ("options", "ros2", "reason"),
    [
        ({"missing_joint": "left_rear"}, JOINTS, "left_rear"),
        ({"command_qos": "transient_local"}, JOINTS, "incompatible QoS"),
        ({"command_topic": "drive"}, JOINTS, "no node subscribes .*drive"),
        ({"odom_only": True, "frame": "base_footprint"}, JOINTS, "base_footprint"),
        (
            {"remap": "joint_states:=wheels"},
            JOINTS | {"feedback": "joint_states"},
            "no node publishes .*wheels",
        ),
    ],
)
def test_link_refuses_what_it_cannot_use(
    options: dict[str, Any],
    ros2: dict[str, Any],
    reason: str,
    namespace: str,
    start_robot: StartRobot,
    client: Client,
) -> None:
    foreign = start_robot(**options)
    with pytest.raises(LinkError, match=reason) as raised:
        open_robot(namespace, Variant(ros2=ros2), connect_timeout=2.0).activate()
    assert is_one_line(raised.value)
    client.spin(0.1)
    assert not turned(foreign)


JOINT_STATE_PUBLISHER = """
import sys, time
import rclpy
from sensor_msgs.msg import JointState

rclpy.init()
node = rclpy.create_node("joint_state_publisher", namespace=sys.argv[1])
publisher = node.create_publisher(JointState, "joint_states", 10)
message = JointState(name=sys.argv[2:], position=[0.0] * len(sys.argv[2:]))
while True:
    message.header.stamp = node.get_clock().now().to_msg()
    publisher.publish(message)
    time.sleep(0.1)
"""


def test_link_refuses_a_second_publisher_of_the_wheels_only(
    namespace: str, start_robot: StartRobot, start_program: StartProgram, client: Client
) -> None:
    foreign = start_robot()
    start_program("-c", JOINT_STATE_PUBLISHER, namespace, "shoulder", "elbow")
    topic = f"{namespace}/joint_states"
    client.wait(lambda: client.node.count_publishers(topic) == 2, "the arm")
    robot = open_robot(namespace)

    with robot:
        drive_ahead(robot)
        start_program("-c", JOINT_STATE_PUBLISHER, namespace, *WHEELS)
        with pytest.raises(LinkError, match="two nodes publish the wheels") as raised:
            drive(robot, 0.1, 0.0, 30.0)
    for name in ("foreign_robot", "joint_state_publisher"):
        assert f"{namespace}/{name}" in str(raised.value)
    client.wait(foreign.stands, "standing wheels")
    with pytest.raises(LinkError, match="two nodes publish the wheels"):
        robot.activate()


def test_link_publishes_nothing_to_a_robot_that_is_driven(
    namespace: str, start_robot: StartRobot, start_program: StartProgram, client: Client
) -> None:
    foreign = start_robot()
    with open_robot(namespace) as first:
        drive(first, 0.1, 0.0, 0.3)
        code = (
            "import sys; from acsar_gym import open_link, RobotConfig\n"
            "open_link(sys.argv[1], RobotConfig(ros2={'joints': sys.argv[2:]})).open()"
        )
        second = start_program("-c", code, f"ros2:{namespace}", *WHEELS)
        second.signalled = True
        while second.process.poll() is None:
            drive(first, 0.1, 0.0, 0.1)

        assert "another node commands the robot (/" in second.printed
        assert f"{namespace}/acsar_gym_" in second.printed
        zeros = [line for line in foreign.commands if not any(line["command"])]
        driven = [line for line in foreign.commands if any(line["command"])]
        assert zeros[-1]["monotonic"] < driven[0]["monotonic"]


def test_link_stops_if_another_node_commands(
    namespace: str, start_robot: StartRobot, client: Client
) -> None:
    foreign = start_robot()
    robot = open_robot(namespace)
    robot.activate()
    publisher = client.publisher(TwistStamped, "cmd_vel")
    drive(robot, 0.1, 0.0, 0.3)
    command = TwistStamped()
    command.twist.linear.x = 0.4
    publisher.publish(command)
    with pytest.raises(LinkError, match="/client"):
        drive(robot, 0.1, 0.0, 2.0)
    client.wait(foreign.stands, "standing wheels")
    assert not any(foreign.commands[-1]["command"])


DRIVER = """
import sys
from acsar_gym import Robot, RobotConfig, open_link

config = RobotConfig.load(sys.argv[2])
with Robot(open_link(sys.argv[1], config), config) as robot:
    while True:
        robot.drive(0.2, 0.0)
"""


@pytest.mark.parametrize("name", ["speeds of two wheels", "simulated time"])
def test_wheels_are_at_rest_soon_after_the_program_is_killed(
    name: str,
    namespace: str,
    start_robot: StartRobot,
    start_program: StartProgram,
    client: Client,
    tmp_path: Path,
) -> None:
    variant = VARIANTS[name]
    foreign = start_robot(cmd_vel_timeout=20.0, **variant.options)
    file = tmp_path / "robot.yaml"
    make_config(variant, watchdog_timeout=0.15).save(file)

    program = start_program("-c", DRIVER, f"ros2:{namespace}", file)
    client.wait(lambda: turned(foreign), "turning wheels")
    client.spin(0.3)
    program.send(signal.SIGKILL)
    client.wait(foreign.stands, "standing wheels")  # the robot's own time-out is 20 s
    assert not [command for command in foreign.commands if "refused" in command]


def test_link_opens_again(namespace: str, start_robot: StartRobot, client: Client) -> None:
    foreign = start_robot()
    robot = open_robot(namespace)
    for _ in range(3):
        with robot:
            assert robot.odometry.pose == (0.0, 0.0, 0.0)
            drive_ahead(robot)
        assert not any(foreign.commands[-1]["command"])
