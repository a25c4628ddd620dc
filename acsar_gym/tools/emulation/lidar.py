"""Emulates LiDARs on serial devices: a turning head without any I/O, and a pseudo-terminal.

The RPLIDAR is after SLAMTEC's "Interface Protocol and Application Notes" for the A series.
"""

from __future__ import annotations

import functools
import math
import operator
import struct
from collections.abc import Callable
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.tools.emulation.cable import EmulatedCable

Floats = NDArray[np.float64]
Look = Callable[[Floats, Floats], Floats]
"""Ranges [m] at bearings (N,) [rad] in the sensor's frame, counter-clockwise, each measured so long
(N,) before the end of the period [s]."""
WOBBLE_TURNS = 10.0
"""Turns in which a wobbling head gets faster and slower once."""
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
NODE_TYPE = np.dtype([("head", "u1"), ("angle", "<u2"), ("distance", "<u2")])
"""Quality and start flag; angle [deg / 64] and check bit; distance [mm / 4]."""


class LidarTwin:
    """The head of an emulated LiDAR; subclasses speak a maker's language.

    Time passes only in `advance`. Devices measure at a constant rate, whatever the speed of their
    head, which turns clockwise; those with `even_angles` at constant angles.

    Attributes: `running`, whether its motor runs; `scanning`, whether it sends measurements;
    `turns`, how many turns it has begun while it did.

    Args:
        look: returns the ranges.
        rate: turns per second [Hz].
        samples: measurements per turn.
        max_range: ranges beyond it [m], inf and NaN count as failed measurements.
        spin_up: time from the start of the motor to full speed [s].
        wobble: share by which its speed rises and falls.

    Raises:
        ConfigError: rate, samples, max_range or wobble is out of range.
    """

    even_angles = False
    farthest_range = math.inf
    """Largest distance that a measurement can encode [m]."""

    def __init__(
        self,
        look: Look,
        *,
        rate: float = 5.5,
        samples: int = 360,
        max_range: float = 12.0,
        spin_up: float = 0.0,
        wobble: float = 0.0,
    ) -> None:
        if not (
            0.0 < rate < math.inf
            and 0.0 < max_range <= self.farthest_range
            and samples > 0
            and 0.0 <= wobble < 1.0
        ):
            raise ConfigError(
                f"rate = {rate} Hz, samples = {samples}, max_range = {max_range} m: must be "
                f"positive, max_range at most {self.farthest_range:g} m, and wobble = {wobble} "
                "from 0 to below 1"
            )
        self._look = look
        self._rate = rate
        self._samples = samples
        self._max_range = max_range
        self._spin_up = spin_up
        self._wobble = wobble
        self.running = self.scanning = True
        self._forced = False
        """Whether it measures at rest as well."""
        self._now = self._spun = self._due = 0.0
        self._count = self.turns = 0
        """Measurements since it began to turn."""

    def receive(self, data: bytes) -> bytes:
        """Process bytes from the host."""
        return b""

    def encode(self, degrees: Floats, ranges: Floats, starts: NDArray[np.bool_]) -> bytes:
        """Encode measurements.

        Args:
            degrees: of the head, (N,), from its zero, as it turns.
            ranges: (N,) [m]; 0 where nothing was measured.
            starts: (N,), whether each is the first one of a turn.
        """
        raise NotImplementedError

    def advance(self, dt: float) -> bytes:
        """Let `dt` [s] pass.

        Returns:
            The measurements that were made, or became complete, during this time.
        """
        pace = self._rate * self._samples
        if self.even_angles:
            pace *= self.speed / self._rate
        self._now += dt
        self._due += dt * pace
        count = int(self._due + 1e-9)
        self._due -= count
        turning = self.running and self._spun >= self._spin_up
        if self.running:
            self._spun += dt
        numbers = self._count + np.arange(count + 1) * turning
        self._count = int(numbers[-1])
        if not (self.scanning and (turning or self._forced) and count):
            return b""
        turns = numbers / self._samples
        if self._wobble and not self.even_angles:
            share = 2.0 * np.pi / WOBBLE_TURNS
            turns = turns + self._wobble / share * np.sin(turns * share)
        whole = np.floor(turns)
        degrees = (turns - whole)[1:] * 360.0
        ages: Floats = (np.arange(count, dtype=np.float64)[::-1] + self._due) / pace
        starts = np.diff(whole) > 0.0
        self.turns += int(starts.sum())
        return self.encode(degrees, self.measure(degrees, ages), starts)

    def measure(self, degrees: Floats, ages: Floats) -> Floats:
        """Measure ranges (N,) [m] with the head at these angles; 0 where nothing is measured."""
        ranges = self._look(-np.radians(degrees), ages)
        return np.where((ranges > 0.0) & (ranges <= self._max_range), ranges, 0.0)

    @property
    def speed(self) -> float:
        """Turns per second [Hz]."""
        share = 2.0 * math.pi / WOBBLE_TURNS
        return self._rate * (1.0 + self._wobble * math.cos(self._now * self._rate * share))


class RplidarTwin(LidarTwin):
    """An emulated RPLIDAR without I/O: requests in, answers out.

    The motor runs until it is set to a PWM of 0. A head at rest measures only after FORCE_SCAN.
    EXPRESS_SCAN isn't answered, as by firmware before 1.17.

    Attributes: `pwm`, of the motor, 0 to 1023.

    Args:
        look: returns the ranges.
        broken: report an error and refuse to scan ("protection stop").
        **options: of the head, see `LidarTwin`.
    """

    farthest_range = 0xFFFF / 4000.0

    def __init__(self, look: Look, *, broken: bool = False, **options: Any) -> None:
        super().__init__(look, **options)
        self._broken = broken
        self.pwm = DEFAULT_PWM
        self.scanning = False
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
                self.running = self.pwm > 0
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

    def encode(self, degrees: Floats, ranges: Floats, starts: NDArray[np.bool_]) -> bytes:
        """Encode measurements, five bytes each."""
        nodes = np.zeros(len(degrees), NODE_TYPE)
        nodes["head"] = np.where(ranges > 0.0, NODE_QUALITY << 2, 0) | np.where(starts, 1, 2)
        nodes["angle"] = np.rint(degrees * 64.0).astype(np.uint16) << 1 | 1
        nodes["distance"] = np.rint(ranges * 4000.0)
        return nodes.tobytes()


def encode_descriptor(length: int, mode: int, kind: int) -> bytes:
    """Encode the response descriptor for answers of `length` bytes."""
    return b"\xa5\x5a" + struct.pack("<IB", length | mode << 30, kind)


class LidarEmulator:
    """An emulated LiDAR on a pseudo-terminal; call `serve_once` periodically.

    Raises:
        ConfigError: for unknown baud rates.
    """

    def __init__(self, twin: LidarTwin, *, baud: int = 115200) -> None:
        self.twin = twin
        self._cable = EmulatedCable(baud)
        self.device = self._cable.device

    def serve_once(self, period: float) -> None:
        """Process requests, let `period` [s] pass, and send answers and measurements.

        It doesn't block; data that nobody reads is dropped, as on a UART.
        """
        request = self._cable.over_uart(self._cable.read())
        answer = self.twin.receive(request) + self.twin.advance(period)
        if answer:
            self._cable.write(self._cable.over_uart(answer))

    def close(self) -> None:
        """Close the terminal. Idempotent."""
        self._cable.pull()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
