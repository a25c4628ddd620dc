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
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from acsar_gym.errors import (
    MORE_FILES_ADVICE,
    TOO_MANY_FILES,
    ConfigError,
    LinkError,
    LinkLostError,
    PortBusyError,
)
from acsar_gym.links.base import WHILE_WAITING

BY_ID_FOLDER = Path("/dev/serial/by-id")  # persistent names: vendor, product, serial number
SERIAL_NUMBER_PREFIX = "usb:"  # prefix of a name that is the USB serial number of an adapter

PORT_ERRORS: tuple[type[Exception], ...] = (serial.SerialException, OSError, TypeError, ValueError)
"""Exceptions of pyserial and `select` if a port disappears while in use."""
with contextlib.suppress(ImportError):  # Windows has no termios
    import termios

    PORT_ERRORS += (termios.error,)

WRITE_TIMEOUT = 0.2  # a socket that accepts no bytes for this time is lost [s]
WRITE_PAUSES = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.0)
"""Pauses between attempts to write while another process, such as the watchdog, writes [s]."""
BUSY_TIMEOUT = 0.7  # the watchdog of a killed program keeps its port for less than this [s]
OPEN_PAUSE = 0.02  # first pause between attempts to open a port [s]
MAX_OPEN_PAUSE = 0.1  # longest pause. Each is twice the one before [s]
READ_CHUNK = 4096  # bytes read from the port by one call
MAX_READ_CHUNKS = 256  # chunks per read: enough for a driver's buffer, but no endless stream
DRAIN_TIMEOUT = 0.05  # longest wait for sent bytes to leave the port when it is closed [s]


def find_ports() -> list[Any]:
    """List the serial devices of this computer, as pyserial's `ListPortInfo` describes them."""
    return sorted(list_ports.comports())


def locate_port(name: str) -> str:
    """Return the device of a name such as "/dev/ttyUSB0" or "usb:A50285BI".

    Raises:
        ConfigError: Several adapters have this serial number.
        LinkError: No adapter has it.
    """
    if not name.startswith(SERIAL_NUMBER_PREFIX):
        return name

    number = name.removeprefix(SERIAL_NUMBER_PREFIX)
    ports = find_ports()
    devices: list[str] = [port.device for port in ports if port.serial_number == number]
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
    is returned if it has no such name, or shares its serial number with another adapter, as some
    cheap adapters do.
    """
    path = Path(device)
    with contextlib.suppress(OSError):
        if path.is_symlink():
            return device

        target = path.resolve()
        ports = [port for port in find_ports() if port.serial_number]
        numbers = {port.serial_number for port in ports if Path(port.device).resolve() == target}
        # With a shared serial number the name could lead to another robot's adapter.
        if sum(port.serial_number in numbers for port in ports) == 1:
            for name in sorted(BY_ID_FOLDER.iterdir()):
                if name.resolve() == target:
                    return str(name)
    return device


class PortLocation:
    """The name of a port, and the persistent name under which it reappears after it was lost.

    Attributes:
        name: Device, URL, or USB serial number such as "usb:A50285BI".
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self._lost_name = ""

    def open(self, baud_rate: int, reconnect_timeout: float) -> OpenPort:
        """Open the port.

        Args:
            baud_rate: Baud rate [bit/s].
            reconnect_timeout: How long a lost port may take to reappear [s].

        Raises:
            LinkError: The port can't be opened.
        """
        start = time.monotonic()
        pause = OPEN_PAUSE
        while True:
            try:
                path = locate_port(self._lost_name or self.name)
                port = OpenPort(open_port(path, baud_rate), self.name, find_lasting_name(path))
            except LinkError as error:
                # A port that wasn't lost won't appear by waiting: a wrong name fails at once.
                patience = reconnect_timeout if self._lost_name else 0.0
                if isinstance(error, PortBusyError):
                    patience = max(patience, BUSY_TIMEOUT)
                if time.monotonic() + pause > start + patience:
                    raise
            else:
                self._lost_name = ""
                return port

            WHILE_WAITING.get()()
            time.sleep(pause)
            # A busy port is free again soon, a lost port takes seconds.
            pause = min(2.0 * pause, MAX_OPEN_PAUSE)

    def note_loss(self, port: OpenPort) -> None:
        """Look for a lost port under its persistent name the next time."""
        is_number = self.name.startswith(SERIAL_NUMBER_PREFIX)
        self._lost_name = self.name if is_number else port.path


def open_port(device: str, baud_rate: int) -> Any:
    """Open pyserial's port exclusively, with non-blocking reads. LinkError if it can't be."""
    options: dict[str, Any] = {
        "baudrate": baud_rate,
        "bytesize": serial.EIGHTBITS,
        "parity": serial.PARITY_NONE,
        "stopbits": serial.STOPBITS_ONE,
        "timeout": 0,
        "write_timeout": WRITE_TIMEOUT,
    }
    if "://" in device:
        _check_url(device)
    else:
        # Two programs on a port would command the same wheels.
        options["exclusive"] = True

    try:
        port = serial.serial_for_url(device, **options)
    except ValueError as error:
        raise LinkError(f"{device}: can't be opened as a serial port", str(error)) from error
    except PORT_ERRORS as error:
        raise _opening_error(device, error) from error

    # Send each line at once: FTDI's latency timer and Nagle's algorithm would hold it back.
    with contextlib.suppress(AttributeError, ValueError, NotImplementedError, OSError):
        port.set_low_latency_mode(True)
    with contextlib.suppress(AttributeError, OSError):
        port._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # noqa: SLF001
    return port


def _check_url(url: str) -> None:
    """Raise ConfigError unless the URL is a socket's, with a host and a port.

    The watchdog needs a descriptor, which pyserial's other URLs, such as rfc2217://, don't have.
    """
    if not url.lower().startswith("socket://"):
        raise ConfigError(
            f"{url}: no watchdog can stop the wheels behind such a URL: have the other computer "
            "serve the raw port (ser2net, socat, esp-link), and use socket://host:port"
        )

    is_complete = False
    with contextlib.suppress(ValueError):
        parts = urlsplit(url)
        is_complete = bool(parts.hostname and parts.port)
    if not is_complete:
        raise ConfigError(f"{url}: must be like socket://192.168.4.1:2000 (host and port)")


def _opening_error(device: str, error: Exception) -> LinkError:
    """Translate an exception of opening a port."""
    code = getattr(error, "errno", None)
    ports = ", ".join(port.device for port in find_ports()) or "none"

    if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO) or isinstance(error, FileNotFoundError):
        return LinkError(f"{device}: no such device", f"serial ports here: {ports}")
    if errno.ENOTTY in getattr(error.__context__, "args", ()):  # of termios
        return LinkError(f"{device}: isn't a serial port", f"serial ports here: {ports}")

    if code in (errno.EACCES, errno.EPERM):
        return LinkError(
            f"{device}: permission denied",
            "add yourself to the group that owns it, usually 'sudo usermod -aG dialout $USER', and "
            "log in again",
        )
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in str(error):
        return PortBusyError(
            f"{device}: in use by another process", f"close it first; find it with 'fuser {device}'"
        )
    if code in TOO_MANY_FILES:
        return LinkError(f"{device}: too many open files", MORE_FILES_ADVICE)
    return LinkError(f"{device}: can't be opened as a serial port", str(error))


def write_all(port: Any, data: bytes) -> None:
    """Send bytes without blocking, unlike pyserial's `write`. Raises one of PORT_ERRORS."""
    descriptor = getattr(port, "fd", None)
    if descriptor is None:  # a socket, or Windows
        port.write(data)
        return

    # The kernel also refuses a write while another process, such as the watchdog, is writing.
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
    other methods raise nothing, so that stopping can't fail halfway.

    Attributes:
        path: Persistent name of the device.

    Args:
        port: Open port of pyserial.
        name: Name of the device in messages.
        path: Persistent name of the device.
    """

    def __init__(self, port: Any, name: str, path: str = "") -> None:
        self.path = path
        self._port = port
        self._name = name

    @contextlib.contextmanager
    def _translating_errors(self) -> Iterator[None]:
        """Convert exceptions of the port to LinkLostError."""
        try:
            yield
        except PORT_ERRORS as error:
            raise LinkLostError(
                f"{self._name}: lost while in use ({error})", "check the cable, then start again"
            ) from error

    def write(self, data: bytes) -> None:
        """Send all of the bytes."""
        with self._translating_errors():
            write_all(self._port, data)

    def try_write(self, data: bytes) -> bool:
        """Send bytes. Returns whether the port accepted them."""
        with contextlib.suppress(*PORT_ERRORS):
            write_all(self._port, data)
            return True
        return False

    def read(self) -> bytes:
        """Return what has arrived, without waiting."""
        data = b""
        with self._translating_errors():
            # A device that never stops sending must not block the caller.
            for _ in range(MAX_READ_CHUNKS):
                chunk = self._port.read(READ_CHUNK)
                data += chunk
                if not chunk:
                    break
        return data

    def wait_for_bytes(self, seconds: float) -> bool:
        """Wait for bytes [s]. Returns whether some arrived, or the device is gone."""
        try:
            return bool(select.select([self._port], [], [], seconds)[0])
        except PORT_ERRORS:
            # A port that is gone fails at once: without a pause the caller would spin.
            time.sleep(seconds)
        return False

    def drop_input(self) -> None:
        """Discard what has arrived and wasn't read."""
        with self._translating_errors():
            self._port.reset_input_buffer()

    def drop_output(self) -> None:
        """Discard what hasn't left the port yet."""
        with self._translating_errors():
            self._port.reset_output_buffer()

    def set_baud_rate(self, rate: int) -> None:
        """Change the baud rate [bit/s]. LinkError if the port can't have it."""
        with self._translating_errors():
            try:
                self._port.baudrate = rate
            except (ValueError, NotImplementedError) as error:
                raise LinkError(
                    f"{self._name}: {error}", "connect the device by another adapter"
                ) from error

    def set_dtr(self, *, on: bool) -> None:
        """Set the line DTR. A port without this line, such as a pseudo-terminal, ignores it."""
        with contextlib.suppress(*PORT_ERRORS):
            self._port.dtr = on

    def fileno(self) -> int | None:
        """Return the file descriptor. None if it can't be shared, as on Windows."""
        try:
            return int(self._port.fileno())
        except OSError:
            return None

    def drain(self) -> bool:
        """Wait up to `DRAIN_TIMEOUT`. Returns whether all bytes have been sent.

        Bytes that haven't been sent are discarded, as they would delay the closing of the port.
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
