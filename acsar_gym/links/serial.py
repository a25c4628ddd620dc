"""The real wire: pyserial, with absolute deadlines. The only file that imports pyserial."""

from __future__ import annotations

import contextlib
import errno
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from acsar_gym.bodies.base import Image
from acsar_gym.config import BAUD_RATES, RobotConfig
from acsar_gym.errors import (
    BoardGarbledError,
    BoardSilentError,
    ConfigError,
    LinkError,
    LinkLostError,
    PortBusyError,
    PortNotFoundError,
    PortPermissionError,
)
from acsar_gym.links import watchdog
from acsar_gym.links.guard import guard, install, unguard
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.worlds import Scene

LATE = 0.001
"""A tick that ends this long after its deadline is late [s]."""
POLL = 0.01
"""How often activation looks for the first valid line [s]."""
CHUNK = 4096
"""Most bytes taken from the port at once."""
MOST_CHUNKS = 256
"""Chunks taken in one go, at most: what lies in any driver's buffer, and no endless stream."""
BUSY_PATIENCE = 0.7
"""A program that was killed leaves its port to its watchdog for so long, at most [s]."""
BUSY_POLL = 0.02
"""How often to try again [s]."""
WRITE_TIMEOUT = 0.2
"""A write that blocks this long means that nobody takes the bytes [s]."""

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


def ports() -> list[PortInfo]:
    """The serial devices that the operating system knows."""
    return [PortInfo(port.device, port.description) for port in sorted(list_ports.comports())]


class SerialLink:
    """A board on a serial device: 8N1, no flow control, opened exclusively.

    `late_ticks` counts periods that ended more than a millisecond after their deadline, `ticks`
    all of them since the last reset, and `worst_lateness` is in seconds.

    While it is open, a process of its own commands zero where this one dies, or hangs for longer
    than the config's `watchdog_timeout` while wheels turn; `watched` tells whether there is one.
    """

    truth = None

    def __init__(self, device: str, config: RobotConfig) -> None:
        self.device = device
        self._config = config
        self._port: serial.SerialBase | None = None
        self._watchdog: watchdog.Watchdog | None = None
        self._zeros = encode(ZERO, trailing_comma=config.trailing_comma)
        self._nap = math.inf
        self._deadline = 0.0
        self._clear_statistics()
        install()

    def _clear_statistics(self) -> None:
        self.ticks = 0
        self.late_ticks = 0
        self.worst_lateness = 0.0

    def open(self) -> None:
        """Open the device, flush it, and wait for the board's first valid line.

        Raises PortNotFoundError, PortPermissionError, PortBusyError, BoardSilentError or
        BoardGarbledError, or LinkError where no watchdog can be started; the device is closed again
        then.
        """
        if self._port is not None:
            return
        self._port = self._patiently_opened()
        guard(self)
        try:
            self._watch()
            self._flush()
            self._stop_motors()
            self._wait_for_board()
            if self._watchdog is not None:
                self._watchdog.wait()
        except BaseException:
            self.close()
            raise
        self._deadline = self.now()

    def _patiently_opened(self) -> serial.SerialBase:
        deadline = self.now() + BUSY_PATIENCE
        while True:
            try:
                return opened(self.device, self._config)
            except PortBusyError:
                if self.now() > deadline:
                    raise
            time.sleep(BUSY_POLL)

    def _watch(self) -> None:
        """Start the watchdog, where the config wants one and the port is a file to share."""
        timeout = self._config.watchdog_timeout
        if timeout is None or not watchdog.AVAILABLE:
            return
        try:
            descriptor = self._require().fileno()
        except OSError:  # rfc2217 has none
            return
        self._watchdog = watchdog.Watchdog(descriptor, self._stop_line(), timeout)
        self._nap = timeout / 3.0

    @property
    def watched(self) -> bool:
        """Whether a process of its own would stop the robot now, did this one die or hang."""
        return self._watchdog is not None and self._watchdog.alive

    def _flush(self) -> None:
        self.reset_input()
        with _translated(self.device):
            self._require().reset_output_buffer()

    def _wait_for_board(self) -> None:
        decoder = Decoder()
        heard = 0
        deadline = self.now() + self._config.connect_timeout
        while not decoder.lines:
            if self.now() > deadline:
                raise self._no_board(heard)
            time.sleep(POLL)
            data = self.read_now()
            heard += len(data)
            decoder.feed(data)

    def _no_board(self, heard: int) -> BoardSilentError:
        waited, baud = self._config.connect_timeout, self._config.baud_rate
        if heard:
            others = ", ".join(str(rate) for rate in BAUD_RATES if rate != baud)
            return BoardGarbledError(
                f"{self.device}: {heard} bytes in {waited:g} s at {baud} baud, but no valid line",
                f"the board probably uses another baud_rate ({others})",
            )
        return BoardSilentError(
            f"{self.device}: no byte from the board in {waited:g} s",
            "check its power and cable, and the port's name (acsar-gym doctor lists them)",
        )

    def reset(self, scene: Scene) -> None:
        """Command zero, drop what lies in the buffer, and start the deadlines anew.

        A watchdog that stopped the robot lets it drive again.
        """
        self._stop_motors()
        self._watch_anew()
        self.reset_input()
        self._deadline = self.now()
        self._clear_statistics()

    def _watch_anew(self) -> None:
        dog = self._watchdog
        if dog is None:
            return
        if dog.alive:
            dog.rearm()
            return
        self._watchdog = None
        dog.close()
        self._watch()
        if self._watchdog is not None:
            self._watchdog.wait()

    def write(self, data: bytes) -> None:
        """Send bytes to the board.

        Raises LinkError where they turn wheels and the watchdog has stopped the robot; zeros always
        go out.
        """
        dog = self._watchdog
        if dog is None or not data:
            self._put(data)
        elif data.endswith(self._zeros):
            self._put(data)
            dog.stand()
        else:
            dog.drive()
            self._put(data)
            dog.drive()

    def _put(self, data: bytes) -> None:
        with _translated(self.device):
            self._require().write(data)

    def advance(self, period: float) -> bytes:
        """Sleep until the period's absolute deadline, then take what has arrived.

        After a delay of more than a period the deadlines start anew from now.
        """
        self._deadline += period
        while (remaining := self._deadline - self.now()) > 0.0:
            time.sleep(min(remaining, self._nap))
            self._beat()
        lateness = self.now() - self._deadline
        self.ticks += 1
        self.worst_lateness = max(self.worst_lateness, lateness)
        if lateness > LATE:
            self.late_ticks += 1
        if lateness > period:
            self._deadline = self.now()
        return self.read_now()

    def _beat(self) -> None:
        if self._watchdog is not None:
            self._watchdog.beat()

    def reset_input(self) -> None:
        """Drop what has arrived and wasn't read."""
        with _translated(self.device):
            self._require().reset_input_buffer()

    def read_now(self) -> bytes:
        """What has arrived; waits for nothing."""
        self._beat()
        data = b""
        with _translated(self.device):
            for _ in range(MOST_CHUNKS):
                chunk = self._require().read(CHUNK)
                data += chunk
                if not chunk:
                    break
        return data

    def now(self) -> float:
        """The monotonic clock [s]."""
        return time.monotonic()

    def image(self, width: int, height: int) -> Image | None:
        """A serial port has no camera."""
        return None

    def close(self) -> None:
        """Command zero, let it leave the port, close; twice is once.

        An interrupt while the zeros are on their way sends them again before it goes on.
        """
        port = self._port
        if port is None:
            return
        try:
            self._say_stop(port)
        except BaseException:
            self._say_stop(port)
            raise
        finally:
            self._release(port)

    def _say_stop(self, port: Any) -> None:
        with contextlib.suppress(*PORT_ERRORS):
            port.write(self._stop_line())
            if self._watchdog is not None:
                self._watchdog.stand()
            port.flush()

    def stop(self) -> None:
        """Command zero and stay open; errors are no concern of whoever must stop now."""
        if self._port is not None:
            self._say_stop(self._port)

    def _release(self, port: Any) -> None:
        """The watchdog first: it shares the port's lock."""
        dog, self._watchdog = self._watchdog, None
        try:
            if dog is not None:
                dog.close()
        finally:
            self._port = None
            unguard(self)
            with contextlib.suppress(*PORT_ERRORS):
                port.close()

    def abandon(self) -> None:
        """Let go without a word, as a forked child must do with its parent's port.

        pyserial ends a socket's connection when it closes it, so a child first puts another file
        in its place.
        """
        port = self._port
        if port is None:
            return
        dog, self._watchdog = self._watchdog, None
        if dog is not None:
            dog.abandon()
        if "://" in self.device:
            null = os.open(os.devnull, os.O_RDWR)
            os.dup2(null, port.fileno())
            os.close(null)
        self._release(port)

    def __del__(self) -> None:
        if getattr(self, "_port", None) is not None:
            self.close()

    def __reduce__(self) -> tuple[type[SerialLink], tuple[str, RobotConfig]]:
        """Copies and pickles are closed links to the same device; a port can't be shared."""
        return SerialLink, (self.device, self._config)

    def _stop_motors(self) -> None:
        self.write(self._stop_line())

    def _stop_line(self) -> bytes:
        """The line end first, so that a command cut short can't swallow the zeros."""
        return b"\r\n" + self._zeros

    def _require(self) -> Any:
        if self._port is None:
            raise LinkLostError(f"{self.device} is closed", "call open() or env.reset() first")
        return self._port


def opened(device: str, config: RobotConfig) -> serial.SerialBase:
    """The open port, held exclusively. Raises LinkError, which says what to do."""
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
def _translated(device: str) -> Iterator[None]:
    """Errors of a port in use become LinkLostError."""
    try:
        yield
    except PORT_ERRORS as error:
        raise LinkLostError(
            f"{device}: lost while in use ({error})", "check the cable, then reset"
        ) from None
