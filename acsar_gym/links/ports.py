"""Serial ports: listing, persistent names, and opening.

This is the only module that imports pyserial.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from acsar_gym.config import RobotConfig
from acsar_gym.errors import (
    ConfigError,
    LinkError,
    LinkLostError,
    PortBusyError,
    PortNotFoundError,
    PortPermissionError,
)
from acsar_gym.links.base import WHILE_WAITING

Port = Any
"""An open port of pyserial, which has no type annotations."""
BY_ID = Path("/dev/serial/by-id")
"""Folder of persistent names of USB adapters on Linux: vendor, product, serial number."""
BY_SERIAL_NUMBER = "usb:"
"""Prefix of a name that is the USB serial number of an adapter."""

PORT_ERRORS: tuple[type[Exception], ...] = (serial.SerialException, OSError, TypeError)
"""Exceptions of pyserial when a port disappears while in use."""
with contextlib.suppress(ImportError):  # Windows has no termios
    import termios

    PORT_ERRORS += (termios.error,)


MORE_FILES = "close some, or allow more with 'ulimit -n'"
"""Advice for a process that has too many open files."""
WRITE_TIMEOUT = 0.2
"""A socket that accepts no bytes for this time is lost [s]."""
TURNS = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.0)
"""Pauses between attempts to write, while another process writes to the port [s]."""
BUSY_PATIENCE = 0.7
"""Longest time for which the watchdog of a killed program keeps its port [s]."""
BACK_OFF = (0.02, 0.1)
"""First and longest pause between attempts to open a port [s]; each is twice the last."""


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial device of this computer."""

    device: str
    description: str
    serial_number: str | None = None
    """Serial number of its USB adapter; None if it has none."""


def ports() -> list[PortInfo]:
    """List the serial devices of this computer."""
    return [
        PortInfo(port.device, port.description, port.serial_number)
        for port in sorted(list_ports.comports())
    ]


def located(name: str) -> str:
    """Find the device of a name.

    Args:
        name: a device, which is returned unchanged, or "usb:" with the USB serial number of an
            adapter.

    Raises:
        PortNotFoundError: no adapter has this serial number.
        ConfigError: several adapters have it.
    """
    if not name.startswith(BY_SERIAL_NUMBER):
        return name
    number = name.removeprefix(BY_SERIAL_NUMBER)
    known = ports()
    found = [port.device for port in known if port.serial_number == number]
    if len(found) > 1:
        raise ConfigError(f"{name}: {', '.join(found)} have this serial number: name one of them")
    if not found:
        numbers = ", ".join(port.serial_number for port in known if port.serial_number) or "none"
        raise PortNotFoundError(
            f"{name}: no USB adapter with this serial number", f"serial numbers here: {numbers}"
        )
    return found[0]


def lasting(device: str) -> str:
    """Return the persistent name of a device, under which it reappears when plugged in again.

    /dev/ttyUSB0 may become /dev/ttyUSB1, but its name in /dev/serial/by-id stays. The device itself
    is returned if it has no such name, is a symbolic link already, or shares its serial number with
    another adapter, as some cheap ones do.
    """
    with contextlib.suppress(OSError):
        path = Path(device)
        if not path.is_symlink() and _has_its_own_number(path):
            for name in sorted(BY_ID.iterdir()):
                if name.resolve() == path.resolve():
                    return str(name)
    return device


def _has_its_own_number(path: Path) -> bool:
    """Return whether no other adapter has the same serial number."""
    known = [port for port in ports() if port.serial_number]
    mine = [port.serial_number for port in known if Path(port.device).resolve() == path.resolve()]
    return bool(mine) and [port.serial_number for port in known].count(mine[0]) == 1


class Location:
    """The name of a port, and the name under which it reappears after it was lost.

    Args:
        name: a device, URL, or "usb:" and a serial number.

    Attributes:
        path: persistent name of the open or lost port; None before the first opening.
        lost: whether the port disappeared while in use.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.path: str | None = None
        self.lost = False

    @property
    def lasts(self) -> bool:
        """Whether no other device can get the name `path`."""
        return self.path is not None and Path(self.path).is_symlink()

    def opened(self, config: RobotConfig, make_way: Callable[[], None] = lambda: None) -> Port:
        """Open the port; a lost one has `reconnect_timeout` to reappear.

        Args:
            config: configuration of the robot.
            make_way: called if the port is busy, and after it was opened, to end this program's
                own watchdog that searches for the port.

        Raises:
            LinkError: the port can't be opened.
        """
        start, (pause, longest) = time.monotonic(), BACK_OFF
        while True:
            try:
                return self._opened_now(config, make_way)
            except LinkError as error:
                if time.monotonic() + pause > start + self._patience(error, config):
                    raise
            WHILE_WAITING.get()()
            time.sleep(pause)
            pause = min(2.0 * pause, longest)

    def _opened_now(self, config: RobotConfig, make_way: Callable[[], None]) -> Port:
        """Try once to open the port."""
        device = located(self.name)
        if device == self.name and self.path is not None:
            device = self.path
        try:
            port = opened(device, config)
        except PortBusyError:
            make_way()
            raise
        make_way()
        self.path, self.lost = lasting(device), False
        return port

    def _patience(self, error: LinkError, config: RobotConfig) -> float:
        """Return how long to retry after an error [s]."""
        lost = config.reconnect_timeout if self.lost else 0.0
        return max(lost, BUSY_PATIENCE if isinstance(error, PortBusyError) else 0.0)

    def left(self, *, lost: bool) -> None:
        """Note that the port was closed; only a lost port is looked for under the same name."""
        self.lost = lost
        self.path = self.path if lost else None


def opened(device: str, config: RobotConfig) -> Port:
    """Open a port exclusively, with non-blocking reads.

    Args:
        device: a device or URL.
        config: configuration of the robot; has the baud rate.

    Raises:
        LinkError: the port can't be opened; the message says why and what to do.
    """
    options: dict[str, Any] = {
        "baudrate": config.baud_rate,
        "bytesize": serial.EIGHTBITS,
        "parity": serial.PARITY_NONE,
        "stopbits": serial.STOPBITS_ONE,
        "timeout": 0,
        "write_timeout": WRITE_TIMEOUT,
    }
    if "://" in device:
        _check_url(device)
    else:
        options["exclusive"] = True
    try:
        port = serial.serial_for_url(device, **options)
    except ValueError as error:
        raise LinkError(f"{device}: can't be opened as a serial port", str(error)) from None
    except PORT_ERRORS as error:
        raise _why_not_open(device, error) from None
    with contextlib.suppress(AttributeError, ValueError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    with contextlib.suppress(AttributeError, OSError):  # send packets at once
        port._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # noqa: SLF001
    return port


def put(port: Port, data: bytes) -> None:
    """Send bytes without blocking.

    pyserial's own write blocks until there is room, and may report a failure only afterwards.

    Raises:
        Exception: one of PORT_ERRORS, if the port doesn't accept all bytes.
    """
    descriptor = getattr(port, "fd", None)
    if descriptor is None:  # a socket, or Windows
        port.write(data)
        return
    if _sent(descriptor, data) < len(data):
        raise serial.SerialException("it takes no more bytes")


def _sent(descriptor: int, data: bytes) -> int:
    """Write to a descriptor; returns the number of bytes that were accepted.

    The kernel also refuses a write while another process, such as the watchdog, is writing.
    """
    for pause in TURNS:
        with contextlib.suppress(BlockingIOError):
            return os.write(descriptor, data)
        time.sleep(pause)
    return 0


def _check_url(url: str) -> None:
    """Raise ConfigError unless the URL is a socket's, with a host and a port.

    Only a socket's descriptor can be shared with the watchdog, which stops the wheels where this
    program is killed; pyserial's other URLs, such as rfc2217://, have none.
    """
    if not url.lower().startswith("socket://"):
        raise ConfigError(
            f"{url}: no watchdog can stop the wheels behind such a URL: have the other computer "
            "serve the raw port (ser2net, socat, esp-link), and use socket://host:port"
        )
    try:
        parts = urlsplit(url)
        complete = bool(parts.hostname and parts.port)
    except ValueError:
        complete = False
    if not complete:
        raise ConfigError(f"{url}: must be like socket://192.168.4.1:2000 (host and port)")


def _why_not_open(device: str, error: Exception) -> LinkError:
    """Convert an exception of pyserial to a LinkError with advice."""
    code = getattr(error, "errno", None)
    text = str(error)
    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or isinstance(error, FileNotFoundError):
        known = ", ".join(port.device for port in ports()) or "none"
        return PortNotFoundError(f"{device}: no such device", f"serial ports here: {known}")
    if code in (errno.EACCES, errno.EPERM):
        return PortPermissionError(
            f"{device}: permission denied",
            "add yourself to the group that owns it, usually 'sudo usermod -aG dialout $USER', and "
            "log in again",
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return PortBusyError(
            f"{device}: in use by another process", f"close it first; find it with 'fuser {device}'"
        )
    if code in (errno.EMFILE, errno.ENFILE):
        return LinkError(f"{device}: too many open files", MORE_FILES)
    return LinkError(f"{device}: can't be opened as a serial port", text)


@contextlib.contextmanager
def translated(device: str) -> Iterator[None]:
    """Convert exceptions of a port in use to LinkLostError, as a context manager."""
    try:
        yield
    except PORT_ERRORS as error:
        raise LinkLostError(
            f"{device}: lost while in use ({error})", "check the cable, then start again"
        ) from None
