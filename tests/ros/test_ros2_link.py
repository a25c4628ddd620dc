"""`link="ros2"` drives robots of others, however they are named, and stops where they fail."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest
from geometry_msgs.msg import TwistStamped
from ros_tools import Client, ForeignRobot, StartProgram, StartRobot

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import BoardSilentError, LinkError, SafetyWarning

JOINTS: dict[str, object] = {"joints": ["right_front", "left_front", "left_rear", "right_rear"]}
TWO: dict[str, object] = {"joints": {"left": "l", "right": "r"}}
TWO_WHEELS = ("--joints", "l=left", "r=right")
SHUFFLED = ("--joints", "arm", "rl=c", "fr=a", "rr=d", "gripper", "fl=b")
CONTROL_RATE = 50.0


class Variant(NamedTuple):
    """A robot of others, and what its file says about it."""

    options: tuple[object, ...] = ()
    ros2: dict[str, object] = JOINTS
    changes: Mapping[str, object] = MappingProxyType({})


VARIANTS = {
    "plain": Variant(),
    "names in another order": Variant(SHUFFLED, {"joints": ["fr", "fl", "rl", "rr"]}),
    "names by wheel": Variant(SHUFFLED, {"joints": {"d": "rr", "c": "rl", "b": "fl", "a": "fr"}}),
    "two wheels": Variant(TWO_WHEELS, TWO),
    "twist": Variant(("--command", "twist")),
    "wheel speeds": Variant(
        ("--command", "wheel_speeds", *SHUFFLED),
        {"joints": ["fr", "fl", "rl", "rr"], "command_joints": ["rl", "fr", "rr", "fl"]},
    ),
    "speeds of two wheels": Variant(
        ("--command", "wheel_speeds", *TWO_WHEELS), TWO | {"command_joints": ["l", "r"]}
    ),
    "positions only": Variant(("--positions-only",)),
    "odom only": Variant(("--odom-only",), {}, {"connect_timeout": 3.0}),
    "odom said": Variant(("--multiplier", 1.4), {"feedback": "odom"}),
    "best effort": Variant(("--qos", "best_effort", "--command-qos", "best_effort")),
    "other topics": Variant(
        ("--command-topic", "base/cmd_vel", "--ros-args", "-r", "joint_states:=base/joints"),
        JOINTS | {"command_topic": "base/cmd_vel", "joint_states_topic": "base/joints"},
    ),
    "simulated time": Variant(("--sim-time", 1.0)),
    "simulated time thrice as fast": Variant(
        ("--sim-time", 3.0, "--clock-rate", 100.0), changes={"feedback_timeout": 1.5}
    ),
    "a multiplier": Variant(("--multiplier", 1.5), changes={"wheel_separation_multiplier": 1.5}),
    "a dead time": Variant(("--delay", 0.12)),
    "twice the control rate": Variant(("--rate", 100.0)),
    "half of the control rate": Variant(("--rate", 25.0)),
}


def make_config(variant: Variant, **changes: object) -> RobotConfig:
    """The file of a robot with the foreign one's wheels."""
    fields: dict[str, Any] = {
        "wheel_radius": 0.05,
        "wheel_separation": 0.3,
        "wheel_separation_multiplier": 1.4 if 1.4 in variant.options else 1.0,
        "control_rate": CONTROL_RATE,
        "connect_timeout": 20.0,
        "watchdog_timeout": 2.0,
        "ros2": variant.ros2,
    }
    return RobotConfig.preset("acsar").with_(**fields | {**variant.changes} | changes)


def open_robot(namespace: str, variant: Variant = VARIANTS["plain"], **changes: object) -> Robot:
    config = make_config(variant, **changes)
    return Robot(open_link(f"ros2:{namespace}", config), config)


def drive(robot: Robot, linear: float, angular: float, seconds: float) -> None:
    for _ in range(round(seconds * CONTROL_RATE)):
        robot.drive(linear, angular)


def is_one_line(error: BaseException) -> bool:
    return bool(str(error)) and "\n" not in str(error)


def turned(robot: ForeignRobot) -> bool:
    return any(abs(speed) > 0.05 for state in robot.states for speed in state["speeds"])


@pytest.mark.parametrize("name", VARIANTS)
def test_every_robot_is_driven_and_its_odometry_is_true(
    name: str, namespace: str, start_robot: StartRobot, client: Client
) -> None:
    variant = VARIANTS[name]
    foreign = start_robot(*variant.options)
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


def test_one_of_two_robots_is_driven(
    namespace: str, start_robot: StartRobot, client: Client
) -> None:
    other = ForeignRobot(("--namespace", "/other"), start_robot().log.parent)
    client.programs.append(other)
    client.wait(lambda: bool(other.states), "the other robot")
    foreign = client.programs[0]
    assert isinstance(foreign, ForeignRobot)
    with open_robot(namespace) as robot:
        drive(robot, 0.2, 0.0, 0.5)
        assert robot.odometry.pose[0] > 0.05
    assert turned(foreign)
    assert not turned(other)
    assert not other.commands


def test_wheels_stand_soon_after_an_error_of_the_program(
    namespace: str, start_robot: StartRobot, client: Client
) -> None:
    foreign = start_robot("--cmd-vel-timeout", 5.0)
    with pytest.raises(ZeroDivisionError), open_robot(namespace) as robot:
        drive(robot, 0.2, 0.0, 0.5)
        begun = time.monotonic()
        raise ZeroDivisionError
    client.wait(foreign.stands, "standing wheels")
    # The time constant of its wheels is 50 ms.
    assert foreign.stood_at() - begun < 1.0
    assert not any(foreign.commands[-1]["command"])


FAULTS = {
    "a wheel's speed is NaN": (("--nan-after", 0.5), BoardSilentError, "right_front"),
    "a joint goes missing": (
        ("--missing-joint", "left_rear", "--missing-after", 0.5),
        BoardSilentError,
        "left_rear",
    ),
    "silence": (("--drop-after", 0.5), BoardSilentError, "no message"),
    "odometry is NaN": (("--nan-after", 0.5, "--odom-only"), BoardSilentError, "nan"),
    "stamps jump back": (("--clock-jump-after", 0.5), BoardSilentError, "behind"),
    "the clock jumps back": (("--clock-jump-after", 0.5, "--sim-time", 1.0), LinkError, "/clock"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_stop_the_robot_with_one_line(
    fault: str, namespace: str, start_robot: StartRobot, client: Client
) -> None:
    options, kind, said = FAULTS[fault]
    foreign = start_robot("--cmd-vel-timeout", 5.0, *options)
    changes: dict[str, Any] = {"ros2": {"feedback": "odom"}} if "--odom-only" in options else {}
    robot = open_robot(namespace, **changes)
    with pytest.raises(kind, match=said) as raised, robot:
        drive(robot, 0.2, 0.3, 5.0)
    assert is_one_line(raised.value)
    assert all(map(math.isfinite, robot.odometry.pose))
    client.wait(foreign.stands, "standing wheels")
    assert not any(foreign.commands[-1]["command"])
    begun = next(line["monotonic"] for line in foreign.commands if any(line["command"]))
    last = foreign.commands[-1]["monotonic"]
    # The fault comes within 0.5 s, and is found 0.5 s later; a busy machine adds to it.
    assert last - begun < 1.0 + 0.7


@pytest.mark.parametrize(
    ("options", "said"), [((), "no message for"), (("--sim-time", 1.0), "/clock stands still")]
)
def test_a_robot_that_ends_is_one_line(
    options: tuple[object, ...], said: str, namespace: str, start_robot: StartRobot
) -> None:
    foreign = start_robot(*options)
    with pytest.raises(LinkError, match=said) as raised, open_robot(namespace) as robot:
        drive(robot, 0.1, 0.0, 0.2)
        foreign.kill()
        drive(robot, 0.1, 0.0, 20.0)
    assert is_one_line(raised.value)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--nan-after", 0.0), "right_front"),
        (("--missing-joint", "left_rear"), "left_rear"),
        (("--command-qos", "transient_local"), "incompatible QoS"),
        (("--joints", "p=a", "q=b", "r=c", "s=d"), "right_front"),
        (("--command-topic", "drive"), "drive"),
        (("--odom-only", "--frame", "base_footprint"), "base_footprint"),
        (("--ros-args", "-r", "joint_states:=wheels"), "wheels"),
    ],
)
def test_what_cannot_be_used_is_one_line_and_nothing_is_driven(
    options: tuple[object, ...], said: str, namespace: str, start_robot: StartRobot, client: Client
) -> None:
    foreign = start_robot(*options)
    changes: dict[str, Any] = {}
    if "joint_states:=wheels" in options:
        changes = {"ros2": {"feedback": "joint_states"}}
    with pytest.raises(LinkError, match=said) as raised:
        open_robot(namespace, connect_timeout=2.0, **changes).activate()
    assert is_one_line(raised.value)
    client.spin(0.1)
    assert not turned(foreign)


def test_nobody_there(namespace: str, client: Client) -> None:
    with pytest.raises(LinkError, match="no node subscribes") as raised:
        open_robot(namespace, connect_timeout=1.0).activate()
    assert is_one_line(raised.value)


def test_a_second_commander_is_told_at_the_opening_and_stops_the_drive(
    namespace: str, start_robot: StartRobot, client: Client
) -> None:
    foreign = start_robot("--cmd-vel-timeout", 0.5)
    publisher = client.publisher(TwistStamped, "cmd_vel")
    robot = open_robot(namespace)
    with pytest.warns(SafetyWarning, match="others publish"):
        robot.activate()
    drive(robot, 0.1, 0.0, 0.3)
    command = TwistStamped()
    command.twist.linear.x = 0.4
    publisher.publish(command)
    with pytest.raises(LinkError, match="/client") as raised:
        drive(robot, 0.1, 0.0, 2.0)
    assert is_one_line(raised.value)
    client.wait(foreign.stands, "standing wheels")
    assert not any(foreign.commands[-1]["command"])


ENDS = (signal.SIGKILL, signal.SIGSTOP, signal.SIGTERM, signal.SIGINT)
DRIVER = """
import sys
from acsar_gym import Robot, RobotConfig, open_link

config = RobotConfig.load(sys.argv[2])
with Robot(open_link(sys.argv[1], config), config) as robot:
    while True:
        robot.drive(0.2, 0.0)
"""


@pytest.mark.parametrize(
    ("name", "number"),
    [
        *(("plain", number) for number in ENDS),
        *((name, signal.SIGKILL) for name in ("twist", "speeds of two wheels", "simulated time")),
    ],
)
def test_the_wheels_stand_soon_after_the_program(
    name: str,
    number: signal.Signals,
    namespace: str,
    start_robot: StartRobot,
    start_program: StartProgram,
    client: Client,
    tmp_path: Path,
) -> None:
    variant = VARIANTS[name]
    foreign = start_robot("--cmd-vel-timeout", 20.0, *variant.options)
    file = tmp_path / "robot.yaml"
    make_config(variant, watchdog_timeout=0.15).save(file)
    program = start_program("-c", DRIVER, f"ros2:{namespace}", file)
    client.wait(lambda: turned(foreign), "turning wheels")
    client.spin(0.3)
    begun = time.monotonic()
    program.send(number)
    client.wait(foreign.stands, "standing wheels")
    # 0.15 s of the watchdog, and five time constants of the wheels; a busy machine adds to it.
    assert foreign.stood_at() - begun < 0.4 + 0.6
    assert not [command for command in foreign.commands if "refused" in command]


def test_it_opens_again(namespace: str, start_robot: StartRobot, client: Client) -> None:
    foreign = start_robot()
    robot = open_robot(namespace)
    for _ in range(3):
        with robot:
            assert robot.odometry.pose == (0.0, 0.0, 0.0)
            drive(robot, 0.2, 0.0, 0.2)
            assert robot.odometry.pose[0] > 0.005
        assert not any(foreign.commands[-1]["command"])
