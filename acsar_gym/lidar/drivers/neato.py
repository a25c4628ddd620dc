"""The LiDARs of Neato's XV-11 and Xiaomi's vacuum cleaners. They measure once a degree.

A packet of 22 bytes has 4 measurements, the head's speed and a checksum. These LiDARs have no
commands. Their motor needs a driver board, which keeps it at about 300 turns per minute.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from acsar_gym.lidar.serial import LibraryDriver, Packet

POINTS = 4
FIRST_INDEX = 0xA0  # index of the packet at 0 degrees
PACKETS = 90  # of a revolution
NOMINAL_SPEED = 5.0  # if a packet doesn't have it [turns/s]


class NeatoDriver(LibraryDriver):
    """An XV-11, or a LiDAR of the same design."""

    library = "neato_xv11"
    models: ClassVar[Mapping[str, str]] = {
        "neato": "NeatoXV11",
        "neato_xv11": "NeatoXV11",
        "lds01rr": "LDS01RR",
        "lds02rr": "LDS01RR",  # but for the direction
    }
    header = b"\xfa"
    packet_bytes = 22

    def __init__(self, model: str) -> None:
        super().__init__(model)
        self.clockwise = model == "lds02rr"
        if self.clockwise:
            self.product = "Xiaomi LDS02RR"

    def forget(self) -> None:
        """Forget the index of the newest packet."""
        self._index: int | None = None

    def decode(self, data: bytes) -> Packet | None:
        """Decode a packet of 22 bytes."""
        index = data[1] - FIRST_INDEX
        if not (0 <= index < PACKETS and self._library.valid_packet(data)):
            return None
        # The head's speed gives the duration, as measurements are a degree apart.
        speed, points = self._library.parse_packet(data, self.clockwise)
        gap = self._index not in (None, (index - 1) % PACKETS)
        self._index = index
        return Packet(
            angles=[point.angle_deg for point in points],
            distances=[point.dist_mm for point in points],
            duration=POINTS / 360.0 / (speed or NOMINAL_SPEED),
            start=None if index else 0,
            gap=gap,
        )
