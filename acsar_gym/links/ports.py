"""Serial ports: which there are, under which names they come back, and how one is opened.

The only file that imports pyserial.
"""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Iterator
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
    """The device behind a name: "usb:A50285BI" is whichever has that USB serial number now.

    Raises PortNotFoundError where none has.
    """
    if not name.startswith(BY_SERIAL_NUMBER):
        return name
    number = name.removeprefix(BY_SERIAL_NUMBER)
    known = ports()
    for port in known:
        if port.serial_number == number:
            return port.device
    numbers = ", ".join(port.serial_number for port in known if port.serial_number) or "none"
    raise PortNotFoundError(
        f"{name}: no USB adapter with this serial number", f"serial numbers here: {numbers}"
    )


def lasting(device: str) -> str:
    """The name under which the adapter behind a device comes back when it is plugged in again.

    /dev/ttyUSB0 may be /dev/ttyUSB1 then, but its name in /dev/serial/by-id stays. Where it has
    none, and for a name that is a link by itself, the device as given.
    """
    with contextlib.suppress(OSError):
        path = Path(device)
        for name in [] if path.is_symlink() else sorted(BY_ID.iterdir()):
            if name.resolve() == path.resolve():
                return str(name)
    return device


def opened(device: str, config: RobotConfig) -> Port:
    """The open port, held exclusively; a write takes a tick at most, a read no time.

    Raises LinkError, which says what to do.
    """
    options: dict[str, Any] = {
        "baudrate": config.baud_rate,
        "bytesize": serial.EIGHTBITS,
        "parity": serial.PARITY_NONE,
        "stopbits": serial.STOPBITS_ONE,
        "timeout": 0,
        "write_timeout": config.period,
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
    return port


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
