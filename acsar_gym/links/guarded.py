"""The life cycle of a link to real wheels: lock, watchdog, and zero on every exit path."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator

from acsar_gym.config import RobotConfig
from acsar_gym.errors import LinkLostError
from acsar_gym.guard.shutdown import (
    check_may_drive,
    check_may_start,
    close_at_exit,
    forget_link,
    install_handlers,
)
from acsar_gym.guard.watchdog import CHILD_TIMEOUT, Watchdog
from acsar_gym.links.base import Link
from acsar_gym.worlds import Scene

LOCK_TIMEOUT = 1.0  # longest wait for another thread's write [s]. A socket's takes at most 0.2 s


class GuardedLink(Link):
    """A link whose wheels are real. Subclasses connect, send and drain.

    While it is open, a watchdog process commands zero if this process dies, or hangs longer than
    `watchdog_timeout` while wheels turn. `close` and every error command zero first.

    Attributes:
        watchdog: The watchdog process.

    Args:
        device: Name of the device, or the URL.
        config: Robot configuration.
        zeros: Bytes that the watchdog writes to stop the wheels.
    """

    is_real = True
    lateness = 0.0
    watchdog_start = CHILD_TIMEOUT
    """Longest wait for the watchdog to start [s]."""

    def __init__(self, device: str, config: RobotConfig, zeros: bytes = b"") -> None:
        self.device = device
        self.watchdog = Watchdog(zeros, config.watchdog_timeout)
        self._config = config
        self._deadline = 0.0
        self._make_locks()
        install_handlers()

    def _make_locks(self) -> None:
        self._lock = threading.RLock()  # a signal handler may run while this thread holds it
        self._queue = threading.RLock()  # held by a thread that waits to stop the robot

    # What subclasses provide.

    @property
    def is_open(self) -> bool:
        """Whether the device is open."""
        raise NotImplementedError

    def _connect(self) -> None:
        """Open the device. LinkError if that fails, and then `_disconnect` is called."""
        raise NotImplementedError

    def _start_watchdog(self) -> None:
        """Start the watchdog process, with the lock held."""
        raise NotImplementedError

    def _wait_for_feedback(self) -> None:
        """Wait until the robot answers. LinkError if it doesn't."""
        raise NotImplementedError

    def _prepare(self, scene: Scene) -> None:
        """Prepare an episode, after zero was commanded and before driving is allowed."""

    def _forget_feedback(self) -> None:
        """Discard what arrived before an episode."""
        raise NotImplementedError

    def _is_stop(self, data: bytes) -> bool:
        """Whether the newest command of these bytes is zero."""
        raise NotImplementedError

    def _send(self, data: bytes) -> None:
        """Send command lines. LinkLostError if the device is gone."""
        raise NotImplementedError

    def _send_stop(self) -> bool:
        """Send zeros without raising an exception. Returns whether the device accepted them."""
        raise NotImplementedError

    def _drain(self) -> bool:
        """Wait a moment until what was sent has left. Returns whether it has. Raises nothing."""
        raise NotImplementedError

    def _disconnect(self, *, lost: bool) -> None:
        """Free the device, in any state. `lost`: it didn't accept the last zeros."""
        raise NotImplementedError

    def _detach(self) -> None:
        """Release this process's copy of the device in a forked child, without sending anything."""
        raise NotImplementedError

    # The life cycle.

    @property
    def unwatched(self) -> str:
        """Why no watchdog watches the open link. Empty if one does."""
        if self._config.watchdog_timeout is None:
            return "watchdog_timeout: null"
        return "" if self.watchdog.is_started else "not on this system, or not for this port"

    def open(self) -> None:
        """Open the device, command zero, start the watchdog, and wait for the robot. Idempotent.

        Raises:
            LinkError: The robot can't be reached, no watchdog can be started, or the program is
                about to end. The device is closed again.
        """
        if self.is_open:
            return
        check_may_start()

        # Before the first byte: from here on every exit path commands zero.
        close_at_exit(self)
        try:
            self._connect()
            self._send_stop()
            with self._lock:
                self._start_watchdog()
            self._wait_for_feedback()
            self.watchdog.wait_ready(self.watchdog_start)
        except BaseException:
            # Also after Ctrl-C: a link that isn't ready must not stay open.
            self.close()
            forget_link(self)
            raise
        self._deadline = self.now()

    def reset(self, scene: Scene) -> None:
        """Command zero, discard what arrived, and restart the deadlines.

        After the watchdog stopped the robot, this allows driving again.
        """
        self.stop()
        check_may_start()

        try:
            self._replace_dead_watchdog()
            self._prepare(scene)
            with self._lock:
                self.watchdog.rearm()
            self._forget_feedback()
        except BaseException:  # don't drive without a watchdog
            self.close()
            raise
        self._deadline = self.now()
        self.lateness = 0.0

    def _replace_dead_watchdog(self) -> None:
        with self._lock:  # a closed descriptor may be reused for another file
            self._require_open()
            is_dead = self.watchdog.is_started and not self.watchdog.is_alive
            if is_dead:
                self.watchdog.close()
                self._start_watchdog()
        if is_dead:
            self.watchdog.wait_ready(self.watchdog_start)

    def write(self, data: bytes) -> None:
        """Send command lines. Zero commands are always sent.

        Raises:
            LinkError: Wheels would turn, but the watchdog stopped the robot or doesn't run, or
                the program is about to end. Zeros are sent instead.
        """
        with self._queue:  # a thread that waits to stop the robot goes first
            pass
        with self._lock:
            self._require_open()
            if not data:
                return
            # Stopping needs no permission: a tripped watchdog or a signal doesn't prevent it.
            if self._is_stop(data):
                self._send(data)
                self.watchdog.note_stop()
                return

            try:
                self.watchdog.allow_drive()
                check_may_drive()  # last, as a signal may come at any time
                self._send(data)
                self.watchdog.note_drive()
            except BaseException:
                self._send_stop()
                raise

    def stop(self) -> None:
        """Command zero and stay open.

        Raises:
            LinkLostError: The link is closed, or the device is gone.
        """
        with self._exclusively():
            self._require_open()
            if not self._send_stop():
                raise LinkLostError(f"{self.device}: lost while in use", "check the cable")
            self.watchdog.note_stop()

    def close(self) -> None:
        """Command zero, wait until it has been sent, and close. Idempotent."""
        with self._exclusively():
            if not self.is_open:
                return
            sent = False
            try:
                sent = self._send_stop() and self._drain()
            finally:  # also after Ctrl-C in the middle
                self._finish(lost=not sent)

    def _finish(self, *, lost: bool) -> None:
        with contextlib.ExitStack() as last_to_first:  # each step also if another one fails
            last_to_first.callback(self._disconnect, lost=lost)
            last_to_first.callback(forget_link, self)
            last_to_first.callback(self.watchdog.close)  # before the device, for its lock

            # Again, as a line may be lost. Bytes that can't leave would delay the closing.
            if self._send_stop():
                self._drain()

    @contextlib.contextmanager
    def _exclusively(self) -> Iterator[None]:
        """Lock out other threads. If a thread is writing now, send zeros without waiting for it."""
        is_mine = self._lock.acquire(blocking=False)
        if not is_mine:
            self._send_stop()
            # New writers wait in `write` until this thread has the lock.
            with self._queue:
                is_mine = self._lock.acquire(timeout=LOCK_TIMEOUT)
        try:
            yield
        finally:
            if is_mine:
                self._lock.release()

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Command zero, and lock out commands of other threads, as a context manager.

        Errors are ignored. The watchdog still assumes that wheels turn: if this takes long, it
        trips.
        """
        with self._exclusively():
            if self.is_open and self._send_stop():
                self._drain()
            yield

    def abandon(self) -> None:
        """Release the device without sending anything, for a forked child."""
        self._make_locks()  # a thread of the parent may have held them
        if self.is_open:
            self.watchdog.abandon()
            forget_link(self)
            self._detach()

    def _beat(self) -> None:
        """Give the watchdog a sign of life."""
        with self._lock:
            self.watchdog.beat()

    def _require_open(self) -> None:
        if not self.is_open:
            raise self._closed_error()

    def _closed_error(self) -> LinkLostError:
        return LinkLostError(f"{self.device} is closed", "call open() or env.reset() first")

    def __del__(self) -> None:
        if hasattr(self, "watchdog") and self.is_open:
            self.close()

    def __reduce__(self) -> tuple[type[GuardedLink], tuple[object, ...]]:
        """Copy and pickle as a closed link to the same device, which can't be shared."""
        return type(self), (self.device, self._config)
