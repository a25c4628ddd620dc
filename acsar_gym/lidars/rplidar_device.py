"""Start an RPLIDAR: find its model and baud rate, start its motor, and check its health."""

from __future__ import annotations

import contextlib
import time
from typing import Any

from acsar_gym.errors import LidarError, MissingExtraError
from acsar_gym.links.ports import PORT_ERRORS, put

POLL = 0.005
"""How often the port is read [s]."""
CHUNK = 4096
"""Most bytes taken from the port at once."""
GET_INFO = b"\xa5\x50"
INFO = b"\xa5\x5a\x14\x00\x00\x00\x04"
GET_HEALTH = b"\xa5\x52"
HEALTH = b"\xa5\x5a\x03\x00\x00\x00\x06"
BROKEN = 2
"""Health status of a device that refuses to scan."""
MOTOR_ON = bytes.fromhex("a5 f0 02 94 02 c1")
"""Motor speed of 660 of 1023, the maker's default; adapters that switch the motor by DTR ignore
it."""
MOTOR_OFF = bytes.fromhex("a5 f0 02 00 00 57")
SETTLE = 0.02
"""Time from a stop command to the last measurement that still comes [s]."""
ANSWER = 0.6
"""A device that doesn't answer within this time doesn't use this baud rate [s]."""
TRIES = 2
"""How often each baud rate is tried."""


class _Outbox:
    """The port as lds2d's drivers write to it, without pyserial's wait for a full buffer."""

    def __init__(self, port: Any) -> None:
        self._port = port

    def write(self, data: bytes) -> None:
        put(self._port, data)


def library() -> Any:
    """Import lds2d's module; MissingExtraError where it isn't installed."""
    try:
        from lds2d.drivers import rplidar  # noqa: PLC0415
    except ImportError:
        raise MissingExtraError("a real LiDAR", "lidar") from None
    return rplidar


def greeted(port: Any, device: str, models: Any) -> Any:
    """Find the baud rate at which the device answers, and start its motor.

    A device that still measures for a process that crashed is stopped first.

    Args:
        port: open.
        device: its name, for messages.
        models: lds2d's module.

    Returns:
        lds2d's driver on the port.

    Raises:
        LidarError: nothing answers, or something else than an RPLIDAR.
    """
    heard = 0
    for model in (models.RPLIDAR_A1, models.RPLIDAR_C1) * TRIES:
        port.baudrate = model.DEFAULT_BAUD
        driver = model(_Outbox(port))
        driver.stop()
        time.sleep(SETTLE)
        port.reset_input_buffer()
        _start_motor(port)
        info, count = _ask(port, GET_INFO, INFO)
        if info is not None:
            return driver
        heard += count
    waited = 2 * TRIES * ANSWER
    if heard:
        raise LidarError(
            f"LiDAR {device}: {heard} bytes in {waited:g} s, but none from an RPLIDAR",
            "check the port's name; another device, or another make of LiDAR, is connected there",
        )
    raise LidarError(
        f"LiDAR {device}: no answer in {waited:g} s",
        "check its power and cable, and the port's name",
    )


def _start_motor(port: Any) -> None:
    """Start the motor by DTR, for adapters of the A1, and by command, for other models.

    A pseudo-terminal has no DTR.
    """
    with contextlib.suppress(*PORT_ERRORS):
        port.dtr = False
    put(port, MOTOR_ON)


def hold_motor(port: Any) -> None:
    """Stop an A1's motor by DTR, and keep DTR asserted after the port is closed."""
    with contextlib.suppress(*PORT_ERRORS):
        port.dtr = True
    with contextlib.suppress(ImportError, *PORT_ERRORS):  # Windows has no termios
        import termios  # noqa: PLC0415

        attributes = termios.tcgetattr(port.fileno())
        attributes[2] &= ~termios.HUPCL
        termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)


def check_health(port: Any, device: str) -> None:
    """Raise LidarError where the device reports that it is broken."""
    health, _ = _ask(port, GET_HEALTH, HEALTH)
    if health is not None and health[0] == BROKEN:
        raise LidarError(
            f"LiDAR {device}: reports error 0x{health[2]:02x}{health[1]:02x} and won't measure",
            "unplug it for a few seconds, then reset; if it comes again, the device is broken",
        )


def _ask(port: Any, request: bytes, descriptor: bytes) -> tuple[bytes | None, int]:
    """Send a request.

    Returns the payload behind the descriptor, or None, and how many bytes came.
    """
    put(port, request)
    heard, size = b"", descriptor[2]
    deadline = time.monotonic() + ANSWER
    while time.monotonic() < deadline:
        time.sleep(POLL)
        heard += port.read(CHUNK)
        payload = heard.partition(descriptor)[2]
        if len(payload) >= size:
            return payload[:size], len(heard)
    return None, len(heard)
