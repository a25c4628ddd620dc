"""LiDARs of YDLIDAR: X2, X3, X4, X4 PRO, SCL, T-minis. They measure at a constant rate.

A packet has up to 40 measurements between its first and its last angle, and a checksum. The adapter
boards of these LiDARs switch the motor by DTR. An X4 also has commands.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, ClassVar

from acsar_gym.lidar.serial import NO_MEASUREMENTS, LibraryDriver, Packet, wrap_degrees
from acsar_gym.links.ports import OpenPort

MAX_BYTES = 130  # of a packet: a header of ten bytes, and 40 measurements of three bytes
MAX_JUMP = 3.0  # larger angles between two packets lack measurements [deg]


class YdlidarDriver(LibraryDriver):
    """A LiDAR of YDLIDAR. "ydlidar" is an X4."""

    library = "ydlidar"
    models: ClassVar[Mapping[str, str]] = {
        "ydlidar": "YDLidarX4",
        "ydlidar_x2": "YDLidarX2X2L",
        "ydlidar_x2l": "YDLidarX2X2L",
        "ydlidar_x3": "YDLidarX3",
        "ydlidar_x3_pro": "YDLidarX3Pro",
        "ydlidar_x4": "YDLidarX4",
        "ydlidar_x4_pro": "YDLidarX4Pro",
        "ydlidar_scl": "YDLidarSCL",
        "ydlidar_tmini": "YDLidarTmini",
        "ydlidar_tmini_plus": "YDLidarTmini",
        "ydlidar_tmini_pro": "YDLidarTmini",
    }
    greeting = bytes.fromhex("a5 5a 05 00 00 40 81")  # of an X4, before its head turns

    def __init__(self, model: str) -> None:
        super().__init__(model)
        self._decoders = [self._kind(None)]
        if self._kind is self._library.YDLidarTmini:
            self._decoders.insert(0, make_intensity_decoder(self._library))

    def forget(self) -> None:
        """Forget the end of the newest packet."""
        self._angle: float | None = None
        self._step = 0.0

    def start(self, port: OpenPort) -> None:
        """Set the baud rate, and start motor and scan."""
        super().start(port)
        port.set_dtr(on=True)
        self._kind(port).start()

    def stop(self, port: OpenPort) -> None:
        """Stop scan and motor."""
        try:
            self._kind(port).stop()
        finally:
            port.set_dtr(on=False)

    def parse(self, data: bytearray, at: int) -> tuple[int, Packet | None]:
        """Find a packet of a header of ten bytes, and two or three bytes for each measurement."""
        if data.startswith(self.greeting, at):
            return len(self.greeting), NO_MEASUREMENTS
        packet = data[at : at + MAX_BYTES]
        for decoder in self._decoders:  # the checksum shows which decoder a packet is for
            size, decoded = decoder._try_parse(packet)  # noqa: SLF001
            if size != 1:
                break
        if decoded is None:
            return size, None
        kind, count, first, last = struct.unpack_from("<BBHH", packet, 2)

        # The head's angles. Those of the measurements allow for the lens beside the laser.
        gap = False
        if count > 1:
            self._step = (last - first) / 128.0 % 360.0 / (count - 1)
        if self._angle is not None:
            gap = abs(wrap_degrees(first / 128.0 - self._angle - self._step)) > MAX_JUMP
        self._angle = last / 128.0
        return size, Packet(
            angles=[point.angle_deg for point in decoded[1]],
            distances=[point.dist_mm for point in decoded[1]],
            duration=float(count),
            start=0 if kind & 1 else None,
            gap=gap,
        )


def make_intensity_decoder(library: Any) -> Any:
    """Return the decoder of a T-mini Pro or Plus: three bytes a sample, as an SCL's.

    The first byte is the intensity. The others are the distance in quarters of a millimetre, whose
    last two bits tell what disturbed it. A T-mini's angles need no correction (YDLidar-SDK,
    `parsePoints`).
    """
    decoder = library.YDLidarSCL(None)
    decoder._angle_correction_deg64 = lambda sample, distance: 0.0  # noqa: SLF001
    return decoder
