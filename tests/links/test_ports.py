"""Names of adapters: which device they mean now, and under which one comes back."""

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
from acsar_gym.errors import ConfigError, LinkError, LinkLostError, PortNotFoundError
from acsar_gym.links import ports
from acsar_gym.links.ports import PortInfo, find_lasting_name, locate_port
from acsar_gym.links.serial import SerialLink

pytestmark = pytest.mark.usefixtures("deadline")

Plugged = list[PortInfo]


@pytest.fixture
def device() -> Iterator[str]:
    """A terminal with nobody at its other end."""
    descriptors = os.openpty()
    yield os.ttyname(descriptors[1])
    for descriptor in descriptors:
        os.close(descriptor)


@pytest.fixture
def adapter(device: str, plugged: Plugged) -> str:
    """The same terminal as an adapter with a serial number of its own."""
    plugged += [PortInfo("/dev/null", "other"), PortInfo(device, "board", "A50285BI")]
    return device


@pytest.fixture
def by_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What stands for /dev/serial/by-id."""
    folder = tmp_path / "by-id"
    folder.mkdir()
    monkeypatch.setattr(ports, "BY_ID_FOLDER", folder)
    return folder


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> Plugged:
    """The ports that this computer seems to have: none, until a test adds some."""
    here: Plugged = []
    monkeypatch.setattr(ports, "find_ports", lambda: here)
    return here


def drive_until_lost(robot: Robot) -> LinkError:
    with pytest.raises(LinkLostError) as caught:
        for _ in range(int(TIMEOUT / robot.config.period)):
            robot.drive(0.2, 0.0)
    return caught.value


@pytest.mark.parametrize("relative", [False, True], ids=["absolute", "as udev makes them"])
def test_an_adapter_comes_back_under_its_own_name(
    relative: bool, adapter: str, by_id: Path
) -> None:
    (by_id / "usb-A").symlink_to("/dev/null")
    (by_id / "usb-B").symlink_to(os.path.relpath(adapter, by_id) if relative else adapter)
    assert find_lasting_name(adapter) == str(by_id / "usb-B")


def test_a_serial_number_means_the_one_adapter_that_has_it(adapter: str, plugged: Plugged) -> None:
    assert locate_port("usb:A50285BI") == adapter
    plugged += [PortInfo(f"/dev/ttyUSB{number}", "board", "0001") for number in range(2)]
    with pytest.raises(ConfigError, match="/dev/ttyUSB0, /dev/ttyUSB1"):
        locate_port("usb:0001")


@pytest.mark.parametrize(
    ("numbers", "told"),
    [((), "none"), ((None,), "none"), (("B1", None, "C2"), "B1, C2"), (("A5028",), "A5028")],
)
def test_a_serial_number_that_is_not_here_tells_those_that_are(
    numbers: tuple[str | None, ...], told: str, plugged: Plugged
) -> None:
    plugged += [PortInfo("/dev/null", "other", number) for number in numbers]
    with pytest.raises(PortNotFoundError) as caught:
        locate_port("usb:A50285BI")
    assert "usb:A50285BI" in caught.value.found
    assert caught.value.fix.endswith(f": {told}")


def test_a_device_is_followed_by_its_adapter_s_name(
    start_emulator: StartEmulator, config: RobotConfig, by_id: Path, plugged: Plugged
) -> None:
    emulator = start_emulator("--name", str(by_id / "usb-acsar"))
    before = emulator.device
    plugged.append(PortInfo(before, "board", "A50285BI"))
    robot = Robot(open_link(before, config.with_(reconnect_timeout=TIMEOUT)), config)
    robot.activate()
    with os.fdopen(os.open(before, os.O_RDWR | os.O_NOCTTY), "rb", 0):
        emulator.pull()
        assert before in drive_until_lost(robot).found
        emulator.plug()
        assert emulator.device != before
        plugged[:] = [PortInfo(emulator.device, "board", "A50285BI")]
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


def test_a_port_that_the_watchdog_writes_to_as_well_is_not_lost() -> None:
    """The kernel refuses a write that doesn't wait while another one is under way."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    os.set_blocking(theirs, False)
    command = [sys.executable, "-c", ANOTHER_WRITER, str(theirs), str(os.getpid())]
    port = SimpleNamespace(fd=theirs)
    with subprocess.Popen(command, pass_fds=(theirs,)) as writer:
        assert os.read(ours, 35) == b"x" * 35
        for _ in range(500):
            ports.write_all(port, b"y" * 35)
            while select.select([ours], [], [], 0.0)[0]:
                os.read(ours, 4096)
        writer.kill()
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize("url", ["rfc2217://127.0.0.1:4000", "RFC2217://robot:4000", "loop://"])
def test_a_url_that_no_watchdog_can_share_is_refused(url: str, config: RobotConfig) -> None:
    robot = Robot(SerialLink(url, config), config)
    with pytest.raises(ConfigError, match="socket://host:port"):
        robot.activate()
    assert not robot.active


@pytest.mark.parametrize("name", ["/dev/null", "file"])
def test_what_is_no_serial_port_is_one_line_with_those_that_are(
    name: str, config: RobotConfig, adapter: str, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    device = str(tmp_path / name)  # /dev/null is absolute and stays
    with pytest.raises(LinkError, match=f"^{device}: isn't a serial port: .*{adapter}"):
        ports.open_port(device, config.baud_rate)
