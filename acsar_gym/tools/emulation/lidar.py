"""Emulates LiDARs on serial devices: a turning head without any I/O, and a pseudo-terminal.

The RPLIDAR follows SLAMTEC's "Interface Protocol and Application Notes" for the A series.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.tools.emulation.cable import EmulatedCable

Floats = NDArray[np.float64]
Look = Callable[[Floats, Floats], Floats]
"""Ranges [m] at bearings (N,) [rad] in the sensor's frame, counter-clockwise. The second argument
is the time (N,) from each measurement to the end of the period [s]."""
MAX_RANGE = 12.0
"""Larger ranges, inf and NaN are failed measurements [m]."""
SYNC = 0xA5
HAS_PAYLOAD = 0x80
SCAN = 0x20
GET_INFO = 0x50
GET_HEALTH = 0x52
MOTOR_PWM = 0xF0
SINGLE = 0
MULTIPLE = 1
"""Send modes: a single answer, or answers until the next request."""
DEVICE_INFO = bytes((0x18, 16, 1, 7)) + bytes(range(16))
"""Model, minor and major version of the firmware, version of the hardware, serial number."""
NODE_QUALITY = 15
"""Quality of every successful measurement, as an A1 reports it."""
NODE_TYPE = np.dtype([("head", "u1"), ("angle", "<u2"), ("distance", "<u2")])
"""Quality and start flag. Angle [deg / 64] and check bit. Distance [mm / 4]."""


class LidarTwin:
    """The head of an emulated LiDAR. Subclasses speak a maker's language.

    Time passes only in `advance`. Devices measure at a constant rate, and their head turns
    clockwise.

    Args:
        look: Returns the ranges.
        rate: Turns per second [Hz].
        samples: Measurements per turn.

    Attributes:
        running: Whether its motor runs.
        scanning: Whether it sends measurements.
        turns: Number of turns that it has started while it sent measurements.
        pace: Measurements per second [Hz].
    """

    def __init__(self, look: Look, *, rate: float = 5.5, samples: int = 360) -> None:
        self._look = look
        self._rate = rate
        self._samples = samples
        self.running = True
        self.scanning = True
        self.turns = 0
        self.pace = rate * samples

        self._now = 0.0
        self._due = 0.0
        """Measurements that are due, as a fraction of the next one."""
        self._count = 0
        """Measurements since it started to turn."""

    def receive(self, data: bytes) -> bytes:
        """Process bytes from the host."""
        return b""

    def encode(self, degrees: Floats, ranges: Floats, starts: NDArray[np.bool_]) -> bytes:
        """Encode measurements.

        Args:
            degrees: Angles of the head, (N,), from its zero, in the direction in which it turns.
            ranges: Distances (N,) [m]. 0 for a failed measurement.
            starts: Whether each measurement is the first of a turn, (N,).
        """
        raise NotImplementedError

    def advance(self, dt: float) -> bytes:
        """Let `dt` [s] pass.

        Returns:
            The measurements that were made, or became complete, during this time.
        """
        self._now += dt
        self._due += dt * self.pace
        count = int(self._due + 1e-9)
        self._due -= count
        if not self.running:
            return b""
        numbers = self._count + np.arange(count + 1)
        self._count += count
        if not (self.scanning and count):
            return b""

        # A turn starts with the measurement that passes zero.
        turns = self.turn(numbers)
        complete = np.floor(turns)
        starts = np.diff(complete) > 0.0
        self.turns += int(starts.sum())
        degrees = (turns - complete)[1:] * 360.0
        # The newest measurement was made before the end of this time, the others before it.
        ages: Floats = (np.arange(count, dtype=np.float64)[::-1] + self._due) / self.pace
        return self.encode(degrees, self.measure(degrees, ages), starts)

    def turn(self, numbers: NDArray[np.int64]) -> Floats:
        """Return how far the head has turned at the measurements of these numbers [turns]."""
        return numbers / self._samples

    def measure(self, degrees: Floats, ages: Floats) -> Floats:
        """Measure ranges (N,) [m] with the head at these angles. 0 if a measurement fails."""
        ranges = self._look(-np.radians(degrees), ages)
        return np.where((ranges > 0.0) & (ranges <= MAX_RANGE), ranges, 0.0)


class RplidarTwin(LidarTwin):
    """An emulated RPLIDAR without I/O: requests in, answers out.

    The motor runs until it is set to a PWM of 0. EXPRESS_SCAN isn't answered, as by firmware
    before 1.17.

    Args:
        look: Returns the ranges.
        **options: Options of the head, see `LidarTwin`.
    """

    def __init__(self, look: Look, **options: Any) -> None:
        super().__init__(look, **options)
        self.scanning = False
        self._request = bytearray()

    def receive(self, data: bytes) -> bytes:
        """Process bytes from the host. An incomplete request waits for its other bytes.

        Returns:
            The answers to the requests that are now complete.
        """
        answers = b""
        request = self._request
        for byte in data:
            # Bytes before a start flag belong to no request.
            if request or byte == SYNC:
                request.append(byte)
            # Requests have two bytes, or their own length if they have a payload.
            length = 2
            if len(request) > 1 and request[1] & HAS_PAYLOAD:
                length = request[2] + 4 if len(request) > 2 else 4
            if len(request) == length:
                answers += self._answer(bytes(request))
                request.clear()
        return answers

    def _answer(self, request: bytes) -> bytes:
        """Execute a request and return the answer."""
        command = request[1]
        if command & HAS_PAYLOAD:
            # The last byte is the checksum of the others.
            is_valid = functools.reduce(operator.xor, request) == 0
            if is_valid and command == MOTOR_PWM:
                self.running = any(request[3:5])
            return b""

        self.scanning = command == SCAN  # any other request ends a scan
        if self.scanning:
            return encode_descriptor(NODE_TYPE.itemsize, MULTIPLE, 0x81)
        if command == GET_INFO:
            return encode_descriptor(20, SINGLE, 0x04) + DEVICE_INFO
        if command == GET_HEALTH:
            return encode_descriptor(3, SINGLE, 0x06) + bytes(3)
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
    """An emulated LiDAR on a pseudo-terminal. Call `serve_once` periodically."""

    def __init__(self, twin: LidarTwin, *, baud: int = 115200) -> None:
        self.twin = twin
        self._cable = EmulatedCable(baud)
        self.device = self._cable.device

    def serve_once(self, period: float) -> None:
        """Process requests, let `period` [s] pass, and send answers and measurements.

        It doesn't block. Data that nobody reads is dropped, as on a UART.
        """
        request = self._cable.over_uart(self._cable.read())
        answer = self.twin.receive(request) + self.twin.advance(period)
        if answer:
            self._cable.write(self._cable.over_uart(answer))

    def close(self) -> None:
        """Close the terminal. Idempotent."""
        self._cable.pull()
