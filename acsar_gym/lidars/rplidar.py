"""A real RPLIDAR (A1, A2, C1 in its standard mode) on a serial device, through lds2d.

lds2d knows the commands, the bauds and the measurements. What it lacks for a robot is done here:
its port isn't exclusive and leaves DTR asserted, which holds an A1's motor; its `scans()` waits
forever for a silent device, begins with a part of a turn, splits turns where the angle jitters
around zero, and passes on what lost bytes have shifted.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from acsar_gym.config import LidarConfig, RobotConfig
from acsar_gym.errors import LidarError, LinkError, MissingExtraError
from acsar_gym.lidars.base import Scan
from acsar_gym.lidars.revolutions import Turn, Turns, binned
from acsar_gym.links.ports import PORT_ERRORS, Location, put
from acsar_gym.links.shutdown import close_at_exit, forget, install
from acsar_gym.worlds import Scene

GET_INFO = b"\xa5\x50"
INFO = b"\xa5\x5a\x14\x00\x00\x00\x04"
GET_HEALTH = b"\xa5\x52"
HEALTH = b"\xa5\x5a\x03\x00\x00\x00\x06"
BROKEN = 2
"""Health status of a device that refuses to scan."""
MOTOR_ON = bytes.fromhex("a5 f0 02 94 02 c1")
"""660 of 1023, the maker's default; adapters that switch the motor by DTR ignore it."""
MOTOR_OFF = bytes.fromhex("a5 f0 02 00 00 57")
POLL = 0.005
"""How often the port is read [s]."""
CHUNK = 4096
"""Most bytes taken from the port at once."""
STALL = 0.1
"""What has lain in the port while the reader slept so long is too old to be stamped [s]."""
SETTLE = 0.02
"""From a stop command to the last measurement behind it [s]."""
ANSWER = 0.6
"""A device answers within this, or not at this baud [s]."""
TRIES = 2
"""How often each baud is tried."""
SPIN_UP = 5.0
"""From standstill to the first complete turn, at most [s]."""
END = 0.5
"""How long closing waits for the reader to end [s]."""


class RplidarLidar:
    """An RPLIDAR behind the serial device `device`; `now` is the clock of the robot's link [s].

    Its zero points along the robot's x axis. A thread keeps the newest complete turn.
    """

    def __init__(self, device: str, config: RobotConfig, now: Callable[[], float]) -> None:
        self.device = device
        self._config = config
        self._now = now
        self._location = Location(device)
        self._port: Any = None
        self._driver: Any = None
        self._reader: _Reader | None = None
        install()

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Open a device that is closed or doesn't deliver; waits for its first complete turn.

        One that was lost has the config's `reconnect_timeout` to come back.

        Raises LidarError, or MissingExtraError without lds2d; the device is closed again then.
        """
        with contextlib.suppress(LidarError):
            self._newest()
            return
        self.close()
        try:
            self._open(_library())
        except BaseException:
            self.close()
            raise

    def _open(self, library: Any) -> None:
        try:
            self._port = self._location.opened(self._config.with_(baud_rate=115200))
        except LinkError as error:
            raise LidarError(f"LiDAR {error.found}", error.fix) from None
        close_at_exit(self)
        with _translated(self.device):
            self._driver = _greeted(self._port, self.device, library)
            _check_health(self._port, self.device)
            self._driver.start()
        decoder = Turns(library)
        self._reader = _Reader(self._port, decoder, self._config.lidar, self._now)
        self._reader.start()
        self._wait_for_a_turn(self._reader)

    def _wait_for_a_turn(self, reader: _Reader) -> None:
        deadline = time.monotonic() + SPIN_UP
        while reader.newest is None:
            if reader.lost:
                raise _lost(self.device, reader.lost)
            if time.monotonic() > deadline:
                raise LidarError(
                    f"LiDAR {self.device}: no complete turn in {SPIN_UP:g} s",
                    "check that its head turns freely and that its 5 V supply is strong enough",
                )
            time.sleep(POLL)

    def scan(self) -> Scan:
        """The newest complete turn, stamped when it was complete; waits for nothing.

        Raises LidarError where it is older than lidar.timeout, or the device is gone or closed.
        """
        newest = self._newest()
        return Scan(newest.ranges.copy(), newest.stamp)

    def _newest(self) -> Scan:
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
        """Stop measuring and the motor, end the thread, let go of the port; twice is once."""
        port = self._port
        if port is None:
            return
        try:
            self._end_reader()
            self._say_stop(port)
        except BaseException:
            self._say_stop(port)
            raise
        finally:
            self._release(port)

    def _end_reader(self) -> None:
        reader = self._reader
        if reader is None:
            return
        reader.running = False
        # The garbage collector may close a LiDAR in any thread, this one included.
        if reader.is_alive() and reader is not threading.current_thread():
            reader.join(END)

    def _say_stop(self, port: Any) -> None:
        with contextlib.suppress(*PORT_ERRORS):
            if self._driver is not None:
                self._driver.stop()
            put(port, MOTOR_OFF)
        _hold_motor(port)

    def _release(self, port: Any) -> None:
        self._location.left(lost=self._reader is not None and bool(self._reader.lost))
        self._port = self._driver = self._reader = None
        forget(self)
        with contextlib.suppress(*PORT_ERRORS):
            port.close()

    def held(self) -> contextlib.AbstractContextManager[None]:
        """Leaving the motor running is harmless while the process is suspended."""
        return contextlib.nullcontext()

    def abandon(self) -> None:
        """Let go without a word, as a forked child must do with its parent's port."""
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
    """Takes the bytes as they come and keeps the newest turn; holds no LiDAR, only its port."""

    def __init__(
        self, port: Any, turns: Turns, lidar: LidarConfig, now: Callable[[], float]
    ) -> None:
        super().__init__(name="rplidar", daemon=True)
        self.newest: Scan | None = None
        self.lost = ""
        """Why there is no device any more."""
        self.running = True
        self._port = port
        self._turns = turns
        self._lidar = lidar
        self._now = now

    def run(self) -> None:
        """Read until told to end, or until the device is gone."""
        awake = time.monotonic()
        while self.running:
            time.sleep(POLL)
            try:
                data = self._port.read(CHUNK)
                before, awake = awake, time.monotonic()
                if awake - before > STALL:
                    self._port.reset_input_buffer()
                    self._turns.forget()
                    continue
            except PORT_ERRORS as error:
                self.lost = str(error) or type(error).__name__
                return
            self._keep(self._turns.feed(data))

    def _keep(self, turns: list[Turn]) -> None:
        if turns:
            stamp = self._now()
            bearings, distances = turns[-1]
            self.newest = Scan(binned(bearings, distances, self._lidar), stamp)


class _Outbox:
    """What lds2d's drivers send through: the port, without pyserial's wait for more room."""

    def __init__(self, port: Any) -> None:
        self._port = port

    def write(self, data: bytes) -> None:
        put(self._port, data)


def _library() -> Any:
    try:
        from lds2d.drivers import rplidar  # noqa: PLC0415
    except ImportError:
        raise MissingExtraError("a real LiDAR", "lidar") from None
    return rplidar


def _greeted(port: Any, device: str, library: Any) -> Any:
    """lds2d's driver on the port, its motor on, at the baud at which the device answers.

    A device that still measures for a process that crashed is stopped first.
    """
    heard = 0
    for model in (library.RPLIDAR_A1, library.RPLIDAR_C1) * TRIES:
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
    """By DTR, as adapters of the A1 do it (a terminal has none), and by command, as others do."""
    with contextlib.suppress(*PORT_ERRORS):
        port.dtr = False
    put(port, MOTOR_ON)


def _hold_motor(port: Any) -> None:
    """By DTR, which stays when the port is closed: without it an A1's motor would turn again."""
    with contextlib.suppress(*PORT_ERRORS):
        port.dtr = True
    with contextlib.suppress(ImportError, *PORT_ERRORS):  # Windows has no termios
        import termios  # noqa: PLC0415

        attributes = termios.tcgetattr(port.fileno())
        attributes[2] &= ~termios.HUPCL
        termios.tcsetattr(port.fileno(), termios.TCSANOW, attributes)


def _check_health(port: Any, device: str) -> None:
    health, _ = _ask(port, GET_HEALTH, HEALTH)
    if health is not None and health[0] == BROKEN:
        raise LidarError(
            f"LiDAR {device}: reports error 0x{health[2]:02x}{health[1]:02x} and won't measure",
            "unplug it for a few seconds, then reset; if it comes again, the device is broken",
        )


def _ask(port: Any, request: bytes, descriptor: bytes) -> tuple[bytes | None, int]:
    """What follows the descriptor, None if that never comes; and how many bytes came."""
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


@contextlib.contextmanager
def _translated(device: str) -> Iterator[None]:
    """Errors of a port in use become LidarError."""
    try:
        yield
    except PORT_ERRORS as error:
        raise _lost(device, str(error)) from None


def _lost(device: str, why: str) -> LidarError:
    return LidarError(f"LiDAR {device}: lost while in use ({why})", "check the cable, then reset")
