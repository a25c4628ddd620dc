"""LiDARs on serial ports: a thread reads the bytes, a `Driver` decodes them, one file a maker.

A `RevolutionAssembler` puts the packets of a driver together to complete revolutions, with the time
of each measurement. lds2d has the commands, baud rates and packets of the makers. Its own `scans()`
isn't used: it waits forever for a silent device, starts with a part of a revolution, delivers
revolutions in which bytes were lost, and has no times.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError, LinkError, format_error, require_extra
from acsar_gym.guard.shutdown import close_at_exit, forget_link, install_handlers
from acsar_gym.lidar.contract import check_age
from acsar_gym.lidar.scan import FULL_TURN, Floats, Revolution
from acsar_gym.links.base import WHILE_WAITING
from acsar_gym.links.ports import OpenPort, PortLocation
from acsar_gym.worlds import Scene

FIRST_BAUD_RATE = 115200  # of a port before its driver sets another [bit/s]
MIN_MEASUREMENTS = 36  # fewer measurements aren't a revolution
MAX_MEASUREMENTS = 10_000  # nor are more
READ_PERIOD = 0.005  # how often the port is read [s]
MAX_SLEEP = 0.1
"""If the reader slept for longer, the bytes in the port are too old to be stamped and are
dropped [s]."""
SPIN_UP_TIMEOUT = 5.0  # longest wait from the start of the motor to the first revolution [s]
READER_TIMEOUT = 0.5  # longest wait for the reader thread to end [s]


class Packet(NamedTuple):
    """Measurements that a LiDAR sends together, in the order in which they were made.

    A packet without measurements is another sign that the device is there.
    """

    angles: Sequence[float]
    """Clockwise from the LiDAR's zero [deg]. Any number for failed measurements."""
    distances: Sequence[float]
    """[mm]. 0 for failed measurements."""
    duration: float
    """How long they took by the device's own clock, in a constant unit."""
    start: int | None = None
    """Index of the first measurement of a new revolution. None if there is none."""
    gap: bool = False
    """Whether measurements are missing before these."""
    delay: float = 0.0
    """Time from the last measurement until the packet was sent, in the unit of `duration`."""


NO_MEASUREMENTS = Packet((), (), 0.0)


class Driver:
    """Commands and packets of a maker's LiDARs. The subclasses are in the folder `drivers`.

    Args:
        model: One of `models`.

    Attributes:
        product: Name of the device in messages.
    """

    models: ClassVar[Mapping[str, str]] = {}
    """Names in URLs, such as "ld06", and what the driver needs to know of each."""
    header: bytes = b""
    """First bytes of a packet."""
    greeting: bytes = b""
    """Bytes that the device sends before its first packet."""
    packet_bytes: int = 0
    """Length of a packet."""
    clockwise: bool = True
    """Direction in which the head turns, seen from above."""
    start_proof: int = 1
    """How many measurements must follow the start of a revolution to confirm it."""
    max_unevenness: float = 60.0
    """Largest deviation from angles that grow evenly. If it is larger, measurements are missing
    [deg]."""
    max_jump: float = math.inf
    """The same between two measurements, for packets without a checksum [deg]."""

    def __init__(self, model: str) -> None:
        self.product = model

    def start(self, port: OpenPort) -> None:
        """Set the port's baud rate, and start motor and measurements.

        Raises:
            LidarError: The device reports that it can't measure, or is of another kind.
            LinkError: The port is lost, or doesn't have the baud rate.
        """
        raise NotImplementedError

    def stop(self, port: OpenPort) -> None:
        """Stop measurements and motor, if the device has commands for it."""

    def forget(self) -> None:
        """Forget the last packets, because the next packet doesn't follow them."""

    def parse(self, data: bytearray, at: int) -> tuple[int, Packet | None]:
        """Find the packet that starts at a byte.

        Args:
            data: Bytes from the device.
            at: Index of the byte.

        Returns:
            Number of bytes of the packet, and the packet. 0 and None if its end is missing. 1 and
            None if no packet starts here.
        """
        if self.greeting and data.startswith(self.greeting, at):
            return len(self.greeting), NO_MEASUREMENTS
        candidate = bytes(data[at : at + self.packet_bytes])
        # A cut header may be completed by the next bytes.
        if not self.header.startswith(candidate[: len(self.header)]):
            return 1, None
        if len(candidate) < self.packet_bytes:
            return 0, None
        packet = self.decode(candidate)
        return (1, None) if packet is None else (len(candidate), packet)

    def decode(self, data: bytes) -> Packet | None:
        """Decode a packet of `packet_bytes`. None if the bytes aren't a packet."""
        raise NotImplementedError


class LibraryDriver(Driver):
    """A driver of a maker whose packets a module of lds2d decodes. `models` are its classes."""

    library: ClassVar[str]
    """Name of the module."""

    def __init__(self, model: str) -> None:
        self._library = getattr(load_lds2d(), self.library)
        self._kind = getattr(self._library, self.models[model])
        self.product = self._kind.MODEL_NAME
        self.forget()

    def start(self, port: OpenPort) -> None:
        """Set the baud rate."""
        port.set_baud_rate(self._kind.DEFAULT_BAUD)


def load_lds2d() -> Any:
    """Import the drivers of lds2d. MissingExtraError if it isn't installed."""
    with require_extra("a real LiDAR", "lidar"):
        return importlib.import_module("lds2d.drivers")


def wrap_degrees(angle: Any) -> Any:
    """Return angles within half a turn [deg]."""
    return (angle + 180.0) % 360.0 - 180.0


def find_start(previous: float, angles: Sequence[float]) -> int | None:
    """Return the index of the first angle past the LiDAR's zero, clockwise [deg]."""
    for k, (last, angle) in enumerate(pairwise((previous, *angles))):
        if angle < last - 180.0:
            return k
    return None


Rows = list[tuple[float, float, float]]
"""Angle [deg], distance [mm] and time by the device's clock of each measurement."""
Marks = Sequence[tuple[float, float]]
"""Times by the device's clock, ascending, and when bytes that were sent then had arrived [s]."""


class RevolutionAssembler:
    """Assembles complete revolutions from bytes and the times at which they arrived.

    A revolution with lost measurements is dropped: the gap would look like free space.

    Args:
        driver: Decodes the bytes.
        yaw: Direction of the LiDAR's zero from the robot's x axis [rad].

    Attributes:
        heard: Number of bytes.
        packets: Number of packets in them.
    """

    def __init__(self, driver: Driver, yaw: float = 0.0) -> None:
        self.heard = 0
        self.packets = 0
        self._driver = driver
        self._yaw = yaw
        self.forget()

    def forget(self) -> None:
        """Drop all bytes, and wait for the start of a revolution."""
        self._driver.forget()
        self._buffer = bytearray()
        self._arrival = 0.0  # of the first byte in the buffer
        self._restart()

    def _restart(self) -> None:
        """Drop the measurements."""
        self._rows: Rows | None = None  # since the start of a revolution
        self._end: int | None = None  # index of the first row of the next revolution
        self._elapsed = 0.0  # by the device's clock
        self._marks: deque[tuple[float, float]] = deque(maxlen=2 * MAX_MEASUREMENTS)

    def feed(self, data: bytes, now: float) -> list[Revolution]:
        """Take bytes that have arrived by now [s]. Returns the revolutions that they complete."""
        if not data:
            return []
        old = len(self._buffer)
        self.heard += len(data)
        self._buffer += data
        revolutions = []
        at = 0
        while at < len(self._buffer):
            # Packets and garbage, one after the other, until the end of a packet is missing.
            size, packet = self._driver.parse(self._buffer, at)
            if not size:
                break
            if packet is None:
                self._restart()
                self._arrival = now
            else:
                self.packets += 1
                self._add(packet, self._arrival if at < old else now)
                revolutions += self._finish()
            at += size

        if at >= old:  # the incomplete packet starts in these bytes
            self._arrival = now
        del self._buffer[:at]
        return revolutions

    def _add(self, packet: Packet, arrival: float) -> None:
        """Add a packet whose first byte had arrived then [s]."""
        if packet.gap:
            self._restart()
        count = len(packet.angles)
        if not count:
            return

        # A packet is sent when it is complete. Of packets that arrived together the last counts.
        started = self._elapsed
        self._elapsed += packet.duration
        if self._marks and self._marks[-1][1] >= arrival:
            self._marks.pop()
        self._marks.append((self._elapsed + packet.delay, arrival))

        times = [started + packet.duration * (k + 1) / count for k in range(count)]
        # Measurements before the first start of a revolution are a part of it, and dropped.
        rows = list(zip(packet.angles, packet.distances, times, strict=True))
        if packet.start is not None:
            if self._rows is None:
                self._rows = []
                rows = rows[packet.start :]
            else:
                self._end = len(self._rows) + packet.start
        if self._rows is not None:
            self._rows += rows

    def _finish(self) -> list[Revolution]:
        """Return the complete revolution, once its end is confirmed."""
        rows = self._rows or []
        end = self._end
        # A device whose revolutions never start must not fill the memory.
        if len(rows) > 2 * MAX_MEASUREMENTS:
            self._restart()
        if end is None or len(rows) < end + self._driver.start_proof:
            return []

        revolution = make_revolution(rows[:end], self._driver, self._marks, yaw=self._yaw)
        recent = [mark for mark in self._marks if mark[0] >= rows[0][2]]
        self._marks = deque(recent, self._marks.maxlen)
        self._rows = rows[end:]
        self._end = None
        return [] if revolution is None else [revolution]


def make_revolution(rows: Rows, driver: Driver, marks: Marks, yaw: float) -> Revolution | None:
    """Return the revolution of measurements. None if some of a full turn are missing.

    Devices give no angle, or a wrong one, for a failed measurement. It is interpolated.
    """
    count = len(rows)
    if not MIN_MEASUREMENTS <= count <= MAX_MEASUREMENTS:
        return None
    # Angles of failed measurements aren't used below.
    angles, distances, times = np.array(rows, np.float64).T
    (places,) = np.nonzero(distances)

    # The angles of a head that turns evenly, and how the measured angles deviate from them.
    even = np.arange(count) * (360.0 if driver.clockwise else -360.0) / count
    if len(places):
        even += angles[places[0]] - even[places[0]]
    deviations = wrap_degrees(angles[places] - even[places])
    jumps = np.diff(deviations)[np.diff(places) == 1]
    if (
        np.abs(deviations).max(initial=0.0) > driver.max_unevenness
        or np.abs(jumps).max(initial=0.0) > driver.max_jump
    ):
        return None

    if len(places):
        even += np.interp(np.arange(count), places, deviations)
    angles = np.where(distances > 0.0, angles, even)
    # From clockwise and the LiDAR's zero to counter-clockwise and the robot's x axis.
    bearings = np.pi - (np.radians(angles) - yaw + np.pi) % FULL_TURN
    times = estimate_times(times, marks)
    return Revolution(bearings, distances / 1000.0, times, float(times[-1]))


def estimate_times(times: Floats, marks: Marks) -> Floats:
    """Convert times of a device's clock to ours.

    Bytes arrive late by different times, and never early. So the device's clock is the line below
    all marks that is nearest to them on average: the edge of their lower convex hull at their mean
    (Moon, Skelly and Towsley 1999, "Estimation and removal of clock skew from network delay
    measurements").

    Args:
        times: (n,), by the device's clock, in any unit.
        marks: Arrivals by both clocks.

    Returns:
        (n,) [s], never after the arrival of a measurement.
    """
    # The lower hull, by Andrew's monotone chain: marks come in the order of their times.
    hull: list[tuple[float, float]] = []
    for x, y in marks:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
                break
            hull.pop()
        hull.append((x, y))

    # The hull's edge at the mean is the line that is nearest to all marks.
    middle = sum(x for x, _ in marks) / len(marks)
    x0, y0 = hull[0]
    slope = 0.0
    for (x0, y0), (x1, y1) in pairwise(hull):
        slope = (y1 - y0) / (x1 - x0)
        if x1 >= middle:
            break
    return y0 + slope * (times - x0)


class SerialLidar:
    """A LiDAR on a serial port. A thread keeps the newest complete revolution.

    Args:
        device: Name of the port.
        make_driver: Makes the driver.
        config: Robot configuration.
        now: Clock of the robot's link [s].
    """

    def __init__(
        self,
        device: str,
        make_driver: Callable[[], Driver],
        config: RobotConfig,
        now: Callable[[], float],
    ) -> None:
        self.device = device
        self._make_driver = make_driver
        self._config = config
        self._now = now
        self._location = PortLocation(device)
        self._reader: _Reader | None = None
        install_handlers()

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Open the port unless the LiDAR delivers, and wait for a complete revolution.

        A lost device has `reconnect_timeout` to come back. After an error the port is closed.

        Raises:
            LidarError: The port can't be opened, or the device doesn't measure.
            MissingExtraError: lds2d isn't installed.
        """
        # A LiDAR that still delivers needn't spin up again.
        with contextlib.suppress(LidarError):
            self.scan()
            return
        self.close()
        try:
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        """Open the port, start the LiDAR, and wait for a complete revolution."""
        driver = self._make_driver()
        assembler = RevolutionAssembler(driver, self._config.lidar_yaw or 0.0)
        try:
            port = self._location.open(FIRST_BAUD_RATE, self._config.reconnect_timeout)
            reader = self._reader = _Reader(port, driver, assembler, now=self._now)
            close_at_exit(self)
            port.drop_input()
            driver.start(port)
        except LidarError as error:
            raise LidarError(f"LiDAR {self.device}: {error.found}", error.fix) from error
        except LinkError as error:
            raise LidarError(f"LiDAR {error.found}", error.fix) from error

        reader.start()
        # The head needs seconds to reach its speed.
        deadline = time.monotonic() + SPIN_UP_TIMEOUT
        while reader.newest is None:
            reader.check()
            if time.monotonic() > deadline:
                raise self._explain_silence(driver, assembler)
            WHILE_WAITING.get()()
            time.sleep(READ_PERIOD)

    def _explain_silence(self, driver: Driver, assembler: RevolutionAssembler) -> LidarError:
        """Return the error of a device that delivers no revolution."""
        waited = f"in {SPIN_UP_TIMEOUT:g} s"
        problem = f"no complete turn {waited}"
        fix = "check that its head turns freely and that its 5 V supply is strong enough"
        if not assembler.packets:
            problem = f"{assembler.heard} bytes {waited}, but none from the {driver.product}"
            fix = "check the port's name: another device, or another model of LiDAR, is there"
        if not assembler.heard:
            problem = f"no answer {waited}"
            fix = "check its power and cable, and the port's name"
        return LidarError(f"LiDAR {self.device}: {problem}", fix)

    def scan(self) -> Revolution:
        """Return the newest complete revolution, without waiting.

        Raises:
            LidarError: It is older than lidar.timeout, or the device is lost or closed.
        """
        reader = self._reader
        if reader is None or reader.newest is None:
            raise LidarError(f"LiDAR {self.device} is closed", "call reset() first")
        reader.check()
        check_age(reader.newest, self._now(), f"LiDAR {self.device}", config=self._config)
        return reader.newest

    def close(self) -> None:
        """Stop measurements and motor, end the thread and close the port. Idempotent."""
        if self._reader is not None:
            try:
                self._reader.end()
            finally:
                self._release()

    def _release(self) -> None:
        """Close the port without commands."""
        reader = self._reader
        if reader is not None:
            if reader.error is not None:
                self._location.note_loss(reader.port)
            self._reader = None
            forget_link(self)
            reader.port.close()

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Return a context that does nothing: the motor may run while the process is suspended."""
        return contextlib.nullcontext()

    def abandon(self) -> None:
        """Close a forked child's copy of the port, without commands to the parent's device."""
        if self._reader is not None:
            self._reader.port.detach()
        self._release()

    def __del__(self) -> None:
        if getattr(self, "_reader", None) is not None:
            self.close()


class _Reader(threading.Thread):
    """Reads an open port and keeps the newest revolution. It has no reference to the LiDAR.

    Attributes:
        port: Open port.
        newest: The newest revolution. None before the first.
        error: Why the thread ended on its own. None while it runs.
    """

    def __init__(
        self,
        port: OpenPort,
        driver: Driver,
        assembler: RevolutionAssembler,
        now: Callable[[], float],
    ) -> None:
        super().__init__(name="lidar", daemon=True)
        self.port = port
        self.newest: Revolution | None = None
        self.error: LidarError | None = None
        self._driver = driver
        self._assembler = assembler
        self._now = now
        self._is_running = True

    def run(self) -> None:
        """Read until `end`, or until the device is lost."""
        try:
            awake = time.monotonic()
            while self._is_running:
                time.sleep(READ_PERIOD)
                data = self.port.read()
                now = self._now()

                # Bytes that waited while the computer slept would get wrong times.
                asleep_since = awake
                awake = time.monotonic()
                if awake - asleep_since > MAX_SLEEP:
                    self.port.drop_input()
                    self._assembler.forget()
                elif revolutions := self._assembler.feed(data, now):
                    self.newest = revolutions[-1]

        except LinkError as error:
            self.error = LidarError(f"LiDAR {error.found}", "check the cable, then reset")
        except Exception as error:  # noqa: BLE001 - of a user's driver
            driver = type(self._driver).__name__
            self.error = LidarError(f"{driver} raised {format_error(error)}", "fix that driver")

    def check(self) -> None:
        """Raise the error that ended the thread, if there is one."""
        if self.error is not None:
            raise self.error.with_traceback(None)

    def end(self) -> None:
        """End the thread, and stop measurements and motor."""
        self._is_running = False
        try:
            # The garbage collector can close a LiDAR in any thread, also in this one.
            if self.is_alive() and self is not threading.current_thread():
                self.join(READER_TIMEOUT)
        finally:
            with contextlib.suppress(LinkError):
                self._driver.stop(self.port)
