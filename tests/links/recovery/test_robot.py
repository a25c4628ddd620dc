"""A robot whose cable is pulled while it drives."""

from __future__ import annotations

import time

import pytest
from nursery import program
from recovery_tools import name, spoken
from serial_tools import (
    TIMEOUT,
    Emulated,
    no_leak,
    wait_until,
)

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import (
    LinkLostError,
)
from acsar_gym.protocol import ZERO

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]


def drive_until_error(robot: Robot) -> None:
    for _ in range(int(TIMEOUT / robot.config.period)):
        robot.drive(0.2, 0.0)


def poses(emulator: Emulated, since: float) -> list[tuple[float, float]]:
    events = [event for event in emulator.events() if "pose" in event and event["t"] > since]
    return [(event["pose"][0], event["pose"][1]) for event in events]


def assert_stands(emulator: Emulated, since: float) -> None:
    """Nothing has moved the robot since then, nor for the next moments."""
    wait_until(lambda: len(poses(emulator, since)) > 30, "poses")
    x, y = zip(*poses(emulator, since), strict=True)
    assert max(x) - min(x) < 1e-4
    assert max(y) - min(y) < 1e-4


def test_the_same_robot_drives_on_once_the_cable_is_back(
    emulator: Emulated, config: RobotConfig
) -> None:
    before = emulator.device
    robot = Robot(open_link(name(emulator), config), config)
    with no_leak():
        robot.activate()
        drive = robot.wheel_speeds(0.2, 0.0)
        for _ in range(20):
            robot.tick(drive)
        emulator.pull()
        with pytest.raises(LinkLostError) as caught:
            drive_until_error(robot)
        assert name(emulator) in caught.value.found
        assert "\n" not in str(caught.value)
        assert not robot.active
        wait_until(lambda: emulator.stands(loops=20), "wheels that stand")
        emulator.plug()
        assert emulator.device != before
        assert_stands(emulator, since=time.monotonic())
        assert spoken(emulator) <= {ZERO}
        robot.activate()
        assert spoken(emulator) <= {ZERO}
        assert robot.odometry.pose == (0.0, 0.0, 0.0)
        while robot.odometry.pose[0] < 0.01:
            robot.drive(0.2, 0.0)
        robot.close()
    wait_until(lambda: emulator.commands()[-1] == ZERO, "zero as the last command")


def test_it_waits_for_the_cable(emulator: Emulated, config: RobotConfig) -> None:
    """Activation begins while the cable is out; somebody plugs it in meanwhile."""
    code = f"""
import os, signal, time
time.sleep(0.5)
os.kill({emulator.process.pid}, signal.SIGUSR2)
"""
    robot = Robot(open_link(name(emulator), config), config)
    robot.activate()
    emulator.pull()
    with pytest.raises(LinkLostError):
        drive_until_error(robot)
    with program(code) as helper:
        robot.activate()
        helper.wait(TIMEOUT)
    emulator.device = emulator.devices()[-1]
    robot.drive(0.2, 0.0)
    robot.deactivate()


def test_pulled_again_and_again_it_recovers(emulator: Emulated, config: RobotConfig) -> None:
    robot = Robot(open_link(name(emulator), config), config)
    with no_leak():
        for _ in range(3):
            with robot:
                robot.drive(0.2, 0.0)
                emulator.pull()
                with pytest.raises(LinkLostError):
                    drive_until_error(robot)
            emulator.plug()
    assert len(emulator.devices()) == 6
