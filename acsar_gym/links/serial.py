"""A link to a real board: serial port, absolute deadlines, and watchdog."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkError, LinkLostError
from acsar_gym.links.base import Arrivals
from acsar_gym.links.handshake import wait_for_board
from acsar_gym.links.ports import OpenPort, PortLocation
from acsar_gym.links.shutdown import check_may_drive, close_at_exit, forget_link, install_handlers
from acsar_gym.links.watchdog import WatchdogHandle
from acsar_gym.protocol import ZERO, encode
from acsar_gym.worlds import Scene

EMPTY_READ_PAUSE = 0.001
"""Pause where a port says that there are bytes and has none [s]."""


class ArrivalTimer:
    """Waits for the end of a control period, and notes what arrives meanwhile.

    Attributes: `wanted`, whether the next period's bytes are to be read as they arrive, and not
    only at its end, which costs less; `pieces`, what arrived in the newest period.
    """

    def __init__(self) -> None:
        self.wanted = False
        self._listens = False
        self.pieces: Arrivals = []

    def begin(self) -> None:
        """Begin a period."""
        self.pieces = []
        self._listens, self.wanted = self.wanted, False

    def wait(self, port: OpenPort, seconds: float) -> None:
        """Wait for bytes, or for a time [s]; LinkLostError if the device is gone."""
        if not self._listens:
            time.sleep(seconds)
        elif port.wait(seconds):
            data = port.read()
            if data:
                self.pieces.append((time.monotonic(), data))
            else:
                time.sleep(min(EMPTY_READ_PAUSE, seconds))

    def heard(self, rest: bytes) -> bytes:
        """End a period; returns all that arrived in it, `rest` being what is read just now."""
        if rest and self._listens:
            self.pieces.append((time.monotonic(), rest))
        return b"".join([piece for _, piece in self.pieces]) if self.pieces else rest


SILENT_SHARE = 0.5
"""A board silent for this share of `feedback_timeout` may not have received zero commands."""
WRITER_TIMEOUT = 1.0
"""Longest wait for another thread's write [s]; a socket's takes at most 0.2 s."""


class SerialLink:
    """A board on a serial device: 8N1, no flow control, opened exclusively.

    A lost port is searched under the persistent name of its adapter. While open, a watchdog process
    sends zero commands if this process dies, or hangs longer than `watchdog_timeout` while wheels
    turn. During driving, no call takes longer than a period.

    Args:
        device: a device, a URL, or "usb:" and the serial number of a USB adapter.
        config: configuration of the robot.
        zeros: zero commands, where that of the config isn't enough.
    """

    truth = None

    def __init__(self, device: str, config: RobotConfig, zeros: Sequence[bytes] = ()) -> None:
        self.device = device
        self._config = config
        self._port: OpenPort | None = None
        self._lock = threading.RLock()  # a signal handler may run while this thread holds it
        self._location = PortLocation(device)
        self._heard = 0.0
        self._moved = False
        self._zeros = tuple(zeros) or (encode(ZERO, trailing_comma=config.trailing_comma),)
        self._stop_line = b"\r\n" + b"".join(self._zeros)  # ends a truncated command
        self._watch = WatchdogHandle(config, self._location, self._stop_line)
        self._deadline = 0.0
        self._ear = ArrivalTimer()
        self.lateness = 0.0
        install_handlers()

    def open(self) -> None:
        """Open the device, command zero, and wait for the first valid line. Idempotent.

        A port that was lost before has `reconnect_timeout` to reappear.

        Raises:
            LinkError: port or board can't be reached (see its subclasses), no watchdog can be
                started, or the program is ending, or was asked to (see
                `shutdown.check_may_drive`); the device is closed again.
        """
        if self._port is not None:
            return
        check_may_drive()
        self._port = OpenPort(
            self._location.opened(self._config, self._watch.end_search), self.device
        )
        close_at_exit(self)
        try:
            self._stop_motors()
            with self._lock:
                self._watch.start(self._require())
            self._require().drop_input()
            self._require().drop_output()
            self._stop_motors()
            wait_for_board(self.read_now, self.device, self._config)
            self._watch.wait()
        except BaseException:
            self.close()
            raise
        self._deadline = self.now()

    @property
    def watched(self) -> bool:
        """Whether a running watchdog would stop the robot if this process died or hung."""
        return self._watch.alive

    @property
    def watchdog_pid(self) -> int | None:
        """PID of the watchdog; None if there is none."""
        return self._watch.pid

    def reset(self, scene: Scene) -> None:
        """Command zero, discard received bytes, and restart the deadlines.

        After the watchdog stopped the robot, this allows driving again.
        """
        self._stop_motors()
        check_may_drive()
        try:
            self._watch_anew()
        except BaseException:  # don't drive without a watchdog
            self.close()
            raise
        self.reset_input()
        self._moved, self._heard = False, self.now()
        self._deadline = self.now()
        self.lateness = 0.0

    def _watch_anew(self) -> None:
        """Restart a watchdog that doesn't run, and rearm it."""
        with self._lock:  # a closed descriptor may be reused for another file
            fresh = self._watch.renew(self._require())
        if fresh:
            self._watch.wait()
        with self._lock:
            self._watch.rearm()

    def write(self, data: bytes) -> None:
        """Send bytes to the board; zero commands are always sent.

        Raises:
            LinkError: wheels would turn, but the watchdog stopped the robot or doesn't run, or
                the program is ending, or was asked to; zeros are sent instead.
        """
        with self._lock:
            port = self._require()
            if not data:
                port.put(data)
            elif data.endswith(self._zeros):
                port.put(data)
                self._watch.stand()
            else:
                self._moved = True
                try:
                    self._watch.drive()
                    check_may_drive()  # last, as a signal may come at any time
                    port.put(data)
                    self._watch.driven()
                except LinkLostError:
                    raise
                except LinkError:
                    port.says(self._stop_line)
                    raise

    def advance(self, period: float) -> bytes:
        """Sleep until the absolute deadline of the period [s]; return what has arrived.

        After a delay of more than a period, the deadlines restart from now.
        """
        self._deadline += period
        self._ear.begin()
        while (remaining := self._deadline - self.now()) > 0.0:
            self._ear.wait(self._require(), min(remaining, self._watch.nap))
            self._beat()
        self.lateness = self.now() - self._deadline
        if self.lateness > period:
            self._deadline = self.now()
        got = self._ear.heard(self.read_now())
        self._heard = self.now() if got else self._heard
        return got

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived [s], noted in the period after each call."""
        self._ear.wanted = True
        return self._ear.pieces

    def _beat(self) -> None:
        """Signal the watchdog that this process runs."""
        with self._lock:
            self._watch.beat()

    def reset_input(self) -> None:
        """Discard what has arrived and wasn't read."""
        self._require().drop_input()

    def read_now(self) -> bytes:
        """Return what has arrived, without waiting."""
        self._beat()
        data = self._require().read()
        if data:
            self._heard = self.now()
        return data

    def now(self) -> float:
        """Return the monotonic clock [s]."""
        return time.monotonic()

    def close(self) -> None:
        """Command zero, wait until it has been sent, and close. Idempotent.

        After an interrupt meanwhile, zeros are sent again. If they may not have arrived (lost port,
        silent board), the watchdog keeps sending them for a minute, or until the board answers.
        """
        with self._alone():
            port = self._port
            if port is None:
                return
            said = False
            try:
                said = self._say_stop(port)
            except BaseException:
                said = self._say_stop(port)
                raise
            finally:
                self._release(port, lost=not said or self._is_silent(port))

    @contextlib.contextmanager
    def _alone(self) -> Iterator[None]:
        """Lock out other threads; if one is writing now, send zeros without waiting for it."""
        alone = self._lock.acquire(blocking=False)
        if not alone:
            port = self._port
            if port is not None:
                port.says(self._stop_line)
            alone = self._lock.acquire(timeout=WRITER_TIMEOUT)
        try:
            yield
        finally:
            if alone:
                self._lock.release()

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Command zero, and lock out commands of other threads, as a context manager.

        Errors are ignored, so that stopping goes on. For the watchdog, wheels still turn: if this
        takes longer than its time-out, as where the program is suspended, it trips.
        """
        with self._alone():
            port = self._port
            if port is not None:
                self._say_stop(port)
            yield

    def _is_silent(self, port: OpenPort) -> bool:
        """Return whether the board hasn't answered for a while, since wheels turned."""
        silent = self.now() - self._heard > SILENT_SHARE * self._config.feedback_timeout
        return self._moved and silent and port.is_quiet()

    def _say_stop(self, port: OpenPort) -> bool:
        """Command zero; returns whether it has left the port."""
        if not port.says(self._stop_line):
            return False
        if not port.is_drained():
            port.says(self._stop_line)
            return False
        return True

    def stop(self) -> None:
        """Command zero and stay open; errors are ignored."""
        with self.held():
            self._watch.stand()

    def _release(self, port: OpenPort, *, lost: bool) -> None:
        """Command zero, end the watchdog, which shares the port's lock, and close the port."""
        with contextlib.ExitStack() as last_to_first:
            last_to_first.callback(self._let_go, port, lost=lost)
            last_to_first.callback(self._watch.end, lost=lost)
            if not lost:
                self._say_stop(port)

    def _let_go(self, port: OpenPort, *, lost: bool) -> None:
        """Close the port."""
        self._port = None
        self._location.left(lost=lost)
        forget_link(self)
        port.close()

    def abandon(self) -> None:
        """Release the port without sending anything, for a forked child."""
        self._lock = threading.RLock()  # a thread of the parent may have held it
        port = self._port
        if port is None:
            return
        self._watch.abandon()
        port.detach()
        self._let_go(port, lost=False)

    def __del__(self) -> None:
        if getattr(self, "_port", None) is not None:
            self.close()

    def __reduce__(self) -> tuple[type[SerialLink], tuple[str, RobotConfig]]:
        """Copy and pickle as a closed link to the same device; a port can't be shared."""
        return SerialLink, (self.device, self._config)

    def _stop_motors(self) -> None:
        self.write(self._stop_line)

    def _require(self) -> OpenPort:
        if self._port is None:
            raise LinkLostError(f"{self.device} is closed", "call open() or env.reset() first")
        return self._port
