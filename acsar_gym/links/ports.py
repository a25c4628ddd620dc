"""Serial ports: which there are, under which names they come back, and how one is opened.

The only file that imports pyserial.
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

Port = Any
"""pyserial's, which has no types."""
BY_ID = Path("/dev/serial/by-id")
"""Linux' names for USB adapters, made of vendor, product and serial number."""
BY_SERIAL_NUMBER = "usb:"
"""What begins so names an adapter by its USB serial number."""

PORT_ERRORS: tuple[type[Exception], ...] = (serial.SerialException, OSError, TypeError)
"""What pyserial lets out where a port in use goes away."""
with contextlib.suppress(ImportError):  # Windows has no termios
    import termios

    PORT_ERRORS += (termios.error,)


MORE_FILES = "close some, or allow more with 'ulimit -n'"
"""What to do where a process can't open any more files."""
WRITE_TIMEOUT = 0.2
"""A socket that takes no bytes for so long is lost [s]."""
TURNS = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.0)
"""Pauses between tries at a port that another process writes to; none after the last one [s]."""
BUSY_PATIENCE = 0.7
"""A program that was killed leaves its port to its watchdog for so long, at most [s]."""
BACK_OFF = (0.02, 0.1)
"""Pause before the second try to open a port, and the longest one; each is twice the last [s]."""


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial device of this computer."""

    device: str
    description: str
    serial_number: str | None = None
    """Of its USB adapter, where that has one."""


def ports() -> list[PortInfo]:
    """The serial devices that the operating system knows."""
    return [
        PortInfo(port.device, port.description, port.serial_number)
        for port in sorted(list_ports.comports())
    ]


def located(name: str) -> str:
    """The device behind a name: "usb:A50285BI" is the one that has this USB serial number now.

    Raises PortNotFoundError where none has, and ConfigError where several have.
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
    """The name under which the adapter behind a device comes back when it is plugged in again.

    /dev/ttyUSB0 may be /dev/ttyUSB1 then, but its name in /dev/serial/by-id stays. Where it has
    none, or shares its serial number with another adapter, as cheap ones do, and for a name that is
    a link by itself: the device as given.
    """
    with contextlib.suppress(OSError):
        path = Path(device)
        if not path.is_symlink() and _has_its_own_number(path):
            for name in sorted(BY_ID.iterdir()):
                if name.resolve() == path.resolve():
                    return str(name)
    return device


def _has_its_own_number(path: Path) -> bool:
    known = [port for port in ports() if port.serial_number]
    mine = [port.serial_number for port in known if Path(port.device).resolve() == path.resolve()]
    return bool(mine) and [port.serial_number for port in known].count(mine[0]) == 1


class Location:
    """Where a port is, and where it comes back when it was lost.

    `path` is the name that it was opened under, None before that; set `lost` where it went away.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.path: str | None = None
        self.lost = False

    @property
    def lasts(self) -> bool:
        """Whether no other device can get its name."""
        return self.path is not None and Path(self.path).is_symlink()

    def opened(self, config: RobotConfig, make_way: Callable[[], None] = lambda: None) -> Port:
        """The open port, as `opened`; a lost one has the config's `reconnect_timeout` to come back.

        `make_way` is called where the port is in use and when it is open: it may be our own search.
        """
        start, (pause, longest) = time.monotonic(), BACK_OFF
        while True:
            try:
                return self._opened_now(config, make_way)
            except LinkError as error:
                if time.monotonic() + pause > start + self._patience(error, config):
                    raise
            time.sleep(pause)
            pause = min(2.0 * pause, longest)

    def _opened_now(self, config: RobotConfig, make_way: Callable[[], None]) -> Port:
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
        lost = config.reconnect_timeout if self.lost else 0.0
        return max(lost, BUSY_PATIENCE if isinstance(error, PortBusyError) else 0.0)

    def left(self, *, lost: bool) -> None:
        """The port was closed; one that wasn't lost may be another one next time."""
        self.lost = lost
        self.path = self.path if lost else None


def opened(device: str, config: RobotConfig) -> Port:
    """The open port, held exclusively; `put` and reads wait for nothing.

    Raises LinkError, which says what to do.
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
    with contextlib.suppress(AttributeError, OSError):  # a socket's packets must not wait
        port._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # noqa: SLF001
    return port


def put(port: Port, data: bytes) -> None:
    """Send without waiting. Raises one of PORT_ERRORS where the port doesn't take all of it.

    pyserial's own write waits until there is room for more, and may say that it failed afterwards.
    """
    descriptor = getattr(port, "fd", None)
    if descriptor is None:  # a socket, or Windows
        port.write(data)
        return
    if _sent(descriptor, data) < len(data):
        raise serial.SerialException("it takes no more bytes")


def _sent(descriptor: int, data: bytes) -> int:
    """How many bytes a port takes at once.

    The kernel also refuses a write while another process, as the watchdog, writes to the same port.
    """
    for pause in TURNS:
        with contextlib.suppress(BlockingIOError):
            return os.write(descriptor, data)
        time.sleep(pause)
    return 0


def _check_url(url: str) -> None:
    """ConfigError unless it names a host and a port."""
    try:
        parts = urlsplit(url)
        complete = bool(parts.hostname and parts.port)
    except ValueError:
        complete = False
    if not complete:
        raise ConfigError(f"{url}: must be like socket://192.168.4.1:2000 (host and port)")


def _why_not_open(device: str, error: Exception) -> LinkError:
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
    """Errors of a port in use become LinkLostError."""
    try:
        yield
    except PORT_ERRORS as error:
        raise LinkLostError(
            f"{device}: lost while in use ({error})", "check the cable, then reset"
        ) from None
