"""The real wire: a serial port, absolute deadlines, and a watchdog beside them."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkError, LinkLostError
from acsar_gym.links.handshake import wait_for_board
from acsar_gym.links.open_port import OpenPort
from acsar_gym.links.ports import Location
from acsar_gym.links.shutdown import close_at_exit, forget, install, is_ending
from acsar_gym.links.watchdog_handle import WatchdogHandle
from acsar_gym.protocol import ZERO, encode
from acsar_gym.worlds import Scene

SILENT_SHARE = 0.5
"""A board that is silent for this share of `feedback_timeout` may not have heard the zeros."""
PATIENCE = 1.0
"""Longest wait for another thread to finish its write [s]; a socket's takes 0.2 s at most."""


class SerialLink:
    """A board on a serial device: 8N1, no flow control, opened exclusively.

    `device` is a device, a URL, or "usb:" and the serial number of a USB adapter. A port that was
    lost is looked for under the same adapter's name, wherever it was plugged in again.
    `lateness` is how long after its deadline the newest period ended [s]. While it is driven, no
    call takes longer than a period.

    While it is open, a process of its own commands zero where this one dies, or hangs for longer
    than the config's `watchdog_timeout` while wheels turn; `watched` tells whether there is one.
    """

    truth = None

    def __init__(self, device: str, config: RobotConfig) -> None:
        self.device = device
        self._config = config
        self._port: OpenPort | None = None
        self._lock = threading.RLock()  # a signal's handler may interrupt whoever has it
        self._location = Location(device)
        self._heard = 0.0
        self._moved = False
        self._zeros = encode(ZERO, trailing_comma=config.trailing_comma)
        self._stop_line = b"\r\n" + self._zeros  # a command cut short can't swallow these zeros
        self._watch = WatchdogHandle(config, self._location, self._stop_line)
        self._deadline = 0.0
        self.lateness = 0.0
        install()

    def open(self) -> None:
        """Open the device, command zero, and wait for the board's first valid line.

        Where the port was lost before, it has the config's `reconnect_timeout` to come back.

        Raises PortNotFoundError, PortPermissionError, PortBusyError, BoardSilentError or
        BoardGarbledError, or LinkError where no watchdog can be started or the program is about to
        end; the device is closed again then.
        """
        if self._port is not None:
            return
        if is_ending():
            raise _too_late()
        self._port = OpenPort(
            self._location.opened(self._config, self._watch.end_search), self.device
        )
        close_at_exit(self)
        try:
            self._stop_motors()
            with self._lock:
                self._watch.start(self._require())
            self._flush()
            self._stop_motors()
            wait_for_board(self.read_now, self.device, self._config)
            self._watch.wait()
        except BaseException:
            self.close()
            raise
        self._deadline = self.now()

    def _flush(self) -> None:
        self._require().drop_input()
        self._require().drop_output()

    @property
    def watched(self) -> bool:
        """Whether a process of its own would stop the robot now, did this one die or hang."""
        return self._watch.alive

    @property
    def watchdog_pid(self) -> int | None:
        """That process; None where there is none."""
        return self._watch.pid

    def reset(self, scene: Scene) -> None:
        """Command zero, drop what lies in the buffer, and start the deadlines anew.

        A watchdog that stopped the robot lets it drive again.
        """
        self._stop_motors()
        try:
            self._watch_anew()
        except BaseException:  # nothing drives unwatched
            self.close()
            raise
        self.reset_input()
        self._moved, self._heard = False, self.now()
        self._deadline = self.now()
        self.lateness = 0.0

    def _watch_anew(self) -> None:
        with self._lock:  # a descriptor that is closed meanwhile may soon be another file's
            fresh = self._watch.renew(self._require())
        if fresh:
            self._watch.wait()
        with self._lock:
            self._watch.rearm()

    def write(self, data: bytes) -> None:
        """Send bytes to the board.

        Raises LinkError where they turn wheels and the watchdog has stopped the robot or doesn't
        run, or the program is about to end; zeros always go out.
        """
        with self._lock:
            if not data:
                self._require().put(data)
            elif data.endswith(self._zeros):
                self._require().put(data)
                self._watch.stand()
            elif is_ending():
                raise _too_late()
            else:
                self._moved = True
                self._watch.drive()
                self._require().put(data)
                self._watch.driven()

    def advance(self, period: float) -> bytes:
        """Sleep until the period's absolute deadline, then take what has arrived.

        After a delay of more than a period the deadlines start anew from now.
        """
        self._deadline += period
        while (remaining := self._deadline - self.now()) > 0.0:
            time.sleep(min(remaining, self._watch.nap))
            self._beat()
        self.lateness = self.now() - self._deadline
        if self.lateness > period:
            self._deadline = self.now()
        return self.read_now()

    def _beat(self) -> None:
        with self._lock:
            self._watch.beat()

    def reset_input(self) -> None:
        """Drop what has arrived and wasn't read."""
        self._require().drop_input()

    def read_now(self) -> bytes:
        """What has arrived; waits for nothing."""
        self._beat()
        data = self._require().read()
        if data:
            self._heard = self.now()
        return data

    def now(self) -> float:
        """The monotonic clock [s]."""
        return time.monotonic()

    def close(self) -> None:
        """Command zero, let it leave the port, close; idempotent.

        An interrupt while the zeros are on their way sends them again before it goes on. Where they
        may not have arrived, because the port is lost, or the board silent since wheels turned, the
        watchdog goes on commanding zero for a minute, or until the board answers.
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
        """No other thread writes inside the block; one that is writing now delays no zero."""
        alone = self._lock.acquire(blocking=False)
        if not alone:
            port = self._port
            if port is not None:
                port.says(self._stop_line)
            alone = self._lock.acquire(timeout=PATIENCE)
        try:
            yield
        finally:
            if alone:
                self._lock.release()

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Command zero; inside the block no other thread commands anything else.

        Errors are no concern of whoever must stop now.
        """
        with self._alone():
            port = self._port
            if port is not None:
                self._say_stop(port)
            yield

    def _is_silent(self, port: OpenPort) -> bool:
        """Whether the board hasn't answered for a while, since wheels were commanded to turn."""
        silent = self.now() - self._heard > SILENT_SHARE * self._config.feedback_timeout
        return self._moved and silent and port.is_quiet()

    def _say_stop(self, port: OpenPort) -> bool:
        """Whether the zeros have left the port."""
        if not port.says(self._stop_line):
            return False
        self._watch.stand()
        if not port.is_drained():
            port.says(self._stop_line)
            return False
        return True

    def stop(self) -> None:
        """Command zero and stay open; errors are no concern of whoever must stop now."""
        with self.held():
            pass

    def _release(self, port: OpenPort, *, lost: bool) -> None:
        """The last word is zero; then the watchdog first, since it shares the port's lock."""
        with contextlib.ExitStack() as last_to_first:
            last_to_first.callback(self._let_go, port, lost=lost)
            last_to_first.callback(self._watch.end, lost=lost)
            if not lost:
                self._say_stop(port)

    def _let_go(self, port: OpenPort, *, lost: bool) -> None:
        self._port = None
        self._location.left(lost=lost)
        forget(self)
        port.close()

    def abandon(self) -> None:
        """Let go without a word, as a forked child must do with its parent's port."""
        self._lock = threading.RLock()  # another thread, which isn't here, may have had it
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
        """Copies and pickles are closed links to the same device; a port can't be shared."""
        return SerialLink, (self.device, self._config)

    def _stop_motors(self) -> None:
        self.write(self._stop_line)

    def _require(self) -> OpenPort:
        if self._port is None:
            raise LinkLostError(f"{self.device} is closed", "call open() or env.reset() first")
        return self._port


def _too_late() -> LinkError:
    return LinkError("the program is about to end", "nothing drives any more: start it again")
