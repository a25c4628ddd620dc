"""RPLIDARs of SLAMTEC: A1, A2, C1 in their standard mode.

One measurement is five bytes without a checksum, so a revolution is believed only where its angles
grow evenly, and its start only where valid measurements follow. DTR holds an A1's motor.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from typing import Any, ClassVar

from acsar_gym.errors import LidarError
from acsar_gym.links.ports import PORT_ERRORS, write_all
from acsar_gym.sensors.serial_lidar import (
    READ_BYTES,
    READ_PERIOD,
    Driver,
    Outbox,
    Packet,
    load_lds2d,
)

NODE_BYTES = 5
"""Bytes of a measurement."""
GET_INFO = b"\xa5\x50"
INFO_DESCRIPTOR = b"\xa5\x5a\x14\x00\x00\x00\x04"
GET_HEALTH = b"\xa5\x52"
HEALTH_DESCRIPTOR = b"\xa5\x5a\x03\x00\x00\x00\x06"
HEALTH_BROKEN = 2
"""Health status of a device that refuses to scan."""
MOTOR_ON = bytes.fromhex("a5 f0 02 94 02 c1")
"""Motor speed of 660 of 1023, the maker's default; adapters that switch the motor by DTR ignore
it."""
MOTOR_OFF = bytes.fromhex("a5 f0 02 00 00 57")
STOP_DELAY = 0.02
"""Time from a stop command to the last measurement that still comes [s]."""
ANSWER_TIMEOUT = 0.6
"""A device that doesn't answer within this time doesn't use this baud rate [s]."""
BAUD_TRIES = 2
"""How often each baud rate is tried."""


class RplidarDriver(Driver):
    """An RPLIDAR. "rplidar" finds its baud rate."""

    models: ClassVar[Mapping[str, str]] = {
        "rplidar": "RPLIDAR_A1 RPLIDAR_C1",
        "rplidar_a1": "RPLIDAR_A1",
        "rplidar_a2": "RPLIDAR_A1",
        "rplidar_c1": "RPLIDAR_C1",
    }
    start_proof = 8  # bytes shifted by a loss are invalid sooner
    max_unevenness, max_jump = 15.0, 5.0

    def __init__(self, model: str) -> None:
        super().__init__(model)
        self._library = load_lds2d().rplidar
        self._kinds = [getattr(self._library, kind) for kind in self.models[model].split()]
        self.product = "RPLIDAR"

    def start(self, port: Any) -> None:
        """Find the baud rate at which a healthy device answers, and start it.

        A device that still measures for a process that crashed is stopped first.
        """
        heard = 0
        for kind in self._kinds * BAUD_TRIES:
            self.set_baud_rate(port, kind.DEFAULT_BAUD)
            device = kind(Outbox(port))
            device.stop()
            time.sleep(STOP_DELAY)
            port.reset_input_buffer()
            with contextlib.suppress(*PORT_ERRORS):  # a pseudo-terminal has no DTR
                port.dtr = False
            write_all(port, MOTOR_ON)
            info, count = _ask(port, GET_INFO, INFO_DESCRIPTOR)
            heard += count
            if info is None:
                continue
            health, _ = _ask(port, GET_HEALTH, HEALTH_DESCRIPTOR)
            if health is not None and health[0] == HEALTH_BROKEN:
                raise LidarError(
                    f"reports error 0x{health[2]:02x}{health[1]:02x} and won't measure",
                    "unplug it for a few seconds, then reset; if it comes again, the device is "
                    "broken",
                )
            device.start()
            return
        waited = len(self._kinds) * BAUD_TRIES * ANSWER_TIMEOUT
        if heard:
            raise LidarError(
                f"{heard} bytes in {waited:g} s, but none from an RPLIDAR",
                "check the port's name; another device, or another make of LiDAR, is connected "
                "there",
            )
        raise LidarError(
            f"no answer in {waited:g} s", "check its power and cable, and the port's name"
        )

    def stop(self, port: Any) -> None:
        """Stop the scan; stop the motor by command and by DTR, which stays asserted."""
        try:
            self._kinds[0](Outbox(port)).stop()
            write_all(port, MOTOR_OFF)
        finally:
            hold_motor(port)

    def parse(self, data: bytearray, at: int) -> tuple[int, Packet | None]:
        """Find a measurement of five bytes."""
        if len(data) - at < NODE_BYTES:
            return 0, None
        node = bytes(data[at : at + NODE_BYTES])
        if not self._library.node_ok(node):
            return 1, None
        point, starts = self._library.parse_node(node)
        start = 0 if starts else None
        return NODE_BYTES, Packet((point.angle_deg,), (point.dist_mm,), 1.0, start)


def _ask(port: Any, request: bytes, descriptor: bytes) -> tuple[bytes | None, int]:
    """Send a request.

    Returns the payload behind the descriptor, or None, and how many bytes came.
    """
    write_all(port, request)
    heard, size = b"", descriptor[2]
    deadline = time.monotonic() + ANSWER_TIMEOUT
    while time.monotonic() < deadline:
        time.sleep(READ_PERIOD)
        heard += port.read(READ_BYTES)
        payload = heard.partition(descriptor)[2]
        if len(payload) >= size:
            return payload[:size], len(heard)
    return None, len(heard)


def hold_motor(port: Any) -> None:
    """Stop an A1's motor by DTR, and keep DTR asserted after the port is closed."""
    with contextlib.suppress(*PORT_ERRORS):
        port.dtr = True
    with contextlib.suppress(ImportError, *PORT_ERRORS):  # Windows has no termios
        import termios  # noqa: PLC0415

        attributes = termios.tcgetattr(port.fileno())
        attributes[2] &= ~termios.HUPCL
        termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)
