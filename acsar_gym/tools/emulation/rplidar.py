"""Emulates an RPLIDAR: its protocol without any I/O, and the device on a pseudo-terminal.

After SLAMTEC's "Interface Protocol and Application Notes" for the A series.
"""

from __future__ import annotations

import functools
import math
import operator
import struct
from collections.abc import Callable
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.tools.emulation.cable import EmulatedCable

Floats = NDArray[np.float64]
LidarFault = Literal["silent", "garbage"]

SYNC = 0xA5
HAS_PAYLOAD = 0x80
SCAN, FORCE_SCAN = 0x20, 0x21
GET_INFO, GET_HEALTH, GET_SAMPLERATE = 0x50, 0x52, 0x59
MOTOR_PWM = 0xF0
DEFAULT_PWM = 660
SINGLE, MULTIPLE = 0, 1
"""Send modes: a single answer, or answers until the next request."""
DEVICE_INFO = bytes((0x18, 16, 1, 7)) + bytes(range(16))
"""Model, minor and major version of the firmware, version of the hardware, serial number."""
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

    Attributes: `pwm`, of the motor, 0 to 1023; `scanning`, whether it sends measurements.

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
        self.scanning = self._forced = False
        self._spun = self._due = 0.0
        self._head = 0
        self._request = bytearray()

    def receive(self, data: bytes) -> bytes:
        """Process bytes from the host; an incomplete request waits for the rest of it.

        Returns:
            The answers to the requests that are now complete.
        """
        answers = b""
        request = self._request
        for byte in data:
            if request or byte == SYNC:
                request.append(byte)
            has_payload = len(request) > 1 and request[1] & HAS_PAYLOAD
            length = (request[2] + 4 if len(request) > 2 else 4) if has_payload else 2
            if len(request) == length:
                answers += self._answer(bytes(request))
                request.clear()
        return answers

    def _answer(self, request: bytes) -> bytes:
        """Execute a request and return the answer."""
        command, payload = request[1], request[3:-1]
        if command & HAS_PAYLOAD:
            if functools.reduce(operator.xor, request) == 0 and command == MOTOR_PWM:
                if self.pwm == 0:  # it spins up anew
                    self._spun = 0.0
                (self.pwm,) = struct.unpack("<H", payload[:2].ljust(2, b"\0"))
            return b""
        self.scanning = self._forced = False  # any request ends a scan
        if command in (SCAN, FORCE_SCAN) and not self._broken:
            self.scanning, self._forced = True, command == FORCE_SCAN
            return encode_descriptor(NODE_TYPE.itemsize, MULTIPLE, 0x81)
        if command == GET_INFO:
            return encode_descriptor(20, SINGLE, 0x04) + DEVICE_INFO
        if command == GET_HEALTH:
            status = (2, 0x8001) if self._broken else (0, 0)
            return encode_descriptor(3, SINGLE, 0x06) + struct.pack("<BH", *status)
        if command == GET_SAMPLERATE:
            each = min(round(1e6 / (self._rate * self._samples)), 0xFFFF)
            return encode_descriptor(4, SINGLE, 0x15) + struct.pack("<HH", each, each)
        return b""  # STOP, RESET and unknown requests

    def advance(self, dt: float) -> bytes:
        """Let `dt` [s] pass.

        Returns:
            The measurements made during this time. A head at rest measures only after
            FORCE_SCAN.
        """
        self._due += dt * self._rate * self._samples
        count = int(self._due + 1e-9)
        self._due -= count
        turning = self.pwm > 0 and self._spun >= self._spin_up
        if self.pwm > 0:
            self._spun += dt
        heads = (self._head + np.arange(1, count + 1) * turning) % self._samples
        if count:
            self._head = int(heads[-1])
        if not (self.scanning and (turning or self._forced)):
            return b""
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
        if fault not in (None, "silent", "garbage"):
            raise ConfigError(f"fault = {fault!r}: must be 'silent', 'garbage' or None")
        self.twin = twin
        self._fault = fault
        self._cable = EmulatedCable(baud)
        self.device = self._cable.device

    def serve_once(self, period: float) -> None:
        """Process requests, let `period` [s] pass, and send answers and measurements.

        It doesn't block; data that nobody reads is dropped, as on a UART.
        """
        request = self._cable.over_uart(self._cable.read())
        answer = self.twin.receive(request) + self.twin.advance(period)
        if self._fault == "garbage":
            answer = OTHER_DEVICE
        if answer and self._fault != "silent":
            self._cable.write(self._cable.over_uart(answer))

    def close(self) -> None:
        """Close the terminal. Idempotent."""
        self._cable.pull()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
