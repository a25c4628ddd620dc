"""`link="ros2"` drives robots of any names and types, and stops if they fail."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from geometry_msgs.msg import TwistStamped
from ros_tools import Client, ForeignRobot, StartProgram, StartRobot

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import BoardSilentError, LinkError

WHEELS = ("right_front", "left_front", "left_rear", "right_rear")
TWO: dict[str, Any] = {"joints": {"left": "l", "right": "r"}}
TWO_WHEELS: dict[str, Any] = {"joints": ["l=left", "r=right"]}
ROBOTS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "two wheels": (TWO_WHEELS | {"command": "twist"}, {"ros2": TWO}),
    "wheel speeds": (
        {"command": "wheel_speeds", "joints": ["arm", "rl=c", "fr=a", "rr=d", "gripper", "fl=b"]},
        {"ros2": {"joints": ["fr", "fl", "rl", "rr"], "command_joints": ["rl", "fr", "rr", "fl"]}},
    ),
    "speeds of two wheels": (
        TWO_WHEELS | {"command": "wheel_speeds"},
        {"ros2": TWO | {"command_joints": ["l", "r"]}},
    ),
    "odom": (
        {"odom_only": True, "multiplier": 1.4},
        {"connect_timeout": 3.0, "wheel_separation_multiplier": 1.4},
    ),
    "other topics": (
        {
            "command_topic": "base/cmd_vel",
            "remap": "joint_states:=base/joints",
            "qos": "best_effort",
            "command_qos": "best_effort",
        },
        {"ros2": {"command_topic": "base/cmd_vel", "joint_states_topic": "base/joints"}},
    ),
    "simulated time": ({"sim_time": 2.0}, {}),
}
"""Options of robots of other makers, and fields of their files."""
OpenRobot = Callable[..., Robot]


@pytest.fixture
def open_robot(namespace: str, foreign_config: RobotConfig) -> OpenRobot:
    """`open_robot(connect_timeout=2.0)`: the foreign robot, with these fields of its file."""

    def make(**fields: Any) -> Robot:
        config = foreign_config.with_(**fields)
        return Robot(open_link(f"ros2:{namespace}", config), config)

    return make


def drive(robot: Robot, linear: float, angular: float, seconds: float) -> None:
    for _ in range(round(seconds / robot.config.period)):
        robot.drive(linear, angular)


def drive_ahead(robot: Robot) -> None:
    """Drive until odometry is ahead, at most 10 s."""
    for _ in range(500):
        if robot.odometry.pose[0] > 0.05:
            return
        robot.drive(0.2, 0.0)
    pytest.fail(f"the robot is at {robot.odometry.pose} after 10 s")


def has_turned(robot: ForeignRobot) -> bool:
    return any(abs(speed) > 0.05 for state in robot.states for speed in state["speeds"])


def wait_for_stop(robot: ForeignRobot, client: Client) -> None:
    """Wait for wheels at rest after a command of zeros, by a link that none of them refused."""
    client.wait(robot.stands, "standing wheels")
    assert not [command for command in robot.commands if "refused" in command]
    assert not any(robot.commands[-1]["command"])


@pytest.mark.parametrize("name", ROBOTS)
def test_link_drives_every_robot_with_true_odometry(
    name: str, open_robot: OpenRobot, start_robot: StartRobot, client: Client
) -> None:
    options, fields = ROBOTS[name]
    foreign = start_robot(**options)
    with open_robot(**fields) as robot:
        drive(robot, 0.2, 0.6, 1.0)
        drive(robot, 0.0, 0.0, 1.0)
        assert max(map(abs, robot.speeds)) < 0.05
        pose = robot.odometry.pose

    wait_for_stop(foreign, client)
    x, y, theta = foreign.states[-1]["pose"]
    assert theta > 0.4
    assert math.hypot(pose[0] - x, pose[1] - y) < 0.01
    assert pose[2] == pytest.approx(theta, abs=0.03)


def test_link_drives_only_the_robot_of_its_namespace(
    open_robot: OpenRobot, start_robot: StartRobot, client: Client
) -> None:
    foreign = start_robot()
    neighbour = ForeignRobot(foreign.log.parent, namespace="/other")
    client.programs.append(neighbour)
    client.wait(lambda: bool(neighbour.states), "the other robot")
    robot = open_robot()
    for _ in range(2):  # and again
        with robot:
            assert robot.odometry.pose == (0.0, 0.0, 0.0)
            drive_ahead(robot)
        assert not any(foreign.commands[-1]["command"])
    assert not neighbour.commands


@pytest.mark.parametrize(
    ("options", "kind", "reason"),
    [
        ({"nan_after": 0.5}, BoardSilentError, "right_front"),
        ({"missing_joint": "left_rear", "missing_after": 0.5}, BoardSilentError, "left_rear"),
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
    open_robot: OpenRobot,
    start_robot: StartRobot,
    client: Client,
) -> None:
    foreign = start_robot(cmd_vel_timeout=5.0, **options)
    robot = open_robot(feedback_timeout=0.5)
    with pytest.raises(kind, match=reason) as raised, robot:
        drive(robot, 0.2, 0.3, 5.0)
    assert "\n" not in str(raised.value)
    assert all(map(math.isfinite, robot.odometry.pose))
    client.wait(foreign.stands, "standing wheels")
    assert not any(foreign.commands[-1]["command"])


def test_link_reports_a_simulation_that_ends(
    open_robot: OpenRobot, start_robot: StartRobot
) -> None:
    foreign = start_robot(sim_time=1.0)
    with open_robot() as robot:
        drive(robot, 0.1, 0.0, 0.2)
        foreign.kill()
        with pytest.raises(LinkError, match="/clock stands still"):
            drive(robot, 0.1, 0.0, 20.0)


@pytest.mark.parametrize(
    ("options", "ros2", "reason"),
    [
        ({"command_qos": "transient_local"}, {}, "incompatible QoS"),
        ({"command_topic": "drive"}, {}, "no node subscribes .*drive"),
        ({"odom_only": True, "frame": "base_footprint"}, {}, "base_footprint"),
        (
            {"remap": "joint_states:=wheels"},
            {"feedback": "joint_states"},
            "no node publishes .*wheels",
        ),
    ],
)
def test_link_refuses_what_it_cannot_use(
    options: dict[str, Any],
    ros2: dict[str, Any],
    reason: str,
    open_robot: OpenRobot,
    start_robot: StartRobot,
    client: Client,
) -> None:
    foreign = start_robot(**options)
    with pytest.raises(LinkError, match=reason) as raised:
        open_robot(ros2=ros2, connect_timeout=2.0).activate()
    assert "\n" not in str(raised.value)
    client.spin(0.1)
    assert not has_turned(foreign)


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
    namespace: str,
    open_robot: OpenRobot,
    start_robot: StartRobot,
    start_program: StartProgram,
    client: Client,
) -> None:
    foreign = start_robot()
    start_program("-c", JOINT_STATE_PUBLISHER, namespace, "shoulder", "elbow")
    topic = f"{namespace}/joint_states"
    client.wait(lambda: client.node.count_publishers(topic) == 2, "the arm")

    with open_robot() as robot:
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
    namespace: str, open_robot: OpenRobot, start_robot: StartRobot, start_program: StartProgram
) -> None:
    foreign = start_robot()
    with open_robot() as first:
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
    open_robot: OpenRobot, start_robot: StartRobot, client: Client
) -> None:
    foreign = start_robot()
    robot = open_robot()
    robot.activate()
    publisher = client.publisher(TwistStamped, "cmd_vel")
    drive(robot, 0.1, 0.0, 0.3)
    command = TwistStamped()
    command.twist.linear.x = 0.4
    publisher.publish(command)
    with pytest.raises(LinkError, match="/client"):
        drive(robot, 0.1, 0.0, 2.0)
    wait_for_stop(foreign, client)


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
    foreign_config: RobotConfig,
    tmp_path: Path,
) -> None:
    options, fields = ROBOTS[name]
    foreign = start_robot(cmd_vel_timeout=20.0, **options)
    file = tmp_path / "robot.yaml"
    foreign_config.with_(**fields, watchdog_timeout=0.15).save(file)

    program = start_program("-c", DRIVER, f"ros2:{namespace}", file)
    client.wait(lambda: has_turned(foreign), "turning wheels")
    client.spin(0.3)
    program.send(signal.SIGKILL)
    wait_for_stop(foreign, client)  # the robot's own time-out is 20 s
