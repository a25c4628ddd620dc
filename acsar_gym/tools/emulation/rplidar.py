"""Emulates an RPLIDAR's protocol.

After SLAMTEC's "Interface Protocol and Application Notes" for the A series.
"""

from __future__ import annotations

import functools
import operator
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.tools.emulation.lidar import Floats, LidarTwin, Look

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
