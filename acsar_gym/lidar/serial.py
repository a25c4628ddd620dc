"""What LiDARs on serial devices have in common; what differs is a `Driver`, one file a maker.

A thread reads the port, the driver finds the packets in the bytes, and a `RevolutionAssembler` puts
them together to complete revolutions with the time of each measurement. lds2d knows the commands,
baud rates and packets. What it lacks for a robot is done here: its ports aren't exclusive, its
`scans()` waits forever for a silent device, begins with a part of a revolution, splits revolutions
where the angle jitters around zero, passes on revolutions in which bytes were lost, and has no
times.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError, LinkError, format_error, require_extra
from acsar_gym.guard.shutdown import close_at_exit, forget_link, install_handlers
from acsar_gym.lidar.contract import check_age
from acsar_gym.lidar.scan import Revolution
from acsar_gym.links.base import WHILE_WAITING
from acsar_gym.links.ports import PORT_ERRORS, PortLocation, write_all
from acsar_gym.worlds import Scene

Floats = NDArray[np.float64]

MIN_MEASUREMENTS, MAX_MEASUREMENTS = 36, 10_000  # of a revolution that is believed
READ_PERIOD = 0.005  # how often the port is read [s]
READ_BYTES = 4096  # most bytes taken from the port at once
MAX_SLEEP = 0.1
"""If the reader slept for longer, the bytes in the port are too old to be stamped and are
dropped [s]."""
SPIN_UP_TIMEOUT = 5.0  # from the start of the motor to the first complete revolution, at most [s]
READER_TIMEOUT = 0.5  # how long closing waits for the reader thread to end [s]
CHECK_CABLE = "check the cable, then reset"  # what mends a device that was lost


class Packet(NamedTuple):
    """Measurements that a LiDAR sends together, in the order in which they were taken.

    One without any is another sign that the device is there.
    """

    angles: Sequence[float]
    """Clockwise from the LiDAR's zero [deg]; anything where nothing was measured."""
    distances: Sequence[float]
    """[mm]; 0 where nothing was measured."""
    duration: float
    """How long they took together, by the device's own clock, in a unit that stays the same."""
    start: int | None = None
    """Index of the first one that belongs to a new revolution; None where the old one goes on."""
    gap: bool = False
    """Whether measurements are missing before these."""
    delay: float = 0.0
    """How long after the last one the packet was sent, in the unit of `duration`."""


class Driver:
    """Commands and packets of one maker's LiDARs. Subclasses are found in the folder `drivers`.

    Args:
        model: one of `models`.

    Attributes: `product`, the name of the device in messages; `clockwise`, how its head turns, seen
    from above.
    """

    models: ClassVar[Mapping[str, str]] = {}
    """Names in URLs, such as "ld06", and what lds2d calls these models."""
    start_proof: ClassVar[int] = 1
    """How many measurements must follow the start of a revolution before it is believed."""
    max_unevenness: float = 60.0
    """Angles of a revolution grow evenly up to this deviation; otherwise some are missing [deg]."""
    max_jump: float = math.inf
    """The same between one measurement and the next, for packets without a checksum [deg]."""

    def __init__(self, model: str) -> None:
        self.model = model
        self.product = model
        self.clockwise = True

    def set_baud_rate(self, port: Any, rate: int) -> None:
        """Set the baud rate of a port; LidarError where it doesn't have this one."""
        try:
            port.baudrate = rate
        except (ValueError, NotImplementedError) as error:
            raise LidarError(
                str(error), f"connect the {self.product} by another adapter"
            ) from error

    def start(self, port: Any) -> None:
        """Set the port's baud rate, and start motor and measurements.

        Args:
            port: open.

        Raises:
            LidarError: the device says that it can't measure, or is another one.
        """
        raise NotImplementedError

    def stop(self, port: Any) -> None:
        """Stop measurements and motor, as far as the device can be told to."""

    def forget(self) -> None:
        """Forget the packets so far, as those that come next aren't the ones that follow them."""

    def parse(self, data: bytearray, at: int) -> tuple[int, Packet | None]:
        """Find the packet that begins at a byte.

        Args:
            data: what has come from the device.
            at: index of the byte.

        Returns:
            How many bytes it has, and the packet; 0 where its end hasn't come yet; 1 and None where
            none begins here.
        """
        raise NotImplementedError


def load_lds2d() -> Any:
    """Import the drivers of lds2d; MissingExtraError where it isn't installed."""
    with require_extra("a real LiDAR", "lidar"):
        return importlib.import_module("lds2d.drivers")


class Outbox:
    """The port as lds2d's drivers write to it, without pyserial's wait for a full buffer."""

    def __init__(self, port: Any) -> None:
        self._port = port

    def write(self, data: bytes) -> None:
        """Send a command."""
        write_all(self._port, data)


class RevolutionAssembler:
    """Assembles complete revolutions from bytes and the times at which they arrived.

    A revolution in which measurements were lost is dropped: a gap in it would look like free space.

    Attributes: `driver`; `heard`, how many bytes came; `packets`, how many packets were in them.
    """

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self.heard = self.packets = 0
        self.forget()

    def forget(self) -> None:
        """Drop all bytes so far, and wait for the beginning of a revolution."""
        self.driver.forget()
        self._buffer = bytearray()
        self._arrivals: deque[tuple[int, float]] = deque()
        """Place in the stream of the first byte of each piece, and when it arrived."""
        self._drop()

    def _drop(self) -> None:
        self._ended: _Measurements | None = None
        self._current: _Measurements | None = None
        self._elapsed = 0.0
        self._marks: deque[tuple[float, float]] = deque(maxlen=2 * MAX_MEASUREMENTS)
        """Times on the device's clock, and when bytes sent after them had arrived on ours; of the
        last two turns."""

    def feed(self, data: bytes, now: float) -> list[Revolution]:
        """Take the next piece of the stream.

        Returns:
            The revolutions that it completes, each from one start to the next.
        """
        if not data:
            return []
        first = self.heard - len(self._buffer)
        self._arrivals.append((self.heard, now))
        self.heard += len(data)
        self._buffer += data
        at = 0
        revolutions: list[Revolution] = []
        while at < len(self._buffer):
            size, packet = self.driver.parse(self._buffer, at)
            if not size:
                break
            if packet is None:
                self._drop()
            else:
                self.packets += 1
                revolutions += self._take(packet, self._arrived(first + at))
            at += size
        self._arrived(first + at)
        del self._buffer[:at]
        return revolutions

    def _arrived(self, place: int) -> float:
        """When the byte at a place in the stream arrived [s]; forgets pieces before it."""
        while len(self._arrivals) > 1 and self._arrivals[1][0] <= place:
            self._arrivals.popleft()
        return self._arrivals[0][1]

    def _take(self, packet: Packet, arrived: float) -> list[Revolution]:
        """Add a packet, whose first byte had arrived by then [s]."""
        if packet.gap:
            self._drop()
        count, start = len(packet.angles), packet.start
        if not count:
            return []
        before, self._elapsed = self._elapsed, self._elapsed + packet.duration
        # A packet is sent when it is complete. Of those that arrived at once the newest counts.
        if self._marks and self._marks[-1][1] >= arrived:
            self._marks.pop()
        self._marks.append((self._elapsed + packet.delay, arrived))
        for k in range(count):
            if k == start:
                self._ended, self._current = self._current, _Measurements(before)
            if self._current is not None:
                when = before + packet.duration * (k + 1) / count
                self._current.add(packet.angles[k], packet.distances[k], when)
        if self._current is None:
            return []
        if len(self._current.angles) > MAX_MEASUREMENTS:
            self._drop()
        elif self._ended is not None and len(self._current.angles) >= self.driver.start_proof:
            ended, self._ended = self._ended, None
            complete = ended.complete(self.driver, self._marks)
            recent = (mark for mark in self._marks if mark[0] > ended.begun)
            self._marks = deque(recent, self._marks.maxlen)
            return complete
        return []


class _Measurements:
    """The measurements of a revolution so far, on the device's clock."""

    def __init__(self, begun: float) -> None:
        self.begun = begun
        self.angles: list[float] = []
        self.distances: list[float] = []
        self.times: list[float] = []

    def add(self, angle: float, distance: float, when: float) -> None:
        self.angles.append(angle)
        self.distances.append(distance)
        self.times.append(when)

    def complete(self, driver: Driver, marks: Sequence[tuple[float, float]]) -> list[Revolution]:
        """The revolution; empty where some are missing.

        Its angles then don't grow evenly by a full turn. Where nothing was measured devices give no
        angle, or a wrong one; it is between those around it.
        """
        count = len(self.angles)
        if count < MIN_MEASUREMENTS:
            return []
        angles, distances = np.array(self.angles, np.float64), np.array(self.distances, np.float64)
        (places,) = np.nonzero(distances)
        turned = np.arange(count) * (360.0 if driver.clockwise else -360.0) / count
        if len(places):
            uneven = (angles[places] - angles[places[0]] - turned[places]) + turned[places[0]]
            uneven = (uneven + 180.0) % 360.0 - 180.0
            jumps = np.diff(uneven)[np.diff(places) == 1]
            if np.abs(uneven).max() > driver.max_unevenness or (
                np.abs(jumps).max(initial=0.0) > driver.max_jump
            ):
                return []
            around = np.interp(np.arange(count), places, uneven)
            even = angles[places[0]] - turned[places[0]] + turned
            angles = np.where(distances > 0.0, angles, even + around)
        else:
            angles = turned
        bearings = np.pi - (np.radians(angles) + np.pi) % (2.0 * np.pi)
        times = estimate_times(np.array(self.times), marks)
        return [Revolution(bearings, distances / 1000.0, times, float(times[-1]))]


def estimate_times(times: Floats, marks: Sequence[tuple[float, float]]) -> Floats:
    """Convert times of a device's clock to ours.

    What is sent arrives late by different times, and never early. So the device's clock is the line
    below all marks that is nearest to them on average: the edge of their lower convex hull above
    their mean (Moon, Skelly and Towsley 1999, "Estimation and removal of clock skew from network
    delay measurements").

    Args:
        times: (n,), on the device's clock, in any unit.
        marks: times on the device's clock, ascending, and when what was sent then had arrived on
            ours [s].

    Returns:
        (n,) [s], never after what was measured then had arrived.
    """
    hull: list[tuple[float, float]] = []
    for x, y in marks:
        while len(hull) > 1:
            (x0, y0), (x1, y1) = hull[-2:]
            if (x1 - x0) * (y - y0) > (y1 - y0) * (x - x0):
                break
            hull.pop()
        hull.append((x, y))
    middle = sum(x for x, _ in marks) / len(marks)
    x0, y0 = hull[0]
    slope = 0.0
    for (x0, y0), (x1, y1) in pairwise(hull):
        slope = (y1 - y0) / (x1 - x0)
        if x1 >= middle:
            break
    return y0 + slope * (times - x0)


class SerialLidar:
    """A LiDAR behind a serial device. A thread keeps the newest complete revolution.

    Its zero points along the robot's x axis.
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
        self._port: Any = None
        self._driver: Driver | None = None
        self._reader: _Reader | None = None
        install_handlers()

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Open the device if it is closed or doesn't deliver, and wait for a complete revolution.

        A device that was lost has the config's `reconnect_timeout` to come back. The device is
        closed again where this raises.

        Raises:
            LidarError: the device can't be opened, or doesn't measure.
            MissingExtraError: lds2d isn't installed.
        """
        with contextlib.suppress(LidarError):
            self.scan()
            return
        self.close()
        try:
            self._open(self._make_driver())
        except BaseException:
            self.close()
            raise

    def _open(self, driver: Driver) -> None:
        """Open the port, start LiDAR and reader thread, and wait for a complete revolution."""
        try:
            self._open_port = self._location.open(115200, self._config.reconnect_timeout)
            self._port = self._open_port.serial
        except LinkError as error:
            raise LidarError(f"LiDAR {error.found}", error.fix) from error
        close_at_exit(self)
        self._driver = driver
        try:
            self._port.reset_input_buffer()
            driver.start(self._port)
        except LidarError as error:
            raise LidarError(f"LiDAR {self.device}: {error.found}", error.fix) from error
        except PORT_ERRORS as error:
            raise _lost(self.device, str(error)) from error
        stream = RevolutionAssembler(driver)
        reader = self._reader = _Reader(self._port, stream, self._now)
        reader.start()
        deadline = time.monotonic() + SPIN_UP_TIMEOUT
        while reader.newest is None:
            if reader.lost:
                raise _lost(self.device, reader.lost, reader.fix)
            if time.monotonic() > deadline:
                raise self._nothing_measured(driver, stream)
            WHILE_WAITING.get()()
            time.sleep(READ_PERIOD)

    def _nothing_measured(self, driver: Driver, stream: RevolutionAssembler) -> LidarError:
        waited = f"in {SPIN_UP_TIMEOUT:g} s"
        if not stream.heard:
            return LidarError(
                f"LiDAR {self.device}: no answer {waited}",
                "check its power and cable, and the port's name",
            )
        if not stream.packets:
            return LidarError(
                f"LiDAR {self.device}: {stream.heard} bytes {waited}, but none from the "
                f"{driver.product}",
                "check the port's name; another device, or another model of LiDAR, is connected "
                "there",
            )
        return LidarError(
            f"LiDAR {self.device}: no complete turn {waited}",
            "check that its head turns freely and that its 5 V supply is strong enough",
        )

    def scan(self) -> Revolution:
        """Return the newest complete revolution; doesn't wait.

        Raises:
            LidarError: it is older than lidar.timeout, or the device is gone or closed.
        """
        reader = self._reader
        if reader is None or reader.newest is None:
            raise LidarError(f"LiDAR {self.device} is closed", "call reset() first")
        if reader.lost:
            raise _lost(self.device, reader.lost, reader.fix)
        newest = reader.newest
        check_age(newest, self._now(), f"LiDAR {self.device}", config=self._config)
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
        if self._driver is not None:
            with contextlib.suppress(*PORT_ERRORS):
                self._driver.stop(port)

    def _release(self, port: Any) -> None:
        if self._reader is not None and self._reader.lost:
            self._location.note_loss(self._open_port)
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

    def __reduce__(self) -> tuple[type[SerialLidar], tuple[Any, ...]]:
        """Copies and pickles are closed LiDARs on the same device; a port can't be shared."""
        return SerialLidar, (self.device, self._make_driver, self._config, self._now)


class _Reader(threading.Thread):
    """Thread that reads the port and keeps the newest revolution.

    It has no reference to the LiDAR.
    """

    def __init__(self, port: Any, stream: RevolutionAssembler, now: Callable[[], float]) -> None:
        super().__init__(name="lidar", daemon=True)
        self.newest: Revolution | None = None
        self.lost = ""
        """Why the device is gone; empty while it isn't."""
        self.fix = CHECK_CABLE
        self.running = True
        self._port = port
        self._stream = stream
        self._now = now

    def run(self) -> None:
        """Read until told to end, or until the device is gone."""
        awake = time.monotonic()
        while self.running:
            time.sleep(READ_PERIOD)
            try:
                data, now = self._port.read(READ_BYTES), self._now()
                before, awake = awake, time.monotonic()
                if awake - before > MAX_SLEEP:
                    self._port.reset_input_buffer()
                    self._stream.forget()
                    continue
            except PORT_ERRORS as error:
                self.lost = str(error) or type(error).__name__
                return
            try:
                turns = self._stream.feed(data, now)
            except Exception as error:  # noqa: BLE001 - a driver of the user's own; `scan` tells it
                driver = self._stream.driver
                why = format_error(error)
                self.lost = f"{type(driver).__name__}.parse() raised {why}"
                self.fix = "mend that driver"
                return
            if turns:
                self.newest = turns[-1]


def _lost(device: str, why: str, fix: str = CHECK_CABLE) -> LidarError:
    return LidarError(f"LiDAR {device}: lost while in use ({why})", fix)
