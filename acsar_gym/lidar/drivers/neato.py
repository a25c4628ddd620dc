"""The LiDARs of Neato's XV-11 and Xiaomi's vacuum cleaners. They measure once a degree.

A packet of 22 bytes has 4 measurements, the head's speed and a checksum. They take no commands, and
their motor needs a driver board of its own, which keeps it at about 300 turns per minute.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from acsar_gym.lidar.serial import Driver, Packet, load_lds2d

PACKET_BYTES, POINTS = 22, 4
COMMAND = 0xFA
FIRST_INDEX, PACKETS = 0xA0, 90  # index of the packet at 0 degrees, and how many a revolution has
NOMINAL_SPEED = 5.0  # turns per second, if a packet says nothing of it [Hz]


class NeatoDriver(Driver):
    """An XV-11, or one that is built like it."""

    models: ClassVar[Mapping[str, str]] = {
        "neato": "NeatoXV11",
        "neato_xv11": "NeatoXV11",
        "lds01rr": "LDS01RR",
        "lds02rr": "LDS02RR",
    }

    def __init__(self, model: str) -> None:
        super().__init__(model)
        drivers = load_lds2d()
        self.clockwise = model == "lds02rr"
        self._library = drivers.xiaomi_lds02rr if self.clockwise else drivers.neato_xv11
        kind = getattr(self._library, self.models[model])
        self.product, self._baud_rate = kind.MODEL_NAME, kind.DEFAULT_BAUD
        self.forget()

    def forget(self) -> None:
        """Forget the index of the newest packet."""
        self._index: int | None = None

    def start(self, port: Any) -> None:
        """Set the baud rate."""
        self.set_baud_rate(port, self._baud_rate)

    def parse(self, data: bytearray, at: int) -> tuple[int, Packet | None]:
        """Find a packet of 22 bytes."""
        if data[at] != COMMAND:
            return 1, None
        packet = bytes(data[at : at + PACKET_BYTES])
        if len(packet) < PACKET_BYTES:
            return 0, None
        index = packet[1] - FIRST_INDEX
        if not (0 <= index < PACKETS and self._library.valid_packet(packet)):
            return 1, None
        speed, points = self._library.parse_packet(packet)
        gap = self._index is not None and index != (self._index + 1) % PACKETS
        self._index = index
        duration = POINTS / 360.0 / (speed or NOMINAL_SPEED)
        angles, distances = [p.angle_deg for p in points], [p.dist_mm for p in points]
        return PACKET_BYTES, Packet(angles, distances, duration, None if index else 0, gap)
