"""RPLIDARs of SLAMTEC: A1, A2, A3 in their standard mode, S1, S2, S3, C1 in their dense mode.

A measurement of the standard mode has five bytes and no checksum. So its revolutions must grow
evenly, and valid measurements must follow their start. The dense mode packs 40 measurements with a
checksum. Both follow SLAMTEC's "RPLIDAR interface protocol and application notes" (LR001). As these
don't describe how an A3's own mode compresses distances, an A3 makes 4,000 measurements a second
here. DTR stops an A1's motor.
"""

from __future__ import annotations

import contextlib
import functools
import operator
import struct
import time
from collections.abc import Mapping
from typing import Any, ClassVar

from acsar_gym.errors import LidarError
from acsar_gym.lidar.serial import (
    NO_MEASUREMENTS,
    READ_PERIOD,
    Driver,
    Packet,
    find_start,
    load_lds2d,
)
from acsar_gym.links.ports import OpenPort

GET_INFO = b"\xa5\x50"
INFO_DESCRIPTOR = b"\xa5\x5a\x14\x00\x00\x00\x04"
GET_HEALTH = b"\xa5\x52"
HEALTH_DESCRIPTOR = b"\xa5\x5a\x03\x00\x00\x00\x06"
HEALTH_BROKEN = 2  # health status of a device that refuses to scan
STOP_DELAY = 0.02  # time from a stop command to the last measurement [s]
ANSWER_TIMEOUT = 0.6  # a device with this baud rate answers sooner [s]
BAUD_TRIES = 2  # how often each baud rate is tried

GET_CONFIG = 0x84
SCAN_EXPRESS = 0x82
CONFIG_DESCRIPTOR_TYPE = 0x20
TYPICAL_MODE = 0x7C  # of GET_CONFIG: the recommended mode
ANSWER_TYPE = 0x75  # of GET_CONFIG: the type of a mode's answers
DENSE_ANSWER = 0x85  # type of the answers that are dense capsules
SYNC = (0xA, 0x5)
CAPSULE_POINTS = 40
CAPSULE_FIRST = 0x8000  # flag in the start angle of the first capsule of a scan


def compute_check(data: bytes) -> int:
    """Return the exclusive or of bytes."""
    return functools.reduce(operator.xor, data, 0)


def encode_request(command: int, payload: bytes) -> bytes:
    """Encode a request with payload and checksum."""
    body = bytes((0xA5, command, len(payload))) + payload
    return body + bytes((compute_check(body),))


class RplidarDriver(Driver):
    """An RPLIDAR. "rplidar" finds its baud rate."""

    models: ClassVar[Mapping[str, str]] = {
        "rplidar": "115200 460800 256000 1000000",
        "rplidar_a1": "115200",
        "rplidar_a2": "115200 256000",
        "rplidar_a3": "256000",
    }
    """Names in URLs, and the baud rates at which these models answer."""
    motor_command = 0xF0
    """Sets the speed of the motor. Adapters that switch the motor by DTR ignore it."""
    motor_speed = 660
    """Of 1023: the maker's default."""
    packet_bytes = 5
    start_proof = 8  # bytes that are shifted by a loss are invalid sooner
    max_unevenness = 15.0
    max_jump = 5.0

    def __init__(self, model: str) -> None:
        self._library = load_lds2d().rplidar
        self._baud_rates = [int(rate) for rate in self.models[model].split()]
        self._heard = 0
        self.product = "RPLIDAR"

    def start(self, port: OpenPort) -> None:
        """Find the baud rate at which a healthy device answers, and start it.

        A device that still measures for a crashed process is stopped first.
        """
        # A device doesn't understand requests at another rate.
        self._heard = 0
        for baud_rate in self._baud_rates * BAUD_TRIES:
            port.set_baud_rate(baud_rate)
            port.write(self._library.build_stop_command())
            time.sleep(STOP_DELAY)
            port.drop_input()
            # On the maker's adapter, DTR stops the motor of an A1.
            port.set_dtr(on=False)
            self._set_motor(port, self.motor_speed)
            if self._ask(port, GET_INFO, INFO_DESCRIPTOR):
                self._check_health(port)
                self._start_scan(port)
                return

        waited = f"in {len(self._baud_rates) * BAUD_TRIES * ANSWER_TIMEOUT:g} s"
        if self._heard:
            raise LidarError(
                f"{self._heard} bytes {waited}, but none from an RPLIDAR",
                "check the port's name: another device, or another make of LiDAR, is there",
            )
        raise LidarError(f"no answer {waited}", "check its power and cable, and the port's name")

    def _check_health(self, port: OpenPort) -> None:
        """Raise LidarError if the device reports that it is broken."""
        health = self._ask(port, GET_HEALTH, HEALTH_DESCRIPTOR)
        if health and health[0] == HEALTH_BROKEN:
            raise LidarError(
                f"reports error 0x{health[2]:02x}{health[1]:02x} and won't measure",
                "unplug it for a few seconds, then reset; if the error comes again, the device is "
                "broken",
            )

    def _start_scan(self, port: OpenPort) -> None:
        port.write(self._library.build_scan_command())

    def _set_motor(self, port: OpenPort, speed: int) -> None:
        port.write(encode_request(self.motor_command, struct.pack("<H", speed)))

    def stop(self, port: OpenPort) -> None:
        """Stop the scan. Stop the motor by command and by DTR, which stays asserted."""
        try:
            port.write(self._library.build_stop_command())
            self._set_motor(port, 0)
        finally:
            port.set_dtr(on=True)
            keep_dtr(port)

    def _ask(self, port: OpenPort, request: bytes, descriptor: bytes) -> bytes:
        """Send a request. Returns the payload after the descriptor, or nothing without answer."""
        port.write(request)
        answer = b""
        size = descriptor[2]
        deadline = time.monotonic() + ANSWER_TIMEOUT
        while time.monotonic() < deadline:
            time.sleep(READ_PERIOD)
            data = port.read()
            self._heard += len(data)
            answer += data
            # Measurements of an old scan may precede the answer.
            payload = answer.partition(descriptor)[2]
            if len(payload) >= size:
                return payload[:size]
        return b""

    def decode(self, data: bytes) -> Packet | None:
        """Decode a measurement of five bytes."""
        if not self._library.node_ok(data):
            return None
        point, is_start = self._library.parse_node(data)
        return Packet((point.angle_deg,), (point.dist_mm,), 1.0, start=0 if is_start else None)


class DenseRplidarDriver(RplidarDriver):
    """An RPLIDAR that recommends its dense mode. Otherwise the standard mode is used.

    A capsule has its first angle and 40 distances. Its other angles lie evenly before the first
    angle of the next capsule, so its measurements are known when that has arrived.
    """

    models: ClassVar[Mapping[str, str]] = {
        "rplidar_c1": "460800",
        "rplidar_s1": "256000",
        "rplidar_s2": "1000000",
        "rplidar_s3": "1000000",
    }
    motor_command = 0xA8
    motor_speed = 600
    """In turns per minute: the maker's default."""
    greeting = bytes.fromhex("a5 5a 54 00 00 40 85")
    packet_bytes = 84

    def __init__(self, model: str) -> None:
        super().__init__(model)
        self._is_dense = True
        self.forget()

    def forget(self) -> None:
        """Forget the newest capsule, and the angle between its measurements."""
        self._capsule: tuple[float, list[int]] | None = None
        self._step = 0.0

    def _start_scan(self, port: OpenPort) -> None:
        """Start to measure, in the recommended mode if that is the dense mode."""
        mode = self._ask_config(port, struct.pack("<I", TYPICAL_MODE), size=2)
        kind = mode and self._ask_config(port, struct.pack("<I", ANSWER_TYPE) + mode, size=1)
        self._is_dense = kind == bytes((DENSE_ANSWER,))
        if self._is_dense:
            self.max_unevenness = Driver.max_unevenness
            self.max_jump = Driver.max_jump
            port.write(encode_request(SCAN_EXPRESS, bytes((mode[0], 0, 0, 0, 0))))
        else:
            self.packet_bytes = RplidarDriver.packet_bytes
            super()._start_scan(port)

    def _ask_config(self, port: OpenPort, question: bytes, size: int) -> bytes:
        """Ask for a setting of this size. Empty without answer, as from old firmware."""
        descriptor = b"\xa5\x5a" + struct.pack("<IB", 4 + size, CONFIG_DESCRIPTOR_TYPE)
        return self._ask(port, encode_request(GET_CONFIG, question), descriptor)[4:]

    def decode(self, data: bytes) -> Packet | None:
        """Decode a capsule, to the measurements of the previous capsule."""
        if not self._is_dense:
            return super().decode(data)

        # The first two bytes have half a sync byte and half the checksum each.
        first, second = data[:2]
        if (first >> 4, second >> 4) != SYNC or (
            compute_check(data[2:]) != first & 15 | (second & 15) << 4
        ):
            self.forget()
            return None
        word, *distances = struct.unpack_from(f"<{1 + CAPSULE_POINTS}H", data, 2)
        capsule = (word % CAPSULE_FIRST / 64.0, distances)
        previous = self._capsule
        self._capsule = capsule
        if previous is None or word & CAPSULE_FIRST:
            return NO_MEASUREMENTS

        # If the step changes much, capsules were lost.
        angle, distances = previous
        step = (capsule[0] - angle) % 360.0 / CAPSULE_POINTS
        last_step = self._step or step
        self._step = step
        if abs(step - last_step) > last_step / 2.0:
            return NO_MEASUREMENTS._replace(gap=True)

        angles = [(angle + step * k) % 360.0 for k in range(CAPSULE_POINTS)]
        start = find_start((angle - step) % 360.0, angles)
        duration = float(CAPSULE_POINTS)
        return Packet(angles, distances, duration, start=start, delay=duration)


def keep_dtr(port: OpenPort) -> None:
    """Keep DTR as it is after the port is closed, if this system has termios."""
    with contextlib.suppress(ImportError):
        import termios  # noqa: PLC0415

        with contextlib.suppress(termios.error, TypeError):
            descriptor: Any = port.fileno()
            attributes = termios.tcgetattr(descriptor)
            attributes[2] &= ~termios.HUPCL
            termios.tcsetattr(descriptor, termios.TCSANOW, attributes)
