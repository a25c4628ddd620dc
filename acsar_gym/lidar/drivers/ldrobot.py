"""LiDARs of LDROBOT: LD06, LD19, STL19P, LD14P. They measure at a constant rate.

A packet of 47 bytes has 12 measurements, the head's speed, a time stamp and a checksum. Only the
LD14P takes commands; the others measure as soon as they have power, and turn until it is off.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, ClassVar

from acsar_gym.lidar.serial import Driver, Outbox, Packet, load_lds2d

PACKET_BYTES, POINTS = 47, 12
HEADER = b"\x54\x2c"
STAMP_AT = 44  # place of the time stamp in a packet
STAMP_WRAP = 30_000  # the time stamp starts again at zero there [ms]
MAX_PACKET_TIME = 100  # else others were lost, or the time stamp says nothing [ms]
NOMINAL_RATE = 4500.0  # measurements per second of an LD06
COMMANDED = "ld14p"  # the model that takes commands


class LdrobotDriver(Driver):
    """A LiDAR of LDROBOT."""

    models: ClassVar[Mapping[str, str]] = {
        "ld06": "LD06",
        "ld14p": "LD14P",
        "ld19": "LD19",
        "stl19p": "STL19P",
    }

    def __init__(self, model: str) -> None:
        super().__init__(model)
        self._library = load_lds2d().ldrobot_ld14p
        self._kind = getattr(self._library, self.models[model])
        self.product = self._kind.MODEL_NAME
        self.forget()

    def forget(self) -> None:
        """Forget where and when the newest packet ended."""
        self._angle: float | None = None
        self._stamp: int | None = None

    def start(self, port: Any) -> None:
        """Set the baud rate; start the motor of an LD14P."""
        self.set_baud_rate(port, self._kind.DEFAULT_BAUD)
        if self.model == COMMANDED:
            self._kind(Outbox(port)).start()

    def stop(self, port: Any) -> None:
        """Stop the motor of an LD14P."""
        if self.model == COMMANDED:
            self._kind(Outbox(port)).stop()

    def parse(self, data: bytearray, at: int) -> tuple[int, Packet | None]:
        """Find a packet of 47 bytes."""
        if not HEADER.startswith(data[at : at + len(HEADER)]):
            return 1, None
        packet = bytes(data[at : at + PACKET_BYTES])
        if len(packet) < PACKET_BYTES:
            return 0, None
        if self._library.crc8(packet[:-1]) != packet[-1]:
            return 1, None
        rate, points = self._library.parse_packet(packet)
        angles = [point.angle_deg for point in points]
        span = (angles[-1] - angles[0]) % 360.0
        step = span / (POINTS - 1)
        before, self._angle = self._angle, angles[-1]
        gap = False
        if before is not None:
            jump = (angles[0] - before - step + 180.0) % 360.0 - 180.0
            gap = abs(jump) > span / 2.0
        turned = [angles[0] if before is None or gap else before, *angles]
        start = next((k for k in range(POINTS) if turned[k + 1] < turned[k] - 180.0), None)
        (stamp,) = struct.unpack_from("<H", packet, STAMP_AT)
        took = (stamp - self._stamp) % STAMP_WRAP if self._stamp is not None else 0
        self._stamp = stamp
        duration = took / 1000.0
        if gap or not 0 < took <= MAX_PACKET_TIME:
            duration = POINTS * step / (rate * 360.0) if rate and step else POINTS / NOMINAL_RATE
        distances = [point.dist_mm for point in points]
        return PACKET_BYTES, Packet(angles, distances, duration, start, gap)
