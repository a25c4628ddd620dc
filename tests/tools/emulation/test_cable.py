"""A pseudo-terminal that is pulled and plugged in again, and its lasting name."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import first_line, program
from serial_tools import TIMEOUT, no_leak

from acsar_gym.errors import ConfigError
from acsar_gym.tools.emulation.cable import EmulatedCable

BAUD_RATE = 115200
LINE = b"ap00.00"


@pytest.fixture
def name(tmp_path: Path) -> Path:
    return tmp_path / "usb-acsar"


@pytest.fixture
def cable(name: Path) -> Iterator[EmulatedCable]:
    with no_leak():
        cable = EmulatedCable(BAUD_RATE, name)
        yield cable
        cable.pull()
    assert not name.is_symlink()


@contextlib.contextmanager
def client(device: str) -> Iterator[int]:
    descriptor = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def read_soon(descriptor: int) -> bytes:
    assert select.select([descriptor], [], [], TIMEOUT)[0], "nothing arrives"
    return os.read(descriptor, 4096)


def test_pull_and_plug_make_a_new_device_of_the_name(cable: EmulatedCable, name: Path) -> None:
    old_device = cable.device
    with client(old_device) as port:  # keeps the old name from being used again
        os.write(port, b"old")
        cable.pull()
        assert cable.device == ""
        assert not name.is_symlink()
        with pytest.raises(OSError, match="Input/output"):
            os.write(port, b"x")

        cable.plug()
        assert cable.device not in ("", old_device)
        assert str(name.readlink()) == cable.device
        assert cable.read() == b"", "bytes that were sent before the pull are gone"
        with client(cable.device) as new_port:
            cable.write(b"new")
            assert read_soon(new_port) == b"new"


@pytest.mark.parametrize("rate", [termios.B57600, termios.B115200])
def test_over_uart_needs_equal_baud_rates(rate: int, cable: EmulatedCable) -> None:
    assert cable.over_uart(LINE) == LINE
    with client(cable.device) as port:
        attributes = termios.tcgetattr(port)
        attributes[4] = attributes[5] = rate
        termios.tcsetattr(port, termios.TCSANOW, attributes)
    assert (cable.over_uart(LINE) == LINE) == (rate == termios.B115200)
    cable.pull()
    cable.plug()
    assert cable.over_uart(LINE) == LINE  # the next client finds the board's own rate again


@pytest.mark.parametrize(
    ("kept", "message"),
    [
        ("file", "exists and isn't a symbolic link: name another"),
        ("missing/name", "can't be a symbolic link: "),
        ("usb-acsar", r"usb-acsar: is the name of /dev/pts/\d+"),
    ],
)
def test_cable_destroys_no_file_of_its_name(
    kept: str, message: str, tmp_path: Path, cable: EmulatedCable, name: Path
) -> None:
    (tmp_path / "file").write_text("mine")
    with no_leak(), pytest.raises(ConfigError, match=message):
        EmulatedCable(BAUD_RATE, tmp_path / kept)
    assert (tmp_path / "file").read_text() == "mine"
    assert str(name.readlink()) == cable.device


IGNORING = """
import signal
from acsar_gym.tools.cli import main
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as shells do for `acsar-gym emulate &` in a script
main()
"""


@pytest.mark.usefixtures("deadline")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_emulate_ends_by_a_signal_in_the_background(
    number: signal.Signals, code: int, name: Path
) -> None:
    with program(IGNORING, "emulate", "--name", str(name)) as process:
        assert first_line(process).startswith("serving a robot on ")
        process.send_signal(number)
        assert process.wait(TIMEOUT) == code
    assert not name.is_symlink()
