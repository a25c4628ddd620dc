"""Whatever holds a program up or ends it, a zero command reaches the board soon."""

from __future__ import annotations

import math
import signal
import time

import psutil
import pytest
from nursery import ended, first_line, program
from serial_tools import BRIDGE, DRIVER, Emulated, wait_until
from watchdog_tools import HASTY

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.links import ports
from acsar_gym.links.serial import SerialLink
from acsar_gym.links.watchdog_child import ZERO_INTERVAL
from acsar_gym.protocol import ZERO, Decoder

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

WATCHED = (
    DRIVER
    + f"""
config = config.with_(watchdog_timeout={HASTY})
robot = Robot(open_link(sys.argv[1], config), config)
"""
)

DRIVE = "robot.activate(); drive(10**9)"


def commands(emulator: Emulated) -> list[tuple[float, bool]]:
    """When each command arrived, and whether it turns wheels."""
    decoder = Decoder()
    return [
        (float(event["t"]), reading.speeds != ZERO)
        for event in emulator.events()
        for reading in decoder.feed(event.get("rx", "").encode("latin-1"))
    ]


def assert_stopped_after(emulator: Emulated, fault: float) -> None:
    """A zero command came after the fault, and nothing turned wheels after it."""
    wait_until(emulator.is_stopped, "zero as the last command")
    driving = [drives for stamp, drives in commands(emulator) if stamp >= fault]
    assert not any(driving[driving.index(False) :])


def drives(emulator: Emulated) -> None:
    wait_until(emulator.is_driven, "a command that turns the wheels")


def test_a_suspended_program_does_not_drive_on_by_itself(emulator: Emulated) -> None:
    with program(WATCHED + DRIVE, emulator.device) as process:
        drives(emulator)
        fault = time.monotonic()
        process.send_signal(signal.SIGSTOP)
        assert_stopped_after(emulator, fault)
        process.send_signal(signal.SIGCONT)
        status, error = ended(process)
    assert status == 1
    assert "the watchdog stopped the robot: nothing was commanded for" in error
    assert "find what held the program up, then reset" in error
    assert_stopped_after(emulator, fault)


def test_a_program_suspended_at_standstill_drives_on(emulator: Emulated) -> None:
    """Its zeros are repeated meanwhile: the wire may have swallowed the last one."""
    code = """
import time
robot.activate()
for _ in range(30):
    robot.drive(0.0, 0.0)
goes_on = []
signal.signal(signal.SIGCONT, lambda *_: goes_on.append(True))
print("stands", flush=True)
while not goes_on:
    time.sleep(0.01)
drive(10**9)
"""
    with program(WATCHED + code, emulator.device) as process:
        assert first_line(process) == "stands"
        process.send_signal(signal.SIGSTOP)
        said = len(emulator.commands())
        more = math.ceil(2 * HASTY / ZERO_INTERVAL)
        wait_until(lambda: len(emulator.commands()) > said + more, "repeated zeros")
        assert set(emulator.commands()) == {ZERO}
        process.send_signal(signal.SIGCONT)
        drives(emulator)


def test_a_policy_that_hangs_is_told_so(emulator: Emulated) -> None:
    code = """
import time
robot.activate()
drive(30)
while not robot.link._watch.watchdog.tripped:
    time.sleep(0.01)
drive(1)
"""
    with program(WATCHED + code, emulator.device) as process:
        status, error = ended(process)
    assert status == 1
    assert "LinkError: the watchdog stopped the robot" in error
    wait_until(emulator.is_stopped, "zero as the last command")


STRAY = """
import subprocess
robot.activate()
lifeline = robot.link._watch.watchdog._lifeline
stray = subprocess.Popen(["sleep", "60"], pass_fds=(lifeline,), stdout=subprocess.DEVNULL,
                         stderr=subprocess.DEVNULL)
drive(30)
print(stray.pid, flush=True)
drive(10**9)
"""


def test_a_stray_copy_of_the_lifeline_only_delays_the_zero(
    emulator: Emulated, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ports, "BUSY_TIMEOUT", config.connect_timeout)
    with program(WATCHED + STRAY, emulator.device) as process:
        stray = psutil.Process(int(first_line(process)))
        drives(emulator)
        fault = time.monotonic()
        process.kill()
        assert_stopped_after(emulator, fault)
        assert ended(process)[0] == -signal.SIGKILL
        with Robot(open_link(emulator.device, config), config) as robot:
            assert robot.active
        stray.kill()


def test_a_program_behind_a_socket_is_watched_too(emulator: Emulated) -> None:
    with program(BRIDGE, emulator.device) as bridge:
        url = f"socket://127.0.0.1:{first_line(bridge)}"
        with program(DRIVER + DRIVE, url) as process:
            drives(emulator)
            fault = time.monotonic()
            process.kill()
            assert_stopped_after(emulator, fault)


def test_the_port_is_soon_free_after_a_kill(
    emulator: Emulated, config: RobotConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One `open` is enough."""
    monkeypatch.setattr(ports, "BUSY_TIMEOUT", config.connect_timeout)
    with program(DRIVER + DRIVE, emulator.device) as process:
        drives(emulator)
        process.kill()
        link = SerialLink(emulator.device, config)
        link.open()
        link.close()
