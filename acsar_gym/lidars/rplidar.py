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
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LidarError, LinkError
from acsar_gym.lidars.base import Scan
from acsar_gym.lidars.moving import scanned
from acsar_gym.lidars.revolutions import Turn, Turns
from acsar_gym.lidars.rplidar_device import (
    CHUNK,
    MOTOR_OFF,
    POLL,
    check_health,
    greeted,
    hold_motor,
    library,
)
from acsar_gym.links.base import WHILE_WAITING
from acsar_gym.links.ports import PORT_ERRORS, Location, put
from acsar_gym.links.shutdown import close_at_exit, forget, install
from acsar_gym.odometry import Odometry
from acsar_gym.worlds import Scene

STALL = 0.1
"""If the reader slept for longer, the bytes in the port are too old to be stamped and are
dropped [s]."""
SPIN_UP = 5.0
"""From standstill to the first complete revolution, at most [s]."""
END = 0.5
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
        self._location = Location(device)
        self._port: Any = None
        self._driver: Any = None
        self._reader: _Reader | None = None
        self._odometry = Odometry.of(config)
        install()

    def follow(self, odometry: Odometry) -> None:
        """Allow for the motion that this odometry tells, from the next opening on.

        Args:
            odometry: of the robot that carries the LiDAR; without one it stands still.
        """
        self._odometry = odometry

    def reset(self, scene: Scene, rng: np.random.Generator) -> None:
        """Open the device if it is closed or doesn't deliver, and wait for a complete revolution.

        A device that was lost has the config's `reconnect_timeout` to come back. The device is
        closed
        again where this raises.

        Raises:
            LidarError: the device can't be opened, or doesn't measure.
            MissingExtraError: lds2d isn't installed.
        """
        with contextlib.suppress(LidarError):
            self._newest()
            return
        self.close()
        try:
            self._open(library())
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
        with _translated(self.device):
            self._driver = greeted(self._port, self.device, models)
            check_health(self._port, self.device)
            self._driver.start()
        decoder = Turns(models)
        self._reader = _Reader(self._port, decoder, self._config, self._now, self._odometry)
        self._reader.start()
        self._wait_for_a_turn(self._reader)

    def _wait_for_a_turn(self, reader: _Reader) -> None:
        """Wait for the first complete revolution; LidarError after SPIN_UP."""
        deadline = time.monotonic() + SPIN_UP
        while reader.newest is None:
            if reader.lost:
                raise _lost(self.device, reader.lost)
            if time.monotonic() > deadline:
                raise LidarError(
                    f"LiDAR {self.device}: no complete turn in {SPIN_UP:g} s",
                    "check that its head turns freely and that its 5 V supply is strong enough",
                )
            WHILE_WAITING.get()()
            time.sleep(POLL)

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
        """Tell the reader thread to end and wait for it."""
        reader = self._reader
        if reader is None:
            return
        reader.running = False
        # The garbage collector may close a LiDAR in any thread, this one included.
        if reader.is_alive() and reader is not threading.current_thread():
            reader.join(END)

    def _say_stop(self, port: Any) -> None:
        """Command the LiDAR to stop measuring, and its motor to stop."""
        with contextlib.suppress(*PORT_ERRORS):
            if self._driver is not None:
                self._driver.stop()
            put(port, MOTOR_OFF)
        hold_motor(port)

    def _release(self, port: Any) -> None:
        """Close the port and forget it."""
        self._location.left(lost=self._reader is not None and bool(self._reader.lost))
        self._port = self._driver = self._reader = None
        forget(self)
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
        turns: Turns,
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
        self._turns = turns
        self._config = config
        self._now = now
        self._odometry = odometry

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
        """Keep the newest of these revolutions as a scan."""
        if turns:
            stamp, twist = self._now(), self._odometry.twist
            ranges = scanned(turns[-1], self._duration(stamp), twist, self._config)
            self.newest = Scan(ranges, stamp)

    def _duration(self, stamp: float) -> float:
        """Time of the revolution that ends now [s]: since the last one, if that's likely."""
        usual = 1.0 / self._config.lidar.rate
        since = usual if self.newest is None else stamp - self.newest.stamp
        return since if since < 2.0 * usual else usual


@contextlib.contextmanager
def _translated(device: str) -> Iterator[None]:
    """Convert errors of an open port to LidarError."""
    try:
        yield
    except PORT_ERRORS as error:
        raise _lost(device, str(error)) from None


def _lost(device: str, why: str) -> LidarError:
    """The LidarError for a device that is gone."""
    return LidarError(f"LiDAR {device}: lost while in use ({why})", "check the cable, then reset")
