"""LiDARs of YDLIDAR: X2, X3, X4, X4 PRO, SCL, T-minis. They measure at a constant rate.

A packet has up to 40 measurements between its first and its last angle, and a checksum. The adapter
boards of these LiDARs switch the motor by DTR; an X4 takes commands as well.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from typing import Any, ClassVar

from acsar_gym.lidar.serial import Driver, Outbox, Packet, load_lds2d
from acsar_gym.links.ports import PORT_ERRORS

HEADER = b"\xaa\x55"
HEADER_BYTES = 10
SCAN_ANSWER = bytes.fromhex("a5 5a 05 00 00 40 81")  # what an X4 answers before its head turns
MAX_JUMP = 3.0  # further turns between two packets lack measurements [deg]


class YdlidarDriver(Driver):
    """A LiDAR of YDLIDAR; "ydlidar" is an X4."""

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

    def __init__(self, model: str) -> None:
        super().__init__(model)
        library = load_lds2d().ydlidar
        self._kind = getattr(library, self.models[model])
        self._decoders = [self._kind(None)]
        if self._kind is library.YDLidarTmini:
            self._decoders.insert(0, make_intensity_decoder(library))
        self.product = self._kind.MODEL_NAME
        self.forget()

    def forget(self) -> None:
        """Forget where the newest packet ended."""
        self._angle: float | None = None
        self._step = 0.0

    def start(self, port: Any) -> None:
        """Set the baud rate; start motor and scan."""
        self.set_baud_rate(port, self._kind.DEFAULT_BAUD)
        with contextlib.suppress(*PORT_ERRORS):  # a pseudo-terminal has no DTR
            port.dtr = True
        self._kind(Outbox(port)).start()

    def stop(self, port: Any) -> None:
        """Stop scan and motor."""
        try:
            self._kind(Outbox(port)).stop()
        finally:
            with contextlib.suppress(*PORT_ERRORS):
                port.dtr = False

    def parse(self, data: bytearray, at: int) -> tuple[int, Packet | None]:
        """Find a packet of a header of ten bytes, and two or three bytes for each measurement."""
        if data.startswith(SCAN_ANSWER, at):
            return len(SCAN_ANSWER), Packet((), (), 0.0)
        if not HEADER.startswith(data[at : at + len(HEADER)]):
            return 1, None
        if len(data) - at < HEADER_BYTES:
            return 0, None
        count = data[at + 3]
        for decoder in self._decoders:  # a packet's checksum tells which one it is for
            packet = data[at : at + HEADER_BYTES + count * decoder.SAMPLE_BYTES]
            used, decoded = decoder._try_parse(packet)  # noqa: SLF001 - its scans() wait
            if not used:
                return 0, None
            if decoded is not None:
                break
        else:
            return 1, None
        # The head's own angles; those of the measurements allow for the lens beside the laser.
        first, last = ((packet[k] | packet[k + 1] << 8) / 128.0 for k in (4, 6))
        gap = False
        if count > 1:
            self._step = ((last - first) % 360.0) / (count - 1)
        if self._angle is not None:
            jump = (first - self._angle - self._step + 180.0) % 360.0 - 180.0
            gap = abs(jump) > MAX_JUMP
        self._angle = last
        points = decoded[1]
        angles, distances = [p.angle_deg for p in points], [p.dist_mm for p in points]
        start = 0 if packet[2] & 1 else None
        return len(packet), Packet(angles, distances, float(count), start, gap)


def make_intensity_decoder(library: Any) -> Any:
    """Make the decoder of a T-mini Pro or Plus: three bytes a sample, as an SCL's.

    The first is the intensity, the others the distance in quarters of a millimetre, whose last two
    bits say what disturbed it. A T-mini's angles need no correction (YDLidar-SDK, `parsePoints`).
    """

    class IntensityDecoder(library.YDLidarSCL):  # type: ignore[misc]
        """Samples with intensity, at the head's own angles."""

        def _angle_correction_deg64(self, sample: bytes, dist_mm: int) -> float:
            return 0.0

    return IntensityDecoder(None)
