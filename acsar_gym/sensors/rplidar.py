"""A real RPLIDAR (A1, A2, C1 in its standard mode) on a serial device, through lds2d.

lds2d knows the commands, the baud rates and the measurements. What it lacks for a robot is done
here: its port isn't exclusive and leaves DTR asserted, which holds an A1's motor; its `scans()`
waits forever for a silent device, begins with a part of a revolution, splits revolutions where the
angle jitters around zero, and passes on measurements that lost bytes have shifted.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError, LinkError, require_extra
from acsar_gym.links.base import WHILE_WAITING
from acsar_gym.links.ports import PORT_ERRORS, PortLocation, write_all
from acsar_gym.links.shutdown import close_at_exit, forget_link, install_handlers
from acsar_gym.odometry import Odometry
from acsar_gym.sensors.lidar import Scan, Turn, scan_turn
from acsar_gym.worlds import Scene

NODE_BYTES = 5
"""Bytes of a measurement."""
MIN_MEASUREMENTS, MAX_MEASUREMENTS = 36, 10_000
"""A revolution has at least 36 and at most 10,000 measurements; any other is dropped."""
MAX_ANGLE_ERROR = 15.0
"""Angles of a revolution grow evenly, up to this deviation; otherwise bytes were lost [deg]."""
START_PROOF = 8
"""Valid measurements in a row that prove a start flag: bytes shifted by a loss are invalid
sooner."""


class TurnDecoder:
    """Decodes bytes into complete revolutions. `library` is lds2d.drivers.rplidar.

    A revolution in which bytes were lost is dropped: a gap in it would look like free space.
    """

    def __init__(self, library: Any) -> None:
        self._library = library
        self.forget()

    def forget(self) -> None:
        """Drop all bytes so far, and wait for the beginning of a revolution."""
        self._rest = b""
        self._drop()

    def _drop(self) -> None:
        """Drop the measurements so far."""
        self._points: list[Any] | None = None
        self._ended: list[Any] | None = None

    def feed(self, data: bytes) -> list[Turn]:
        """Return the revolutions that `data` completes.

        Each goes from one start flag to the next.
        """
        buffer, at = self._rest + data, 0
        turns: list[Turn] = []
        while len(buffer) - at >= NODE_BYTES:
            node = buffer[at : at + NODE_BYTES]
            if not self._library.node_ok(node):
                self._drop()
                at += 1
                continue
            at += NODE_BYTES
            point, starts = self._library.parse_node(node)
            if starts:
                self._ended, self._points = self._points, []
            if self._points is None:
                continue
            self._points.append(point)
            if len(self._points) > MAX_MEASUREMENTS:
                self._drop()
            elif len(self._points) == START_PROOF and self._ended is not None:
                turns += _complete_turn(self._ended)
        self._rest = buffer[at:]
        return turns


def _complete_turn(points: list[Any]) -> list[Turn]:
    """A revolution of these points; empty where some are missing.

    Its angles then don't grow evenly by a full turn. Missed measurements have no valid angle.
    """
    if len(points) < MIN_MEASUREMENTS:
        return []
    angles = np.array([point.angle_deg for point in points], dtype=np.float64)
    distances = np.array([point.dist_mm for point in points], dtype=np.float64) / 1000.0
    (places,) = np.nonzero(distances)
    if len(places):
        expected = (places - places[0]) * 360.0 / len(angles)
        off = (angles[places] - angles[places[0]] - expected + 180.0) % 360.0 - 180.0
        if np.abs(off).max() > MAX_ANGLE_ERROR:
            return []
    return [(-np.radians(angles), distances)]


READ_PERIOD = 0.005
"""How often the port is read [s]."""
READ_BYTES = 4096
"""Most bytes taken from the port at once."""
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


class _Outbox:
    """The port as lds2d's drivers write to it, without pyserial's wait for a full buffer."""

    def __init__(self, port: Any) -> None:
        self._port = port

    def write(self, data: bytes) -> None:
        write_all(self._port, data)


def find_device(port: Any, device: str, models: Any) -> Any:
    """Find the baud rate at which a healthy device answers, and start its motor.

    A device that still measures for a process that crashed is stopped first.

    Args:
        port: open.
        device: its name, for messages.
        models: lds2d's module.

    Returns:
        lds2d's driver on the port.

    Raises:
        LidarError: nothing answers, or something else than an RPLIDAR, or a broken one.
    """
    heard = 0
    for model in (models.RPLIDAR_A1, models.RPLIDAR_C1) * BAUD_TRIES:
        port.baudrate = model.DEFAULT_BAUD
        driver = model(_Outbox(port))
        driver.stop()
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
                f"LiDAR {device}: reports error 0x{health[2]:02x}{health[1]:02x} and won't measure",
                "unplug it for a few seconds, then reset; if it comes again, the device is broken",
            )
        return driver
    waited = 2 * BAUD_TRIES * ANSWER_TIMEOUT
    if heard:
        raise LidarError(
            f"LiDAR {device}: {heard} bytes in {waited:g} s, but none from an RPLIDAR",
            "check the port's name; another device, or another make of LiDAR, is connected there",
        )
    raise LidarError(
        f"LiDAR {device}: no answer in {waited:g} s",
        "check its power and cable, and the port's name",
    )


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


MAX_SLEEP = 0.1
"""If the reader slept for longer, the bytes in the port are too old to be stamped and are
dropped [s]."""
SPIN_UP_TIMEOUT = 5.0
"""From standstill to the first complete revolution, at most [s]."""
READER_TIMEOUT = 0.5
"""How long closing waits for the reader thread to end [s]."""


class RplidarLidar:
    """An RPLIDAR behind a serial device. A thread keeps the newest complete revolution.

    Its zero points along the robot's x axis.

    Args:
        device: such as "/dev/ttyUSB1".
        config: of the robot.
        now: clock of the robot's link [s].
    """

    def __init__(self, device: str, config: RobotConfig, now: Callable[[], float]) -> None:
        self.device = device
        self._config = config
        self._now = now
        self._location = PortLocation(device)
        self._port: Any = None
        self._driver: Any = None
        self._reader: _Reader | None = None
        self._odometry = Odometry.of(config)
        install_handlers()

    def follow(self, odometry: Odometry) -> None:
        """Allow for the motion that this odometry tells, from the next opening on.

        Args:
            odometry: of the robot that carries the LiDAR; without one it stands still.
        """
        self._odometry = odometry

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Open the device if it is closed or doesn't deliver, and wait for a complete revolution.

        A device that was lost has the config's `reconnect_timeout` to come back. The device is
        closed again where this raises.

        Raises:
            LidarError: the device can't be opened, or doesn't measure.
            MissingExtraError: lds2d isn't installed.
        """
        with contextlib.suppress(LidarError):
            self._newest()
            return
        self.close()
        with require_extra("a real LiDAR", "lidar"):
            from lds2d.drivers import rplidar as models  # noqa: PLC0415
        try:
            self._open(models)
        except BaseException:
            self.close()
            raise

    def _open(self, models: Any) -> None:
        """Open the port, start LiDAR and reader thread, and wait for a complete revolution."""
        try:
            self._port = self._location.opened(self._config.with_(baud_rate=115200))
        except LinkError as error:
            raise LidarError(f"LiDAR {error.found}", error.fix) from None
        close_at_exit(self)
        try:
            self._driver = find_device(self._port, self.device, models)
            self._driver.start()
        except PORT_ERRORS as error:
            raise _lost(self.device, str(error)) from None
        decoder = TurnDecoder(models)
        reader = _Reader(self._port, decoder, self._config, self._now, self._odometry)
        self._reader = reader
        reader.start()
        deadline = time.monotonic() + SPIN_UP_TIMEOUT
        while reader.newest is None:
            if reader.lost:
                raise _lost(self.device, reader.lost)
            if time.monotonic() > deadline:
                raise LidarError(
                    f"LiDAR {self.device}: no complete turn in {SPIN_UP_TIMEOUT:g} s",
                    "check that its head turns freely and that its 5 V supply is strong enough",
                )
            WHILE_WAITING.get()()
            time.sleep(READ_PERIOD)

    def scan(self) -> Scan:
        """Return the newest complete revolution, stamped when it was complete; doesn't wait.

        Raises:
            LidarError: it is older than lidar.timeout, or the device is gone or closed.
        """
        newest = self._newest()
        return Scan(newest.ranges.copy(), newest.stamp)

    def _newest(self) -> Scan:
        """The reader's newest scan; LidarError as for `scan`."""
        reader = self._reader
        if reader is None or reader.newest is None:
            raise LidarError(f"LiDAR {self.device} is closed", "call reset() first")
        if reader.lost:
            raise _lost(self.device, reader.lost)
        newest = reader.newest
        age, timeout = self._now() - newest.stamp, self._config.lidar.timeout
        if age > timeout:
            raise LidarError(
                f"LiDAR {self.device}: no complete turn for {age:.2f} s (lidar.timeout = "
                f"{timeout:g} s)",
                "check its power and that its head turns freely, then reset",
            )
        return newest

    def close(self) -> None:
        """Stop measuring and the motor, end the thread and close the port; idempotent."""
        port, reader = self._port, self._reader
        if port is None:
            return
        try:
            if reader is not None:
                reader.running = False
                # The garbage collector may close a LiDAR in any thread, this one included.
                if reader.is_alive() and reader is not threading.current_thread():
                    reader.join(READER_TIMEOUT)
            self._say_stop(port)
        except BaseException:
            self._say_stop(port)
            raise
        finally:
            self._release(port)

    def _say_stop(self, port: Any) -> None:
        """Command the LiDAR to stop measuring, and its motor to stop."""
        with contextlib.suppress(*PORT_ERRORS):
            if self._driver is not None:
                self._driver.stop()
            write_all(port, MOTOR_OFF)
        hold_motor(port)

    def _release(self, port: Any) -> None:
        """Close the port and forget it."""
        self._location.left(lost=self._reader is not None and bool(self._reader.lost))
        self._port = self._driver = self._reader = None
        forget_link(self)
        with contextlib.suppress(*PORT_ERRORS):
            port.close()

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Return a context that does nothing: the motor may run while the process is suspended."""
        return contextlib.nullcontext()

    def abandon(self) -> None:
        """Close the port without commands; a forked child must not write to its parent's port."""
        port = self._port
        if port is None:
            return
        null = os.open(os.devnull, os.O_RDWR)
        os.dup2(null, port.fileno())
        os.close(null)
        self._release(port)

    def __del__(self) -> None:
        if getattr(self, "_port", None) is not None:
            self.close()

    def __reduce__(self) -> tuple[type[RplidarLidar], tuple[Any, ...]]:
        """Copies and pickles are closed LiDARs on the same device; a port can't be shared."""
        return RplidarLidar, (self.device, self._config, self._now)


class _Reader(threading.Thread):
    """Thread that reads the port and keeps the newest revolution.

    It has no reference to the LiDAR.
    """

    def __init__(
        self,
        port: Any,
        decoder: TurnDecoder,
        config: RobotConfig,
        now: Callable[[], float],
        odometry: Odometry,
    ) -> None:
        super().__init__(name="rplidar", daemon=True)
        self.newest: Scan | None = None
        self.lost = ""
        """Why the device is gone; empty while it isn't."""
        self.running = True
        self._port = port
        self._decoder = decoder
        self._config = config
        self._now = now
        self._odometry = odometry

    def run(self) -> None:
        """Read until told to end, or until the device is gone."""
        awake = time.monotonic()
        while self.running:
            time.sleep(READ_PERIOD)
            try:
                data = self._port.read(READ_BYTES)
                before, awake = awake, time.monotonic()
                if awake - before > MAX_SLEEP:
                    self._port.reset_input_buffer()
                    self._decoder.forget()
                    continue
            except PORT_ERRORS as error:
                self.lost = str(error) or type(error).__name__
                return
            turns = self._decoder.feed(data)
            if turns:
                stamp, duration = self._now(), 1.0 / self._config.lidar.rate
                since = duration if self.newest is None else stamp - self.newest.stamp
                if since < 2.0 * duration:  # otherwise there was a turn between them that was lost
                    duration = since
                twist = self._odometry.twist
                ranges = scan_turn(turns[-1], duration, twist, self._config, START_PROOF)
                self.newest = Scan(ranges, stamp)


def _lost(device: str, why: str) -> LidarError:
    """The LidarError for a device that is gone."""
    return LidarError(f"LiDAR {device}: lost while in use ({why})", "check the cable, then reset")
