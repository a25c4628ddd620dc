"""Serial ports: listing, persistent names, opening, reading and writing.

This is the only module that imports pyserial.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
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
from acsar_gym.errors import MORE_FILES_ADVICE, ConfigError, LinkError, LinkLostError, PortBusyError
from acsar_gym.links.base import WHILE_WAITING

SerialPort = Any  # an open port of pyserial, which has no type annotations
BY_ID_FOLDER = Path("/dev/serial/by-id")  # by vendor, product, serial number
SERIAL_NUMBER_PREFIX = "usb:"  # prefix of a name that is the USB serial number of an adapter

PORT_ERRORS: tuple[type[Exception], ...] = (serial.SerialException, OSError, TypeError)
"""Exceptions of pyserial when a port disappears while in use."""
with contextlib.suppress(ImportError):  # Windows has no termios
    import termios

    PORT_ERRORS += (termios.error,)

WAIT_ERRORS: tuple[type[Exception], ...] = (ValueError, *PORT_ERRORS)
"""The same where a port can't be waited for."""
WRITE_TIMEOUT = 0.2  # a socket that accepts no bytes for this time is lost [s]
WRITE_PAUSES = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.0)  # while others write [s]
BUSY_TIMEOUT = 0.7  # longest time for which the watchdog of a killed program keeps its port [s]
OPEN_PAUSES = (0.02, 0.1)
"""First and longest pause between attempts to open a port [s]; each is twice the last."""
READ_CHUNK = 4096  # bytes read from the port by one call
MAX_READ_CHUNKS = 256  # most chunks per read: empties a driver's buffer, but no endless stream
DRAIN_TIMEOUT = 0.05  # longest wait for sent bytes to leave the port when it is closed [s]


@dataclass(frozen=True, slots=True)
class PortInfo:
    """A serial device of this computer."""

    device: str
    description: str
    serial_number: str | None = None
    """Serial number of its USB adapter; None if it has none."""


def find_ports() -> list[PortInfo]:
    """List the serial devices of this computer."""
    return [
        PortInfo(port.device, port.description, port.serial_number)
        for port in sorted(list_ports.comports())
    ]


def locate_port(name: str) -> str:
    """The device of a name; ConfigError or LinkError unless one adapter has the number."""
    if not name.startswith(SERIAL_NUMBER_PREFIX):
        return name
    number = name.removeprefix(SERIAL_NUMBER_PREFIX)
    ports = find_ports()
    devices = [port.device for port in ports if port.serial_number == number]
    if len(devices) > 1:
        raise ConfigError(f"{name}: {', '.join(devices)} have this serial number: name one of them")
    if not devices:
        numbers = ", ".join(port.serial_number for port in ports if port.serial_number) or "none"
        raise LinkError(
            f"{name}: no USB adapter with this serial number", f"serial numbers here: {numbers}"
        )
    return devices[0]


def find_lasting_name(device: str) -> str:
    """Return the persistent name of a device, under which it reappears when plugged in again.

    /dev/ttyUSB0 may become /dev/ttyUSB1, but its name in /dev/serial/by-id stays. The device itself
    is returned if it has no such name, is a symbolic link already, or shares its serial number with
    another adapter, as some cheap ones do.
    """
    with contextlib.suppress(OSError):
        path = Path(device)
        if path.is_symlink():
            return device
        ports = [port for port in find_ports() if port.serial_number]
        numbers = {
            port.serial_number for port in ports if Path(port.device).resolve() == path.resolve()
        }
        if sum(port.serial_number in numbers for port in ports) != 1:
            return device
        for name in sorted(BY_ID_FOLDER.iterdir()):
            if name.resolve() == path.resolve():
                return str(name)
    return device


class PortLocation:
    """The name of a port, and the persistent one under which it reappears after it was lost.

    Attributes: `path`, that name, None before the first opening; `lost`, whether it disappeared.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.path: str | None = None
        self.lost = False

    @property
    def lasting_path(self) -> str:
        """The name `path`, if no other device can get it; else empty."""
        return self.path if self.path is not None and Path(self.path).is_symlink() else ""

    @property
    def search_name(self) -> str:
        """The name under which searches for the port are known."""
        return self.path or self.name

    def opened(
        self, config: RobotConfig, make_way: Callable[[], None] = lambda: None
    ) -> SerialPort:
        """Open the port; a lost one has `reconnect_timeout` to reappear.

        Raises:
            LinkError: the port can't be opened.
        """
        start, (pause, longest) = time.monotonic(), OPEN_PAUSES
        while True:
            try:
                device = locate_port(self.name)
                if device == self.name and self.path is not None:
                    device = self.path
                try:
                    port = open_port(device, config)
                except PortBusyError:
                    make_way()
                    raise
            except LinkError as error:
                patience = config.reconnect_timeout if self.lost else 0.0
                if isinstance(error, PortBusyError):
                    patience = max(patience, BUSY_TIMEOUT)
                if time.monotonic() + pause > start + patience:
                    raise
            else:
                make_way()
                self.path, self.lost = find_lasting_name(device), False
                return port
            WHILE_WAITING.get()()
            time.sleep(pause)
            pause = min(2.0 * pause, longest)

    def left(self, *, lost: bool) -> None:
        """Note that the port was closed; only a lost port is looked for under the same name."""
        self.lost = lost
        self.path = self.path if lost else None


def open_port(device: str, config: RobotConfig) -> SerialPort:
    """Open a port exclusively, with non-blocking reads; LinkError says why it can't be."""
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
        raise LinkError(f"{device}: can't be opened as a serial port", str(error)) from error
    except PORT_ERRORS as error:
        raise _opening_error(device, error) from error
    with contextlib.suppress(AttributeError, ValueError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    with contextlib.suppress(AttributeError, OSError):  # send packets at once
        port._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # noqa: SLF001
    return port


def _check_url(url: str) -> None:
    """Raise ConfigError unless the URL is a socket's, with a host and a port.

    The watchdog needs its descriptor; pyserial's other URLs, such as rfc2217://, have none.
    """
    if not url.lower().startswith("socket://"):
        raise ConfigError(
            f"{url}: no watchdog can stop the wheels behind such a URL: have the other computer "
            "serve the raw port (ser2net, socat, esp-link), and use socket://host:port"
        )
    complete = False
    with contextlib.suppress(ValueError):
        parts = urlsplit(url)
        complete = bool(parts.hostname and parts.port)
    if not complete:
        raise ConfigError(f"{url}: must be like socket://192.168.4.1:2000 (host and port)")


def _opening_error(device: str, error: Exception) -> LinkError:
    code = getattr(error, "errno", None)
    text = str(error)
    gone = code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or isinstance(error, FileNotFoundError)
    if gone or errno.ENOTTY in getattr(error.__context__, "args", ()):  # of termios
        ports = ", ".join(port.device for port in find_ports()) or "none"
        if gone:
            return LinkError(f"{device}: no such device", f"serial ports here: {ports}")
        return LinkError(f"{device}: isn't a serial port", f"serial ports here: {ports}")
    if code in (errno.EACCES, errno.EPERM):
        return LinkError(
            f"{device}: permission denied",
            "add yourself to the group that owns it, usually 'sudo usermod -aG dialout $USER', and "
            "log in again",
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return PortBusyError(
            f"{device}: in use by another process", f"close it first; find it with 'fuser {device}'"
        )
    if code in (errno.EMFILE, errno.ENFILE):
        return LinkError(f"{device}: too many open files", MORE_FILES_ADVICE)
    return LinkError(f"{device}: can't be opened as a serial port", text)


@contextlib.contextmanager
def translate_port_errors(device: str) -> Iterator[None]:
    """Convert exceptions of a port in use to LinkLostError, as a context manager."""
    try:
        yield
    except PORT_ERRORS as error:
        raise LinkLostError(
            f"{device}: lost while in use ({error})", "check the cable, then start again"
        ) from error


def write_all(port: SerialPort, data: bytes) -> None:
    """Send bytes without blocking; one of PORT_ERRORS where the port doesn't accept all.

    pyserial's own write blocks until there is room. The kernel also refuses a write while another
    process, such as the watchdog, is writing.
    """
    descriptor = getattr(port, "fd", None)
    if descriptor is None:  # a socket, or Windows
        port.write(data)
        return
    written = 0
    for pause in WRITE_PAUSES:
        with contextlib.suppress(BlockingIOError):
            written = os.write(descriptor, data)
            break
        time.sleep(pause)
    if written < len(data):
        raise serial.SerialException("it takes no more bytes")


class OpenPort:
    """An open serial port with non-blocking reads and writes, and exceptions of this package.

    `write`, `read`, `drop_input` and `drop_output` raise LinkLostError if the device is gone. The
    others raise nothing, so that stopping can't fail halfway.
    """

    def __init__(self, port: SerialPort, device: str) -> None:
        self._port = port
        self._device = device

    def write(self, data: bytes) -> None:
        """Send all of the bytes."""
        with translate_port_errors(self._device):
            write_all(self._port, data)

    def read(self) -> bytes:
        """Return what has arrived, without waiting."""
        data = b""
        with translate_port_errors(self._device):
            for _ in range(MAX_READ_CHUNKS):
                chunk = self._port.read(READ_CHUNK)
                data += chunk
                if not chunk:
                    break
        return data

    def wait_for_bytes(self, seconds: float) -> bool:
        """Wait for bytes for a time at most [s]; whether some arrived, or the device is gone."""
        try:
            return bool(select.select([self._port], [], [], seconds)[0])
        except WAIT_ERRORS:
            time.sleep(seconds)
        return False

    def drop_input(self) -> None:
        """Discard what has arrived and wasn't read."""
        with translate_port_errors(self._device):
            self._port.reset_input_buffer()

    def drop_output(self) -> None:
        """Discard what hasn't left the port yet."""
        with translate_port_errors(self._device):
            self._port.reset_output_buffer()

    def fileno(self) -> int | None:
        """Return the file descriptor; None if it can't be shared, as on Windows."""
        try:
            return int(self._port.fileno())
        except OSError:
            return None

    def try_write(self, data: bytes) -> bool:
        """Send bytes; returns whether the port accepted them."""
        with contextlib.suppress(*PORT_ERRORS):
            write_all(self._port, data)
            return True
        return False

    def drain(self) -> bool:
        """Wait up to DRAIN_TIMEOUT; returns whether all bytes have been sent.

        The rest is discarded, as it would delay the closing of the port.
        """
        deadline = time.monotonic() + DRAIN_TIMEOUT
        with contextlib.suppress(*PORT_ERRORS):
            while getattr(self._port, "out_waiting", 0):
                if time.monotonic() > deadline:
                    self._port.reset_output_buffer()
                    return False
                time.sleep(0.001)
            return True
        return False

    def is_quiet(self) -> bool:
        """Return whether nothing has arrived, or the device is gone."""
        with contextlib.suppress(*PORT_ERRORS):
            return not self._port.in_waiting
        return True

    def close(self) -> None:
        """Close the port, in any state."""
        with contextlib.suppress(*PORT_ERRORS):
            self._port.close()

    def detach(self) -> None:
        """Close this process's copy of a socket, without ending the parent's connection."""
        connection = getattr(self._port, "_socket", None)
        if connection is not None:
            os.close(connection.detach())
            self._port.is_open = False
