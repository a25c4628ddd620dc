"""A cable that stays out, and whatever looks for a lost port."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from nursery import first_line, program
from recovery_tools import CURVE, drives, made, name, spoken, step_until_fault
from serial_tools import (
    DRIVER,
    TIMEOUT,
    Emulated,
    no_leak,
    wait_until,
)

from acsar_gym import RobotConfig
from acsar_gym.errors import (
    LinkLostError,
    PortNotFoundError,
)
from acsar_gym.links import ports, watchdog
from acsar_gym.links.serial import SerialLink
from acsar_gym.protocol import ZERO, encode
from acsar_gym.worlds import Scene

pytestmark = [
    pytest.mark.usefixtures("deadline", "nursery"),
    pytest.mark.xdist_group("serial"),
]

ZEROS = b"\r\n" + encode(ZERO)

LONG = 3600.0


def runs(process: int) -> bool:
    """Whether it is there and no zombie."""
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def ends(process: int) -> None:
    wait_until(lambda: not runs(process), "a process that ends")


def test_a_cable_that_stays_out_is_reported_in_time(plugged: Emulated, config: RobotConfig) -> None:
    env = made(plugged, config.with_(reconnect_timeout=0.4))
    with no_leak():
        env.reset(seed=0)
        plugged.pull()
        step_until_fault(env)
        for _ in range(2):
            begin = time.monotonic()
            with pytest.raises(PortNotFoundError) as caught:
                env.reset()
            assert time.monotonic() - begin >= 0.3
            assert "no such device" in caught.value.found
            assert "\n" not in str(caught.value)
        plugged.plug()
        env.reset()
        env.step(CURVE)
        env.close()


@pytest.fixture
def tries(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names under which ports were opened, or weren't."""
    names: list[str] = []
    opened = ports.open_port

    def counted(device: str, config: RobotConfig) -> Any:
        names.append(device)
        return opened(device, config)

    monkeypatch.setattr(ports, "open_port", counted)
    return names


def test_a_port_that_was_never_there_is_reported_at_once(
    config: RobotConfig, tmp_path: Path, tries: list[str]
) -> None:
    missing = str(tmp_path / "missing")
    link = SerialLink(missing, config.with_(reconnect_timeout=LONG))
    for _ in range(2):
        with no_leak(), pytest.raises(PortNotFoundError):
            link.open()
    assert tries == [missing] * 2


def test_without_patience_a_lost_port_is_tried_once(
    plugged: Emulated, config: RobotConfig, tries: list[str]
) -> None:
    link = SerialLink(name(plugged), config.with_(reconnect_timeout=0.0))
    link.open()
    plugged.pull()
    with pytest.raises(LinkLostError):
        link.reset(Scene())
    link.close()
    tries.clear()
    with pytest.raises(PortNotFoundError):
        link.open()
    assert len(tries) == 1
    plugged.plug()
    link.open()
    link.close()


END = """
robot.activate()
print(robot.link.watchdog.pid, flush=True)
drive(10**9)
"""


def lose(emulator: Emulated, device: str) -> int:
    """Pull the cable of a program that drives, and so ends; the process of its watchdog."""
    with program(DRIVER + END, device) as process:
        dog = int(first_line(process))
        drives(emulator)
        emulator.pull()
        _, error = process.communicate(timeout=TIMEOUT)
    assert "LinkLostError" in error
    return dog


def test_a_program_that_has_ended_still_stops_the_robot(emulator: Emulated) -> None:
    dog = lose(emulator, name(emulator))
    assert runs(dog)
    emulator.plug()
    wait_until(lambda: emulator.since_plugged().count(ZEROS) >= 7, "seven zero commands")
    ends(dog)
    assert not emulator.since_plugged().replace(ZEROS, b"")


def test_without_a_lasting_name_nothing_is_looked_for(emulator: Emulated) -> None:
    """Another adapter may be /dev/ttyUSB0 next."""
    ends(lose(emulator, emulator.device))
    emulator.plug()
    time.sleep(0.2)
    assert emulator.since_plugged() == b""


def test_whoever_has_the_port_then_is_not_disturbed(emulator: Emulated) -> None:
    dog = psutil.Process(lose(emulator, name(emulator)))
    dog.suspend()
    emulator.plug()
    port = os.open(emulator.device, os.O_RDWR | os.O_NOCTTY)
    fcntl.flock(port, fcntl.LOCK_EX)
    dog.resume()
    ends(dog.pid)
    time.sleep(0.1)
    assert emulator.since_plugged() == b""
    os.close(port)


def test_another_link_to_the_port_calls_the_search_back(
    plugged: Emulated, config: RobotConfig
) -> None:
    lost, other = (SerialLink(name(plugged), config) for _ in range(2))
    lost.open()
    plugged.pull()
    lost.close()
    (dog,) = watchdog.list_searches().values()
    assert runs(dog)
    plugged.plug()
    other.open()
    assert not runs(dog)
    other.close()


def test_called_back_nobody_looks_any_more(link: SerialLink, plugged: Emulated) -> None:
    plugged.pull()
    link.close()
    ((place, dog),) = watchdog.list_searches().items()
    assert place == name(plugged)
    watchdog.end_searches("another")
    assert runs(dog)
    watchdog.end_searches(place)
    assert not psutil.pid_exists(dog)  # no zombie either
    watchdog.end_searches(place)
    plugged.plug()
    time.sleep(0.2)
    assert plugged.since_plugged() == b""


def test_the_search_goes_on_while_the_cable_stays_out(
    emulator: Emulated, config: RobotConfig
) -> None:
    """A program may give up; the robot is stopped as soon as somebody plugs it in."""
    env = made(emulator, config.with_(reconnect_timeout=0.1))
    env.reset(seed=0)
    emulator.pull()
    step_until_fault(env)
    with pytest.raises(PortNotFoundError):
        env.reset()
    env.close()
    emulator.plug()
    wait_until(lambda: bool(spoken(emulator)), "a command")
    assert spoken(emulator) == {ZERO}
