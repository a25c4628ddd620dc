"""Robots stop however a process ends: some trials of `make ros-stopping`, and what is left."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import psutil
import pytest
import ros_stopping
from geometry_msgs.msg import TwistStamped
from ros_stopping import KINDS
from ros_tools import Client, ForeignRobot, Program, StartProgram
from sensor_msgs.msg import JointState
from serial_tools import HEEDING_CTRL_C

from acsar_gym import RobotConfig
from acsar_gym.testing import emulated_board

TRIALS = 1
ROUNDS = 3
"""Most measurements. A machine that stalls makes a robot look slow, and it is measured again."""
INTERRUPTS = 100
GROUPS = sorted({(kind.victim, kind.robot) for kind in KINDS})


@pytest.mark.parametrize(("victim", "robot"), GROUPS)
def test_wheels_stop_in_time(victim: str, robot: str) -> None:
    kinds = [kind for kind in KINDS if (kind.victim, kind.robot) == (victim, robot)]
    for _ in range(ROUNDS):
        measured = zip(kinds, ros_stopping.measure(TRIALS, kinds), strict=True)
        kinds = [kind for kind, stops in measured if not stops.is_sound]
    assert not kinds


def test_ctrl_c_is_never_lost() -> None:
    assert ros_stopping.count_interrupts(INTERRUPTS) == INTERRUPTS


def children(program: Program) -> list[psutil.Process]:
    """All processes that it has started."""
    return psutil.Process(program.process.pid).children(recursive=True)


@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGTERM, -signal.SIGTERM), (signal.SIGINT, 130)]
)
def test_driver_ends_without_a_trace(
    number: signal.Signals,
    code: int,
    client: Client,
    namespace: str,
    start_program: StartProgram,
    tmp_path: Path,
) -> None:
    file = tmp_path / "robot.yaml"
    config = RobotConfig.preset("acsar").with_(connect_timeout=20.0, feedback_timeout=5.0)
    config.save(file)

    node = ("acsar_driver", namespace)
    with emulated_board(config) as board:
        options = ("--robot", file, "--namespace", namespace, "--link", board.device)
        driver = start_program("-c", HEEDING_CTRL_C, "ros", "driver", *options)
        joints = client.hear(JointState, "joint_states")
        client.wait(lambda: bool(joints.messages), "the driver")
        publisher = client.publisher(TwistStamped, "cmd_vel")
        command = TwistStamped()
        command.twist.linear.x = 0.2
        publisher.publish(command)
        client.wait(board.is_driven, "a robot that drives")
        watchdogs = children(driver)
        assert driver.end(number) == code
        assert board.is_stopped()
        assert not psutil.wait_procs(watchdogs, 3.0)[1]
        # Others see at once that it is gone, and a new driver isn't the second of its name.
        client.wait(lambda: node not in client.node.get_node_names_and_namespaces(), "its end", 3.0)
    first, *lines = filter(None, driver.printed.splitlines())
    assert "drives" in first
    message = "acsar-gym: interrupted, the wheels were commanded to stop"
    assert lines == ([message] if number == signal.SIGINT else [])


def test_watchdog_stops_only_its_own_robot(
    client: Client, start_program: StartProgram, foreign_config: RobotConfig, tmp_path: Path
) -> None:
    robots = []
    drivers = []
    for name in ("one", "other"):
        folder = tmp_path / name
        folder.mkdir()
        robot = ForeignRobot(folder, namespace=f"/{name}")
        client.programs.append(robot)
        robots.append(robot)
        file = folder / "robot.yaml"
        foreign_config.save(file)
        code = ros_stopping.DRIVING.replace('"ros2"', f'"ros2:/{name}"')
        drivers.append(start_program("-c", code, file, "", 50))
    client.wait(lambda: all(driver.printed for driver in drivers), "programs that drive")
    watchdogs = children(drivers[0])
    assert watchdogs

    os.kill(drivers[0].process.pid, signal.SIGKILL)
    killed = time.monotonic()
    client.spin(2.0)
    assert not psutil.wait_procs(watchdogs, 3.0)[1]
    assert drivers[1].process.poll() is None
    assert not any(robots[0].commands[-1]["command"])
    later = [command for command in robots[1].commands if command["monotonic"] > killed]
    assert len(later) > 50
    assert all(any(command["command"]) for command in later)
    assert drivers[1].end() == -signal.SIGTERM
    assert not any(robots[1].commands[-1]["command"])
    assert len(drivers[1].printed.splitlines()) == 1
