"""An RPLIDAR's twin: its wire protocol without any I/O, and the same on a pseudo-terminal.

After SLAMTEC's "Interface Protocol and Application Notes" for the A series. Whoever opens the
device talks to it as to a sensor on a serial adapter.
"""

from __future__ import annotations

import contextlib
import functools
import math
import operator
import os
import pty
import struct
import termios
import tty
from collections.abc import Callable
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError

Floats = NDArray[np.float64]
Fault = Literal["silent", "garbage"]

CHUNK = 4096
SYNC = 0xA5
HAS_PAYLOAD = 0x80
STOP, RESET, SCAN, FORCE_SCAN = 0x25, 0x40, 0x20, 0x21
GET_INFO, GET_HEALTH, GET_SAMPLERATE = 0x50, 0x52, 0x59
MOTOR_PWM = 0xF0
DEFAULT_PWM = 660
SINGLE, MULTIPLE = 0, 1
"""Send modes: one answer, or measurements until the next request."""
MODEL = 0x18
FIRMWARE = (1, 16)
HARDWARE = 7
SERIAL_NUMBER = bytes(range(16))
QUALITY = 15
"""Of every measurement that succeeded, as an A1 gives it."""
FARTHEST = 0xFFFF / 4000.0
"""What a measurement can hold [m]."""
NODE = np.dtype([("head", "u1"), ("angle", "<u2"), ("distance", "<u2")])
"""Quality and start flag; angle [deg / 64] and check bit; distance [mm / 4]."""
OTHER_DEVICE = b"$GPGGA,120000.00,5230.0,N,01322.0,E,1,08,0.9,34.0,M,,M,,*47\r\n"
"""What `garbage` is: a receiver of another kind."""


class RplidarTwin:
    """Bytes in, bytes out; time passes in `advance` only.

    `look` gives the ranges [m] at bearings [rad] in the sensor's frame, counter-clockwise from its
    zero; inf, nan and what is beyond `max_range` [m] isn't measured. The head makes `rate` turns a
    second of `samples` measurements each, once it has spun up for `spin_up` [s]; the motor is on
    until a PWM of 0. A `broken` one is in protection stop: it reports an error and won't scan.
    EXPRESS_SCAN gets no answer, as from firmware before 1.17.
    """

    def __init__(
        self,
        look: Callable[[Floats], Floats],
        *,
        rate: float = 5.5,
        samples: int = 360,
        max_range: float = 12.0,
        spin_up: float = 0.0,
        broken: bool = False,
    ) -> None:
        if not (0.0 < rate < math.inf and 0.0 < max_range <= FARTHEST and samples > 0):
            raise ConfigError(
                f"rate = {rate} Hz, samples = {samples}, max_range = {max_range} m: must be "
                f"positive, and max_range at most {FARTHEST:g} m"
            )
        self._look = look
        self._rate = rate
        self._samples = samples
        self._max_range = max_range
        self._spin_up = spin_up
        self._broken = broken
        self.pwm = DEFAULT_PWM
        """Of the motor, 0 to 1023."""
        self.scanning = False
        self._forced = False
        self._spun = 0.0
        self._due = 0.0
        self._head = 0
        self._request = bytearray()

    @property
    def turning(self) -> bool:
        """Whether the head turns at full speed."""
        return self.pwm > 0 and self._spun >= self._spin_up

    def receive(self, data: bytes) -> bytes:
        """The answers to what a host sends; half a request waits for the rest of it."""
        answers = b""
        for byte in data:
            if self._request or byte == SYNC:
                self._request.append(byte)
            if self._is_complete():
                request = bytes(self._request)
                self._request.clear()
                answers += self._answer(request)
        return answers

    def _is_complete(self) -> bool:
        request = self._request
        if len(request) < 2:
            return False
        if not request[1] & HAS_PAYLOAD:
            return True
        return len(request) > 2 and len(request) == request[2] + 4

    def _answer(self, request: bytes) -> bytes:
        command, payload = request[1], request[3:-1]
        if command & HAS_PAYLOAD:
            if functools.reduce(operator.xor, request) == 0 and command == MOTOR_PWM:
                self._drive(*struct.unpack("<H", payload[:2].ljust(2, b"\0")))
            return b""
        self.scanning = self._forced = False  # any request ends a scan
        if command in (SCAN, FORCE_SCAN) and not self._broken:
            self.scanning, self._forced = True, command == FORCE_SCAN
            return descriptor(NODE.itemsize, MULTIPLE, 0x81)
        if command == GET_INFO:
            info = bytes((MODEL, FIRMWARE[1], FIRMWARE[0], HARDWARE)) + SERIAL_NUMBER
            return descriptor(20, SINGLE, 0x04) + info
        if command == GET_HEALTH:
            status = (2, 0x8001) if self._broken else (0, 0)
            return descriptor(3, SINGLE, 0x06) + struct.pack("<BH", *status)
        if command == GET_SAMPLERATE:
            each = min(round(1e6 / (self._rate * self._samples)), 0xFFFF)
            return descriptor(4, SINGLE, 0x15) + struct.pack("<HH", each, each)
        return b""  # STOP, RESET and what it doesn't know

    def _drive(self, pwm: int) -> None:
        if self.pwm == 0:
            self._spun = 0.0
        self.pwm = pwm

    def advance(self, dt: float) -> bytes:
        """Let `dt` [s] pass; the measurements made in it.

        A standing head measures only where it is forced to.
        """
        self._due += dt * self._rate * self._samples
        count = int(self._due + 1e-9)
        self._due -= count
        turning = self.turning
        if self.pwm > 0:
            self._spun += dt
        heads = (self._head + np.arange(1, count + 1) * turning) % self._samples
        if count:
            self._head = int(heads[-1])
        return self._nodes(heads, turning) if self.scanning and (turning or self._forced) else b""

    def _nodes(self, heads: NDArray[np.int64], turning: bool) -> bytes:
        degrees = heads * (360.0 / self._samples)
        ranges = self._look(-np.radians(degrees))
        measured = (ranges > 0.0) & (ranges <= self._max_range)
        starts = (heads == 0) & turning
        nodes = np.zeros(len(heads), NODE)
        nodes["head"] = np.where(measured, QUALITY << 2, 0) | np.where(starts, 1, 2)
        nodes["angle"] = np.rint(degrees * 64.0).astype(np.uint16) << 1 | 1
        nodes["distance"] = np.rint(np.where(measured, ranges, 0.0) * 4000.0)
        return nodes.tobytes()


def descriptor(length: int, mode: int, kind: int) -> bytes:
    """What announces answers of `length` bytes: 30 bits of length, 2 of mode, 8 of kind."""
    return b"\xa5\x5a" + struct.pack("<IB", length | mode << 30, kind)


class RplidarEmulator:
    """A twin on a pseudo-terminal; `device` is what a driver opens, at `baud`.

    A `silent` one never answers, and `garbage` is a device of another kind. Whoever embeds it
    calls `serve_once` in their own loop.
    """

    def __init__(
        self, twin: RplidarTwin, *, baud: int = 115200, fault: Fault | None = None
    ) -> None:
        code = getattr(termios, f"B{baud}", None)
        if code is None:
            raise ConfigError(f"baud = {baud}: must be a rate that a terminal knows, as 115200")
        if fault not in (None, "silent", "garbage"):
            raise ConfigError(f"fault = {fault!r}: must be 'silent', 'garbage' or None")
        self.twin = twin
        self._baud_code = code
        self._fault = fault
        self._descriptors: tuple[int, ...]
        self._master, self._slave = self._descriptors = pty.openpty()
        tty.setraw(self._slave)
        attributes = termios.tcgetattr(self._slave)
        attributes[4] = attributes[5] = code
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)

    def serve_once(self, period: float) -> None:
        """Take requests, let `period` [s] pass, send answers and measurements; waits for nothing.

        What nobody reads is dropped, as a UART does it.
        """
        request = b""
        with contextlib.suppress(BlockingIOError):
            request = self._over_uart(os.read(self._master, CHUNK))
        answer = self.twin.receive(request) + self.twin.advance(period)
        if self._fault == "garbage":
            answer = OTHER_DEVICE
        if answer and self._fault != "silent":
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, self._over_uart(answer))

    def _over_uart(self, data: bytes) -> bytes:
        """The bytes as the other side sees them: garbage where the baud rates differ."""
        if termios.tcgetattr(self._slave)[4] == self._baud_code:
            return data
        return bytes((byte * 7 + 0x80) & 0xFF | 0x80 for byte in data)

    def close(self) -> None:
        """Close the terminal; twice is once."""
        descriptors, self._descriptors = self._descriptors, ()
        for each in descriptors:
            os.close(each)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
