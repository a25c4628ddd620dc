"""Bad input on the serial side: one clear error each, nothing hangs, no descriptor stays open."""

from __future__ import annotations

import time

import pytest
from processes import first_line, program
from serial_tools import (
    DRIVER,
    TIMEOUT,
    RobotFile,
    StartEmulator,
    no_leak,
    wait_until,
)

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import BoardGarbledError, BoardSilentError, LinkError, PortBusyError
from acsar_gym.links import ports
from acsar_gym.protocol import ZERO
from acsar_gym.worlds import Scene

pytestmark = pytest.mark.usefixtures("deadline")

NOBODY = 65534


def check_refusal(
    device: str, config: RobotConfig, kind: type[LinkError] = LinkError, found: str = ""
) -> None:
    """Activate a robot on a bad device, which leaves nothing open behind it."""
    robot = Robot(open_link(device, config), config)
    with no_leak():
        with pytest.raises(kind, match=f"{device}.*{found}.*: ") as caught:
            robot.activate()
        robot.close()
    assert type(caught.value) is kind
    assert caught.value.exit_code == 3
    assert "\n" not in str(caught.value)
    assert not robot.active
    with pytest.raises(LinkError, match="closed"):
        robot.link.write(b"")


def test_serial_device_that_is_missing(config: RobotConfig) -> None:
    check_refusal("/dev/acsar-missing", config, found="no such device")


PERMISSION = f"""
import os, sys
from acsar_gym import Robot, RobotConfig, open_link

master, slave = os.openpty()
device = os.ttyname(slave)
robot = Robot(open_link(device, RobotConfig.preset("acsar")))
if os.getuid() == 0:
    os.chmod(device, 0o600)
    os.setgroups([])
    os.setegid({NOBODY})
    os.seteuid({NOBODY})
else:
    os.chmod(device, 0)
before = len(os.listdir("/proc/self/fd"))
try:
    robot.activate()
except Exception as error:
    print(type(error).__name__, "-", error)
sys.exit(len(os.listdir("/proc/self/fd")) != before)
"""


def test_serial_permission_error_names_the_group() -> None:
    with program(PERMISSION) as process:
        out, err = process.communicate(timeout=TIMEOUT)
    assert out.startswith("LinkError - /dev/pts/"), err
    assert "dialout" in out
    assert out.count("\n") == 1
    assert process.returncode == 0, "a descriptor was left open"


def test_serial_device_busy_with_another_robot_program(
    config: RobotConfig, shared_device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    code = DRIVER + "robot.activate(); print('ready', flush=True); drive(10**9)"
    with program(code, shared_device) as process:
        assert first_line(process) == "ready"
        check_refusal(shared_device, config, PortBusyError)
    monkeypatch.setattr(ports, "BUSY_TIMEOUT", TIMEOUT)
    with Robot(open_link(shared_device, config), config) as robot:
        assert robot.active


def test_serial_board_that_is_silent(config: RobotConfig, start_emulator: StartEmulator) -> None:
    silent = start_emulator("--silent")
    hasty = config.with_(connect_timeout=0.3)
    check_refusal(silent.device, hasty, BoardSilentError, "no byte")
    wait_until(lambda: set(silent.commands()) == {ZERO}, "nothing but zero commands")


def test_serial_baud_rate_that_is_wrong(config: RobotConfig, shared_device: str) -> None:
    wrong = config.with_(baud_rate=57600, connect_timeout=2.0)
    check_refusal(shared_device, wrong, BoardGarbledError, "57600.*115200")


def test_serial_lateness_of_a_tick(config: RobotConfig, shared_device: str) -> None:
    with Robot(open_link(shared_device, config), config) as robot:
        link = robot.link
        time.sleep(0.1)
        robot.drive(0.0, 0.0)
        assert (link.lateness or 0.0) >= 0.08
        start = link.now()
        for _ in range(10):
            robot.drive(0.0, 0.0)
        assert link.now() - start >= 9 * config.period
        link.reset(Scene())
        assert link.lateness == 0.0


def test_serial_feedback_slower_than_the_tick_is_held_and_aged(
    config: RobotConfig, start_emulator: StartEmulator, robot_file: RobotFile
) -> None:
    """A board that is frozen says nothing for as long as it takes, however fast it is otherwise."""
    slow = start_emulator("--robot", str(robot_file(firmware={"feedback_rate": 20.0})))
    with Robot(open_link(slow.device, config), config) as robot:
        for _ in range(2):
            robot.drive(0.2, 0.0)
            while robot.feedback_age > 0.0:
                robot.drive(0.2, 0.0)

            slow.pause()
            held = 0
            while held <= 5:
                speeds = robot.speeds
                age = robot.feedback_age
                robot.drive(0.2, 0.0)
                held = held + 1 if robot.feedback_age > age and robot.speeds == speeds else 0
            slow.resume()
