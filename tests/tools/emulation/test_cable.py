"""A pseudo-terminal that is pulled and plugged in again, and its lasting name."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import signal
import termios
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from serial_tools import TIMEOUT, StartEmulator, no_leak, program

from acsar_gym.errors import ConfigError
from acsar_gym.tools.emulation.cable import EmulatedCable

BAUD_RATE = 115200
NONBLOCKING = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK


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


def test_a_name_in_use_stays_with_its_device(cable: EmulatedCable, name: Path) -> None:
    with pytest.raises(ConfigError, match=r"usb-acsar: is the name of /dev/pts/\d+"):
        EmulatedCable(BAUD_RATE, name)
    assert str(name.readlink()) == cable.device


@contextlib.contextmanager
def client(device: str | Path) -> Iterator[int]:
    descriptor = os.open(device, NONBLOCKING)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def heard(descriptor: int) -> bytes:
    assert select.select([descriptor], [], [], TIMEOUT)[0], "nothing arrives"
    return os.read(descriptor, 4096)


def test_a_client_notices_the_pull_and_a_new_device_has_the_name(
    cable: EmulatedCable, name: Path
) -> None:
    before = cable.device
    assert str(name.readlink()) == before
    with client(before) as port:  # who holds the old one keeps its name from being used again
        os.write(port, b"old")
        cable.pull()
        assert cable.device == ""
        assert not name.is_symlink()
        with pytest.raises(OSError, match="Input/output") as caught:
            os.write(port, b"x")
        assert caught.value.errno == errno.EIO
        with contextlib.suppress(OSError):  # Linux says EIO, others the end of the file
            assert os.read(port, 10) == b""
        cable.plug()
        assert cable.device not in ("", before)
        assert str(name.readlink()) == cable.device
        assert cable.read() == b"", "what was sent before the pull is gone"
        with client(cable.device) as new:
            cable.write(b"new")
            assert heard(new) == b"new"


def test_it_is_sound_where_the_baud_rates_agree(cable: EmulatedCable) -> None:
    assert cable.has_equal_rates
    for code, equal in ((termios.B115200, True), (termios.B57600, False)):
        with client(cable.device) as port:
            attributes = termios.tcgetattr(port)
            attributes[4] = attributes[5] = code
            termios.tcsetattr(port, termios.TCSANOW, attributes)
        assert cable.has_equal_rates is equal
        assert (cable.over_uart(b"ap00.00") == b"ap00.00") is equal
    cable.pull()
    cable.plug()
    assert cable.has_equal_rates  # the next client finds the board's own rate again


@pytest.mark.parametrize("kind", ["file", "folder", "missing folder"])
def test_where_the_name_cannot_be_made_nothing_stays_open_or_is_lost(
    kind: str, tmp_path: Path
) -> None:
    said = "can't be made a" if kind == "missing folder" else "exists and isn't a symbolic link: "
    name = {"file": tmp_path / "kept", "folder": tmp_path}.get(kind, tmp_path / "no" / "name")
    (tmp_path / "kept").write_text("mine")
    with no_leak(), pytest.raises(ConfigError, match=said) as caught:
        EmulatedCable(BAUD_RATE, name)
    assert str(name) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert (tmp_path / "kept").read_text() == "mine"


@pytest.mark.usefixtures("deadline")
def test_signals_move_the_cable_and_the_log_tells(start_emulator: StartEmulator) -> None:
    emulator = start_emulator()
    before = emulator.device
    with client(before) as port:
        emulator.pull()
        with pytest.raises(OSError, match="Input/output"):
            os.write(port, b"x")
        emulator.plug()
    assert emulator.devices() == ["", emulator.device]
    assert emulator.device != before
    with client(emulator.device) as port:
        tty.setraw(port, termios.TCSANOW)
        assert heard(port)


IGNORING = """
import signal
from acsar_gym.tools.cli import main
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as shells do for `acsar-gym emulate &` in a script
main()
"""


@pytest.mark.usefixtures("deadline")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_a_signal_ends_an_emulator_in_the_background(
    number: signal.Signals, code: int, name: Path
) -> None:
    with program(IGNORING, "emulate", "--name", str(name)) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("serving a robot on ")
        process.send_signal(number)
        assert process.wait(TIMEOUT) == code
    assert not name.is_symlink()
