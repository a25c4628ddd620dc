"""Names of serial adapters, ports that can't be opened, and a port that two processes write to."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from serial_tools import TIMEOUT, StartEmulator

from acsar_gym import Robot, RobotConfig, open_link
from acsar_gym.errors import ConfigError, LinkError, LinkLostError
from acsar_gym.links import ports
from acsar_gym.links.ports import find_lasting_name, locate_port

pytestmark = pytest.mark.usefixtures("deadline")

Plugged = list[SimpleNamespace]


def port(device: str, serial_number: str | None = None) -> SimpleNamespace:
    """A serial device, as pyserial describes it."""
    return SimpleNamespace(device=device, serial_number=serial_number)


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> Plugged:
    """The ports that this computer seems to have: none, until a test adds some."""
    infos: Plugged = []
    monkeypatch.setattr(ports, "find_ports", lambda: infos)
    return infos


@pytest.fixture
def adapter(plugged: Plugged) -> Iterator[str]:
    """A pseudo-terminal that seems to be an adapter with a serial number."""
    descriptors = os.openpty()
    device = os.ttyname(descriptors[1])
    plugged += [port("/dev/null"), port(device, "A50285BI")]
    yield device
    for descriptor in descriptors:
        os.close(descriptor)


@pytest.fixture
def by_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder that is /dev/serial/by-id in a test."""
    folder = tmp_path / "by-id"
    folder.mkdir()
    monkeypatch.setattr(ports, "BY_ID_FOLDER", folder)
    return folder


def test_find_lasting_name_is_the_link_to_the_adapter(adapter: str, by_id: Path) -> None:
    (by_id / "usb-A").symlink_to("/dev/null")
    (by_id / "usb-B").symlink_to(os.path.relpath(adapter, by_id))  # as udev makes them
    assert find_lasting_name(adapter) == str(by_id / "usb-B")


def test_locate_port_finds_the_adapter_with_a_serial_number(adapter: str, plugged: Plugged) -> None:
    assert locate_port("usb:A50285BI") == adapter
    plugged += [port("/dev/ttyUSB0", "0001"), port("/dev/ttyUSB1", "0001")]
    with pytest.raises(ConfigError, match="/dev/ttyUSB0, /dev/ttyUSB1"):
        locate_port("usb:0001")
    with pytest.raises(LinkError, match=r"^usb:B1: .*: A50285BI, 0001, 0001$"):
        locate_port("usb:B1")


def test_lost_device_is_found_under_its_lasting_name(
    start_emulator: StartEmulator, config: RobotConfig, by_id: Path, plugged: Plugged
) -> None:
    emulator = start_emulator("--name", str(by_id / "usb-acsar"))
    old_device = emulator.device
    plugged.append(port(old_device, "A50285BI"))
    robot = Robot(open_link(old_device, config.with_(reconnect_timeout=TIMEOUT)), config)
    robot.activate()

    with Path(old_device).open("rb"):  # it isn't used again
        emulator.pull()
        with pytest.raises(LinkLostError, match=old_device):
            for _ in range(int(TIMEOUT / config.period)):
                robot.drive(0.2, 0.0)
        emulator.plug()
        assert emulator.device != old_device
        plugged[:] = [port(emulator.device, "A50285BI")]
        with robot:
            robot.drive(0.2, 0.0)


ANOTHER_WRITER = """
import os, sys, time

while os.getppid() == int(sys.argv[2]):
    try:
        os.write(int(sys.argv[1]), b"x" * 35)
    except BlockingIOError:
        pass
    time.sleep(0.00002)
"""


def test_port_that_the_watchdog_also_writes_to_is_not_lost() -> None:
    """The kernel refuses a write that doesn't wait while another write is under way."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(slave, False)
    command = [sys.executable, "-c", ANOTHER_WRITER, str(slave), str(os.getpid())]
    with subprocess.Popen(command, pass_fds=(slave,)) as writer:
        assert os.read(master, 35) == b"x" * 35
        for _ in range(500):
            ports.write_all(SimpleNamespace(fd=slave), b"y" * 35)
            while select.select([master], [], [], 0.0)[0]:
                os.read(master, 4096)
        writer.kill()
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("/dev/null", "^/dev/null: isn't a serial port: .*"),
        ("rfc2217://127.0.0.1:4000", "use socket://host:port"),
        ("socket://127.0.0.1", r"must be like socket://.* \(host and port\)"),
    ],
)
def test_open_port_refuses_other_devices(device: str, message: str, adapter: str) -> None:
    with pytest.raises((LinkError, ConfigError), match=message) as caught:
        ports.open_port(device, 9600)
    assert device != "/dev/null" or adapter in str(caught.value)
