"""RPLIDARs of SLAMTEC: A1, A2, A3 in their standard mode, S1, S2, S3, C1 in their dense one.

In the standard mode one measurement is five bytes without a checksum, so a revolution is believed
only where its angles grow evenly, and its start only where valid measurements follow. The dense
mode packs 40 measurements with a checksum. Both are those of SLAMTEC's "RPLIDAR interface protocol
and application notes" (LR001); that leaves open how an A3's own mode compresses distances, so an A3
measures 4,000 times a second here. DTR holds an A1's motor.
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
    READ_BYTES,
    READ_PERIOD,
    Driver,
    Outbox,
    Packet,
    load_lds2d,
)
from acsar_gym.links.ports import PORT_ERRORS, write_all

NODE_BYTES = 5  # bytes of a measurement
GET_INFO = b"\xa5\x50"
INFO_DESCRIPTOR = b"\xa5\x5a\x14\x00\x00\x00\x04"
GET_HEALTH = b"\xa5\x52"
HEALTH_DESCRIPTOR = b"\xa5\x5a\x03\x00\x00\x00\x06"
HEALTH_BROKEN = 2  # health status of a device that refuses to scan
MOTOR_ON = bytes.fromhex("a5 f0 02 94 02 c1")
"""Motor speed of 660 of 1023, the maker's default; adapters that switch the motor by DTR ignore
it."""
MOTOR_OFF = bytes.fromhex("a5 f0 02 00 00 57")
STOP_DELAY = 0.02  # time from a stop command to the last measurement that still comes [s]
ANSWER_TIMEOUT = 0.6  # a device that doesn't answer within this time doesn't use this baud rate [s]
BAUD_TRIES = 2  # how often each baud rate is tried


CONFIG_DESCRIPTOR_TYPE = 0x20
TYPICAL_MODE, ANSWER_TYPE = 0x7C, 0x75  # for GET_LIDAR_CONF: recommended mode, what a mode sends
DENSE_ANSWER = 0x85  # type of the answers that are dense capsules
SCAN_ANSWER = bytes.fromhex("a5 5a 54 00 00 40 85")  # what comes before the first capsule
CAPSULE_BYTES, CAPSULE_POINTS = 84, 40
CAPSULE_FIRST = 0x8000  # flag in the start angle of the first capsule after the start of a scan
MOTOR_SPEED = 600  # of the models that are told turns per minute, the maker's default


def encode_request(command: int, payload: bytes) -> bytes:
    """Encode a request with payload and checksum."""
    body = bytes((0xA5, command, len(payload))) + payload
    return body + bytes((functools.reduce(operator.xor, body),))


class RplidarDriver(Driver):
    """An RPLIDAR. "rplidar" finds its baud rate."""

    models: ClassVar[Mapping[str, str]] = {
        "rplidar": "115200 460800 256000 1000000",
        "rplidar_a1": "115200",
        "rplidar_a2": "115200 256000",
        "rplidar_a3": "256000",
    }
    """Names in URLs, and the baud rates at which these models answer."""
    start_proof = 8  # bytes shifted by a loss are invalid sooner
    max_unevenness, max_jump = 15.0, 5.0

    def __init__(self, model: str) -> None:
        super().__init__(model)
        self._library = load_lds2d().rplidar
        self._baud_rates = [int(rate) for rate in self.models[model].split()]
        self.product = "RPLIDAR"

    def start(self, port: Any) -> None:
        """Find the baud rate at which a healthy device answers, and start it.

        A device that still measures for a process that crashed is stopped first.
        """
        heard = 0
        device = self._library.RPLIDAR_A1(Outbox(port))
        for baud_rate in self._baud_rates * BAUD_TRIES:
            self.set_baud_rate(port, baud_rate)
            device.stop()
            time.sleep(STOP_DELAY)
            port.reset_input_buffer()
            with contextlib.suppress(*PORT_ERRORS):  # a pseudo-terminal has no DTR
                port.dtr = False
            self._set_motor(port, on=True)
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
            self._start_scan(port)
            return
        waited = len(self._baud_rates) * BAUD_TRIES * ANSWER_TIMEOUT
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
            self._library.RPLIDAR_A1(Outbox(port)).stop()
            self._set_motor(port, on=False)
        finally:
            hold_motor(port)

    def _set_motor(self, port: Any, *, on: bool) -> None:
        write_all(port, MOTOR_ON if on else MOTOR_OFF)

    def _start_scan(self, port: Any) -> None:
        self._library.RPLIDAR_A1(Outbox(port)).start()

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


class DenseRplidarDriver(RplidarDriver):
    """An RPLIDAR that recommends its dense mode; in the standard one where it recommends another.

    A capsule has its first angle and 40 distances: the other angles lie evenly before the first one
    of the next capsule, so its measurements are known when that has come.
    """

    models: ClassVar[Mapping[str, str]] = {
        "rplidar_c1": "460800",
        "rplidar_s1": "256000",
        "rplidar_s2": "1000000",
        "rplidar_s3": "1000000",
    }

    def __init__(self, model: str) -> None:
        super().__init__(model)
        self._is_dense = True
        self.forget()

    def forget(self) -> None:
        """Forget the newest capsule, and how far its angles were apart."""
        self._capsule: tuple[float, list[int]] | None = None
        self._step: float | None = None

    def _set_motor(self, port: Any, *, on: bool) -> None:
        write_all(port, encode_request(0xA8, struct.pack("<H", MOTOR_SPEED if on else 0)))

    def _start_scan(self, port: Any) -> None:
        """Start to measure, in the mode that the device recommends if that is the dense one."""
        mode = self._ask_config(port, struct.pack("<I", TYPICAL_MODE), 2)
        kind = b""
        if mode:
            kind = self._ask_config(port, struct.pack("<I", ANSWER_TYPE) + mode, 1)
        self._is_dense = kind == bytes((DENSE_ANSWER,))
        if not self._is_dense:
            super()._start_scan(port)
            return
        self.max_unevenness, self.max_jump = Driver.max_unevenness, Driver.max_jump
        write_all(port, encode_request(0x82, bytes((mode[0], 0, 0, 0, 0))))

    def _ask_config(self, port: Any, question: bytes, size: int) -> bytes:
        """Ask GET_LIDAR_CONF; empty where the device doesn't answer, as one with old firmware."""
        descriptor = b"\xa5\x5a" + struct.pack("<IB", 4 + size, CONFIG_DESCRIPTOR_TYPE)
        answer, _ = _ask(port, encode_request(0x84, question), descriptor)
        return (answer or b"")[4:]

    def parse(self, data: bytearray, at: int) -> tuple[int, Packet | None]:
        """Find a capsule of 84 bytes."""
        if not self._is_dense:
            return super().parse(data, at)
        if data.startswith(SCAN_ANSWER, at):
            return len(SCAN_ANSWER), Packet((), (), 0.0)
        capsule = bytes(data[at : at + CAPSULE_BYTES])
        is_start = all(byte >> 4 == sync for byte, sync in zip(capsule, (0xA, 0x5), strict=False))
        if is_start and len(capsule) < CAPSULE_BYTES:
            return 0, None
        check = functools.reduce(operator.xor, capsule[2:], 0)
        if not is_start or check != capsule[0] & 15 | (capsule[1] & 15) << 4:
            self.forget()
            return 1, None
        return CAPSULE_BYTES, self._place(capsule)

    def _place(self, capsule: bytes) -> Packet:
        """Say at which angles the distances of the capsule before this one were measured."""
        word, *distances = struct.unpack_from(f"<{1 + CAPSULE_POINTS}H", capsule, 2)
        before, self._capsule = self._capsule, (word % CAPSULE_FIRST / 64.0, distances)
        if before is None or word & CAPSULE_FIRST:
            return Packet((), (), 0.0)
        first, distances = before
        step = (self._capsule[0] - first) % 360.0 / CAPSULE_POINTS
        step_before, self._step = self._step, step
        if step_before is not None and abs(step - step_before) > step_before / 2.0:
            return Packet((), (), 0.0, gap=True)
        turned = [(first + step * k) % 360.0 for k in range(-1, CAPSULE_POINTS)]
        start = next((k for k in range(CAPSULE_POINTS) if turned[k + 1] < turned[k]), None)
        points = float(CAPSULE_POINTS)
        return Packet(turned[1:], distances, points, start, delay=points)


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
