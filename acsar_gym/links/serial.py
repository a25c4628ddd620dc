"""A link to a real board: serial port, absolute deadlines, and watchdog."""

from __future__ import annotations

import contextlib
import threading
import time
import warnings
from collections.abc import Iterator, Sequence

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkError, LinkLostError, SafetyWarning
from acsar_gym.guard.shutdown import check_may_drive, close_at_exit, forget_link, install_handlers
from acsar_gym.guard.watchdog import Watchdog, end_searches
from acsar_gym.links.base import Arrivals
from acsar_gym.links.handshake import find_echo, wait_for_board
from acsar_gym.links.ports import OpenPort, PortLocation
from acsar_gym.protocol import ECHO_PROBE, ECHO_ZERO, ZERO, encode, line_end
from acsar_gym.worlds import Scene

ECHO_WARNING = (
    "this board echoes: it sends each command back, and the echoes don't count as feedback; take "
    "the echo out of its program, or write echo: true into the robot's file"
)
SILENT_SHARE = 0.5  # a board silent for this share of feedback_timeout may have missed zeros
WRITER_TIMEOUT = 1.0  # longest wait for another thread's write [s]; a socket's takes at most 0.2 s
EMPTY_READ_PAUSE = 0.001  # pause where a port says that there are bytes and has none [s]


class SerialLink:
    """A board on a serial device: 8N1, no flow control, opened exclusively.

    A lost port is searched under the persistent name of its adapter. While open, a watchdog process
    sends zero commands if this process dies, or hangs longer than `watchdog_timeout` while wheels
    turn. During driving, no call takes longer than a period.

    Attributes: `device`; `lateness`; `watchdog`; `echoes`, whether the board sends every command
    back, as far as `open` or the config tells.
    """

    truth = None

    def __init__(self, device: str, config: RobotConfig, zeros: Sequence[bytes] = ()) -> None:
        self.device = device
        self._config = config
        self._port: OpenPort | None = None
        self._make_locks()
        self._location = PortLocation(device)
        self._heard = self._deadline = 0.0
        self._moved = False
        self._zeros = tuple(zeros) or (encode(ZERO, trailing_comma=config.trailing_comma),)
        self._stop_line = b"\r\n" + b"".join(self._zeros)  # ends a truncated command
        ends = [line_end(trailing_comma=comma) for comma in (False, True)]
        echoed = tuple(zero + end for zero in (ECHO_PROBE, ECHO_ZERO) for end in ends)
        self._stops = self._zeros + echoed  # what stops the wheels, when it is written
        self.echoes = config.echo
        self.watchdog = Watchdog(self._stop_line, config.watchdog_timeout)
        self._wants_arrivals = False
        self._arrivals: Arrivals = []
        self.lateness = 0.0
        install_handlers()

    @property
    def unwatched(self) -> str:
        """Why no watchdog watches the open link; empty where one does."""
        if self._config.watchdog_timeout is None:
            return "watchdog_timeout: null"
        return "" if self.watchdog.is_started else "not on this system, or not for this port"

    def _make_locks(self) -> None:
        self._lock = threading.RLock()  # a signal handler may run while this thread holds it
        self._turn = threading.RLock()

    def open(self) -> None:
        """Open the device, command zero, and wait for the first valid line. Idempotent.

        A port that was lost before has `reconnect_timeout` to reappear. Warns (SafetyWarning) where
        the board echoes, unlike in the config.

        Raises:
            LinkError: port or board can't be reached (see its subclasses), no watchdog can be
                started, or the program is ending, or was asked to (see
                `shutdown.check_may_drive`); the device is closed again.
        """
        if self._port is not None:
            return
        check_may_drive()
        location = self._location
        port = location.opened(self._config, lambda: end_searches(location.search_name))
        self._port = OpenPort(port, self.device)
        close_at_exit(self)
        try:
            self.write(self._stop_line)
            with self._lock:
                self.watchdog.start(self._require_port().fileno(), location.lasting_path)
            self._require_port().drop_input()
            self._require_port().drop_output()
            self.write(self._stop_line)
            wait_for_board(self.read_now, self.device, self._config)
            echoes = find_echo(self.write, self.read_now, self.device, self._config)
            self.echoes = echoes or self._config.echo
            self.watchdog.wait_ready()
            if echoes and not self._config.echo:
                self.report_echo()
        except BaseException:
            self.close()
            raise
        self._deadline = self.now()

    def report_echo(self) -> None:
        """Warn (SafetyWarning) of a board that echoes, unlike in the robot's file."""
        warnings.warn(f"{self.device}: {ECHO_WARNING}", SafetyWarning, 4)

    def reset(self, scene: Scene) -> None:
        """Command zero, discard received bytes, and restart the deadlines.

        After the watchdog stopped the robot, this allows driving again.
        """
        self.write(self._stop_line)
        check_may_drive()
        try:
            with self._lock:  # a closed descriptor may be reused for another file
                port = self._require_port()
                restart = self.watchdog.is_started and not self.watchdog.is_alive
                if restart:
                    self.watchdog.close()
                    self.watchdog.start(port.fileno(), self._location.lasting_path)
            if restart:
                self.watchdog.wait_ready()
            with self._lock:
                self.watchdog.rearm()
        except BaseException:  # don't drive without a watchdog
            self.close()
            raise
        self.reset_input()
        self._moved, self._heard = False, self.now()
        self._deadline = self.now()
        self.lateness = 0.0

    def write(self, data: bytes) -> None:
        """Send bytes to the board; zero commands are always sent.

        Raises:
            LinkError: wheels would turn, but the watchdog stopped the robot or doesn't run, or
                the program is ending, or was asked to; zeros are sent instead.
        """
        with self._turn:  # who waits to stop the robot comes before the next command
            pass
        with self._lock:
            port = self._require_port()
            if not data:
                port.write(data)
            elif data.endswith(self._stops):
                port.write(data)
                self.watchdog.note_stop()
            else:
                self._moved = True
                try:
                    self.watchdog.allow_drive()
                    check_may_drive()  # last, as a signal may come at any time
                    port.write(data)
                    self.watchdog.note_drive()
                except LinkLostError:
                    raise
                except LinkError:
                    port.try_write(self._stop_line)
                    raise

    def advance(self, period: float) -> bytes:
        """Sleep until the absolute deadline of the period [s]; return what has arrived.

        After a delay of more than a period, the deadlines restart from now.
        """
        self._deadline += period
        notes, self._wants_arrivals = self._wants_arrivals, False
        self._arrivals = pieces = []
        while (remaining := self._deadline - self.now()) > 0.0:
            port, pause = self._require_port(), min(remaining, self.watchdog.beat_interval)
            if not notes:
                time.sleep(pause)
            elif port.wait_for_bytes(pause):
                if data := port.read():
                    pieces.append((self.now(), data))
                else:
                    time.sleep(min(EMPTY_READ_PAUSE, pause))
            self._beat()
        self.lateness = self.now() - self._deadline
        if self.lateness > period:
            self._deadline = self.now()
        got = self.read_now()
        if notes and got:
            pieces.append((self.now(), got))
        got = b"".join([piece for _, piece in pieces]) if pieces else got
        self._heard = self.now() if got else self._heard
        return got

    @property
    def arrivals(self) -> Arrivals:
        """When the bytes of the newest period arrived [s], noted in the period after each call."""
        self._wants_arrivals = True
        return self._arrivals

    def _beat(self) -> None:
        with self._lock:
            self.watchdog.beat()

    def reset_input(self) -> None:
        """Discard what has arrived and wasn't read."""
        self._require_port().drop_input()

    def read_now(self) -> bytes:
        """Return what has arrived, without waiting."""
        self._beat()
        data = self._require_port().read()
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
        with self._exclusively():
            port = self._port
            if port is None:
                return
            sent = False
            try:
                sent = self._send_stop(port)
            except BaseException:
                sent = self._send_stop(port)
                raise
            finally:
                age = self.now() - self._heard
                silent = self._moved and age > SILENT_SHARE * self._config.feedback_timeout
                lost = not sent or (silent and port.is_quiet())
                with contextlib.ExitStack() as last_to_first:
                    last_to_first.callback(self._let_go, port, lost=lost)
                    if lost:
                        last_to_first.callback(self.watchdog.search, self._location.search_name)
                    else:  # before the port, as they share its lock
                        last_to_first.callback(self.watchdog.close)
                        self._send_stop(port)

    @contextlib.contextmanager
    def _exclusively(self) -> Iterator[None]:
        """Lock out other threads; if one is writing now, send zeros without waiting for it."""
        alone = self._lock.acquire(blocking=False)
        if not alone:
            port = self._port
            if port is not None:
                port.try_write(self._stop_line)
            with self._turn:
                alone = self._lock.acquire(timeout=WRITER_TIMEOUT)
        try:
            yield
        finally:
            if alone:
                self._lock.release()

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Command zero, and lock out commands of other threads, as a context manager.

        Errors are ignored. For the watchdog, wheels still turn: if this takes long, it trips.
        """
        with self._exclusively():
            port = self._port
            if port is not None:
                self._send_stop(port)
            yield

    def _send_stop(self, port: OpenPort) -> bool:
        """Command zero; returns whether it has left the port."""
        if not port.try_write(self._stop_line):
            return False
        if not port.drain():
            port.try_write(self._stop_line)
            return False
        return True

    def stop(self) -> None:
        """Command zero and stay open; errors are ignored."""
        with self.held():
            self.watchdog.note_stop()

    def _let_go(self, port: OpenPort, *, lost: bool) -> None:
        self._port = None
        self._location.left(lost=lost)
        forget_link(self)
        port.close()

    def abandon(self) -> None:
        """Release the port without sending anything, for a forked child."""
        self._make_locks()  # a thread of the parent may have held them
        port = self._port
        if port is None:
            return
        self.watchdog.abandon()
        port.detach()
        self._let_go(port, lost=False)

    def __del__(self) -> None:
        if getattr(self, "_port", None) is not None:
            self.close()

    def __reduce__(self) -> tuple[type[SerialLink], tuple[object, ...]]:
        """Copy and pickle as a closed link to the same device; a port can't be shared."""
        return SerialLink, (self.device, self._config, self._zeros)

    def _require_port(self) -> OpenPort:
        if self._port is None:
            raise LinkLostError(f"{self.device} is closed", "call open() or env.reset() first")
        return self._port
