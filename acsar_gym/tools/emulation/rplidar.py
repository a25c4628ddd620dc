"""Emulates an RPLIDAR: its protocol without any I/O, and the device on a pseudo-terminal.

After SLAMTEC's "Interface Protocol and Application Notes" for the A series.
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
LidarFault = Literal["silent", "garbage"]

REQUEST_CHUNK = 4096
SYNC = 0xA5
HAS_PAYLOAD = 0x80
STOP, RESET, SCAN, FORCE_SCAN = 0x25, 0x40, 0x20, 0x21
GET_INFO, GET_HEALTH, GET_SAMPLERATE = 0x50, 0x52, 0x59
MOTOR_PWM = 0xF0
DEFAULT_PWM = 660
SINGLE, MULTIPLE = 0, 1
"""Send modes: a single answer, or answers until the next request."""
MODEL_NUMBER = 0x18
FIRMWARE_VERSION = (1, 16)
HARDWARE_VERSION = 7
SERIAL_NUMBER = bytes(range(16))
NODE_QUALITY = 15
"""Quality of every successful measurement, as an A1 reports it."""
FARTHEST_RANGE = 0xFFFF / 4000.0
"""Largest distance that a measurement can encode [m]."""
NODE_TYPE = np.dtype([("head", "u1"), ("angle", "<u2"), ("distance", "<u2")])
"""Quality and start flag; angle [deg / 64] and check bit; distance [mm / 4]."""
OTHER_DEVICE = b"$GPGGA,120000.00,5230.0,N,01322.0,E,1,08,0.9,34.0,M,,M,,*47\r\n"
"""Sent in the fault mode "garbage": the output of a GPS receiver."""


class RplidarTwin:
    """An emulated RPLIDAR without I/O: requests in, answers out; time passes only in `advance`.

    The motor runs until it is set to a PWM of 0. EXPRESS_SCAN isn't answered, as by firmware before
    1.17.

    Args:
        look: returns ranges [m] at bearings (N,) [rad] in the sensor's frame,
            counter-clockwise.
        rate: turns per second [Hz].
        samples: measurements per turn.
        max_range: ranges beyond it [m], inf and NaN count as failed measurements.
        spin_up: time from the start of the motor to full speed [s].
        broken: report an error and refuse to scan ("protection stop").

    Raises:
        ConfigError: rate, samples or max_range is out of range.
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
        if not (0.0 < rate < math.inf and 0.0 < max_range <= FARTHEST_RANGE and samples > 0):
            raise ConfigError(
                f"rate = {rate} Hz, samples = {samples}, max_range = {max_range} m: must be "
                f"positive, and max_range at most {FARTHEST_RANGE:g} m"
            )
        self._look = look
        self._rate = rate
        self._samples = samples
        self._max_range = max_range
        self._spin_up = spin_up
        self._broken = broken
        self.pwm = DEFAULT_PWM
        """PWM of the motor, 0 to 1023."""
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
        """Process bytes from the host; an incomplete request waits for the rest of it.

        Args:
            data: any part of the byte stream.

        Returns:
            The answers to the requests that are now complete.
        """
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
        """Return whether the received bytes form a complete request."""
        request = self._request
        if len(request) < 2:
            return False
        if not request[1] & HAS_PAYLOAD:
            return True
        return len(request) > 2 and len(request) == request[2] + 4

    def _answer(self, request: bytes) -> bytes:
        """Execute a request and return the answer."""
        command, payload = request[1], request[3:-1]
        if command & HAS_PAYLOAD:
            if functools.reduce(operator.xor, request) == 0 and command == MOTOR_PWM:
                self._drive(*struct.unpack("<H", payload[:2].ljust(2, b"\0")))
            return b""
        self.scanning = self._forced = False  # any request ends a scan
        if command in (SCAN, FORCE_SCAN) and not self._broken:
            self.scanning, self._forced = True, command == FORCE_SCAN
            return encode_descriptor(NODE_TYPE.itemsize, MULTIPLE, 0x81)
        if command == GET_INFO:
            info = (
                bytes((MODEL_NUMBER, FIRMWARE_VERSION[1], FIRMWARE_VERSION[0], HARDWARE_VERSION))
                + SERIAL_NUMBER
            )
            return encode_descriptor(20, SINGLE, 0x04) + info
        if command == GET_HEALTH:
            status = (2, 0x8001) if self._broken else (0, 0)
            return encode_descriptor(3, SINGLE, 0x06) + struct.pack("<BH", *status)
        if command == GET_SAMPLERATE:
            each = min(round(1e6 / (self._rate * self._samples)), 0xFFFF)
            return encode_descriptor(4, SINGLE, 0x15) + struct.pack("<HH", each, each)
        return b""  # STOP, RESET and unknown requests

    def _drive(self, pwm: int) -> None:
        """Set the PWM of the motor; from standstill it spins up anew."""
        if self.pwm == 0:
            self._spun = 0.0
        self.pwm = pwm

    def advance(self, dt: float) -> bytes:
        """Let `dt` [s] pass.

        Returns:
            The measurements made during this time. A head at rest measures only after
            FORCE_SCAN.
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
        """Measure at the given head positions, and encode the measurements."""
        degrees = heads * (360.0 / self._samples)
        ranges = self._look(-np.radians(degrees))
        measured = (ranges > 0.0) & (ranges <= self._max_range)
        starts = (heads == 0) & turning
        nodes = np.zeros(len(heads), NODE_TYPE)
        nodes["head"] = np.where(measured, NODE_QUALITY << 2, 0) | np.where(starts, 1, 2)
        nodes["angle"] = np.rint(degrees * 64.0).astype(np.uint16) << 1 | 1
        nodes["distance"] = np.rint(np.where(measured, ranges, 0.0) * 4000.0)
        return nodes.tobytes()


def encode_descriptor(length: int, mode: int, kind: int) -> bytes:
    """Encode the response descriptor for answers of `length` bytes."""
    return b"\xa5\x5a" + struct.pack("<IB", length | mode << 30, kind)


class RplidarEmulator:
    """An emulated RPLIDAR on a pseudo-terminal; call `serve_once` periodically.

    Args:
        twin: the emulated sensor.
        baud: baud rate of the sensor.
        fault: "silent" never answers, "garbage" sends what a device of another kind would.

    Attributes:
        device: path that a driver opens.

    Raises:
        ConfigError: for unknown baud rates and faults.
    """

    def __init__(
        self, twin: RplidarTwin, *, baud: int = 115200, fault: LidarFault | None = None
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
        """Process requests, let `period` [s] pass, and send answers and measurements.

        It doesn't block; data that nobody reads is dropped, as on a UART.
        """
        request = b""
        with contextlib.suppress(BlockingIOError):
            request = self._over_uart(os.read(self._master, REQUEST_CHUNK))
        answer = self.twin.receive(request) + self.twin.advance(period)
        if self._fault == "garbage":
            answer = OTHER_DEVICE
        if answer and self._fault != "silent":
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, self._over_uart(answer))

    def _over_uart(self, data: bytes) -> bytes:
        """Transfer bytes over the UART, which garbles them if the baud rates differ."""
        if termios.tcgetattr(self._slave)[4] == self._baud_code:
            return data
        return bytes((byte * 7 + 0x80) & 0xFF | 0x80 for byte in data)

    def close(self) -> None:
        """Close the terminal. Idempotent."""
        descriptors, self._descriptors = self._descriptors, ()
        for each in descriptors:
            os.close(each)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
