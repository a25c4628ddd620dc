"""LiDARs of LDROBOT: LD06, LD19, STL19P, LD14P. They measure at a constant rate.

A packet of 47 bytes has 12 measurements and a checksum. Only the LD14P has commands. The other
models measure and turn while they have power.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from acsar_gym.lidar.serial import LibraryDriver, Packet, find_start, wrap_degrees
from acsar_gym.links.ports import OpenPort

POINTS = 12


class LdrobotDriver(LibraryDriver):
    """A LiDAR of LDROBOT."""

    library = "ldrobot_ld14p"
    models: ClassVar[Mapping[str, str]] = {
        "ld06": "LD06",
        "ld14p": "LD14P",
        "ld19": "LD19",
        "stl19p": "STL19P",
    }
    header = b"\x54\x2c"
    packet_bytes = 47

    def __init__(self, model: str) -> None:
        super().__init__(model)
        self._has_commands = model == "ld14p"

    def forget(self) -> None:
        """Forget the end of the newest packet."""
        self._angle: float | None = None

    def start(self, port: OpenPort) -> None:
        """Set the baud rate, and start the motor of an LD14P."""
        super().start(port)
        if self._has_commands:
            self._kind(port).start()

    def stop(self, port: OpenPort) -> None:
        """Stop the motor of an LD14P."""
        if self._has_commands:
            self._kind(port).stop()

    def decode(self, data: bytes) -> Packet | None:
        """Decode a packet of 47 bytes."""
        if self._library.crc8(data[:-1]) != data[-1]:
            return None
        _, points = self._library.parse_packet(data)
        angles = [point.angle_deg for point in points]
        distances = [point.dist_mm for point in points]

        # A packet continues the previous packet, unless some were lost in between.
        span = (angles[-1] - angles[0]) % 360.0
        previous = self._angle
        self._angle = angles[-1]
        gap = previous is not None and (
            abs(wrap_degrees(angles[0] - previous - span / (POINTS - 1))) > span / 2.0
        )
        # The first packet after a gap can't show whether its first angle starts a turn.
        if previous is None or gap:
            previous = angles[0]
        start = find_start(previous, angles)
        return Packet(angles, distances, float(POINTS), start=start, gap=gap)
