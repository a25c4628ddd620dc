"""The real wire: a serial port, absolute deadlines, and a watchdog beside them."""

from __future__ import annotations

import contextlib
import math
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

from acsar_gym.config import BAUD_RATES, RobotConfig
from acsar_gym.errors import BoardGarbledError, BoardSilentError, LinkError, LinkLostError
from acsar_gym.links import watchdog
from acsar_gym.links.ports import PORT_ERRORS, Place, Port, put, translated
from acsar_gym.links.shutdown import guard, install, is_ending, unguard
from acsar_gym.protocol import ZERO, Decoder, encode
from acsar_gym.worlds import Scene

POLL = 0.01
"""How often activation looks for the first valid line [s]."""
CHUNK = 4096
"""Most bytes taken from the port at once."""
MOST_CHUNKS = 256
"""Chunks taken in one go, at most: what lies in any driver's buffer, and no endless stream."""
SILENT_SHARE = 0.5
"""A board that is silent for this share of `feedback_timeout` may not have heard the zeros."""
DRAIN = 0.05
"""Zeros have so long to leave the port when it is closed [s]."""
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
        self._port: Port | None = None
        self._watchdog: watchdog.Watchdog | None = None
        self._lock = threading.RLock()  # a signal's handler may interrupt whoever has it
        self._place = Place(device)
        self._heard = 0.0
        self._moved = False
        self._zeros = encode(ZERO, trailing_comma=config.trailing_comma)
        self._nap = math.inf
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
        self._port = self._place.opened(self._config, self._call_back)
        guard(self)
        try:
            self._stop_motors()
            self._watch()
            self._flush()
            self._stop_motors()
            self._wait_for_board()
            self._wait_for_watchdog()
        except BaseException:
            self.close()
            raise
        self._deadline = self.now()

    def _call_back(self) -> None:
        """End the search for this port: not before it is there, for it may stay lost."""
        watchdog.call_back(self._place.path or self.device)

    def _watch(self) -> None:
        """Start the watchdog, where the config wants one and the port is a file to share."""
        timeout = self._config.watchdog_timeout
        if timeout is None or not watchdog.AVAILABLE:
            return
        with self._lock:  # a descriptor that is closed meanwhile may soon be another file's
            try:
                descriptor = self._require().fileno()
            except OSError:  # rfc2217 has none
                return
            place = self._place.path if self._place.path and self._place.lasts else ""
            self._watchdog = watchdog.Watchdog(descriptor, self._stop_line(), timeout, place)
        self._nap = timeout / 3.0

    @property
    def watched(self) -> bool:
        """Whether a process of its own would stop the robot now, did this one die or hang."""
        return self._watchdog is not None and self._watchdog.alive

    @property
    def watchdog_pid(self) -> int | None:
        """That process; None where there is none."""
        return self._watchdog.pid if self._watchdog is not None else None

    def _flush(self) -> None:
        self.reset_input()
        with translated(self.device):
            self._require().reset_output_buffer()

    def _wait_for_board(self) -> None:
        decoder = Decoder()
        heard = 0
        deadline = self.now() + self._config.connect_timeout
        while not decoder.lines:
            if self.now() > deadline:
                raise self._no_board(heard)
            time.sleep(POLL)
            data = self.read_now()
            heard += len(data)
            decoder.feed(data)

    def _no_board(self, heard: int) -> BoardSilentError:
        waited, baud = self._config.connect_timeout, self._config.baud_rate
        if heard:
            others = ", ".join(str(rate) for rate in BAUD_RATES if rate != baud)
            return BoardGarbledError(
                f"{self.device}: {heard} bytes in {waited:g} s at {baud} baud, but no valid line",
                f"the board probably uses another baud_rate ({others})",
            )
        return BoardSilentError(
            f"{self.device}: no byte from the board in {waited:g} s",
            "check its power and cable, and the port's name (acsar-gym doctor lists them)",
        )

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
        dog = self._watchdog
        if dog is not None and not dog.alive:
            with self._lock:
                if self._watchdog is dog:
                    self._watchdog = None
                    dog.close()
                    self._watch()
            self._wait_for_watchdog()
        with self._lock:
            if self._watchdog is not None:
                self._watchdog.rearm()

    def _wait_for_watchdog(self) -> None:
        dog = self._watchdog
        if dog is not None:
            dog.wait()

    def write(self, data: bytes) -> None:
        """Send bytes to the board.

        Raises LinkError where they turn wheels and the watchdog has stopped the robot or doesn't
        run, or the program is about to end; zeros always go out.
        """
        with self._lock:
            dog = self._watchdog
            if not data:
                self._put(data)
            elif data.endswith(self._zeros):
                self._put(data)
                if dog is not None:
                    dog.stand()
            elif is_ending():
                raise _too_late()
            else:
                self._moved = True
                if dog is not None:
                    dog.drive()
                self._put(data)
                if dog is not None:
                    dog.driven()

    def _put(self, data: bytes) -> None:
        with translated(self.device):
            put(self._require(), data)

    def advance(self, period: float) -> bytes:
        """Sleep until the period's absolute deadline, then take what has arrived.

        After a delay of more than a period the deadlines start anew from now.
        """
        self._deadline += period
        while (remaining := self._deadline - self.now()) > 0.0:
            time.sleep(min(remaining, self._nap))
            self._beat()
        self.lateness = self.now() - self._deadline
        if self.lateness > period:
            self._deadline = self.now()
        return self.read_now()

    def _beat(self) -> None:
        with self._lock:
            if self._watchdog is not None:
                self._watchdog.beat()

    def reset_input(self) -> None:
        """Drop what has arrived and wasn't read."""
        with translated(self.device):
            self._require().reset_input_buffer()

    def read_now(self) -> bytes:
        """What has arrived; waits for nothing."""
        self._beat()
        data = b""
        with translated(self.device):
            for _ in range(MOST_CHUNKS):
                chunk = self._require().read(CHUNK)
                data += chunk
                if not chunk:
                    break
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
            self._say_zero(self._port)
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
            if self._port is not None:
                self._say_stop(self._port)
            yield

    def _is_silent(self, port: Any) -> bool:
        """Whether the board hasn't answered for a while, since wheels were commanded to turn."""
        quiet = self.now() - self._heard > SILENT_SHARE * self._config.feedback_timeout
        with contextlib.suppress(*PORT_ERRORS):
            return self._moved and quiet and not port.in_waiting
        return True

    def _say_zero(self, port: Any) -> bool:
        """Whether the port took the zeros."""
        with contextlib.suppress(*PORT_ERRORS):
            if port is not None:
                put(port, self._stop_line())
                return True
        return False

    def _say_stop(self, port: Any) -> bool:
        """Whether the zeros have left the port."""
        if not self._say_zero(port):
            return False
        if self._watchdog is not None:
            self._watchdog.stand()
        with contextlib.suppress(*PORT_ERRORS):
            if _drained(port):
                return True
        self._say_zero(port)
        return False

    def stop(self) -> None:
        """Command zero and stay open; errors are no concern of whoever must stop now."""
        with self.held():
            pass

    def _release(self, port: Any, *, lost: bool) -> None:
        """The last word is zero; then the watchdog first, since it shares the port's lock."""
        with contextlib.ExitStack() as last_to_first:
            last_to_first.callback(self._let_go, port, lost=lost)
            last_to_first.callback(self._unwatch, lost=lost)
            if not lost:
                self._say_stop(port)

    def _unwatch(self, *, lost: bool) -> None:
        dog, self._watchdog = self._watchdog, None
        if dog is not None and lost:
            dog.search(self._place.path or self.device)
        elif dog is not None:
            dog.close()

    def _let_go(self, port: Any, *, lost: bool) -> None:
        self._port = None
        self._place.left(lost=lost)
        unguard(self)
        with contextlib.suppress(*PORT_ERRORS):
            port.close()

    def abandon(self) -> None:
        """Let go without a word, as a forked child must do with its parent's port."""
        self._lock = threading.RLock()  # another thread, which isn't here, may have had it
        port = self._port
        if port is None:
            return
        dog, self._watchdog = self._watchdog, None
        if dog is not None:
            dog.abandon()
        own = getattr(port, "_socket", None)
        if own is not None:  # pyserial would end the connection, which is the parent's
            os.close(own.detach())
            port.is_open = False
        self._let_go(port, lost=False)

    def __del__(self) -> None:
        if getattr(self, "_port", None) is not None:
            self.close()

    def __reduce__(self) -> tuple[type[SerialLink], tuple[str, RobotConfig]]:
        """Copies and pickles are closed links to the same device; a port can't be shared."""
        return SerialLink, (self.device, self._config)

    def _stop_motors(self) -> None:
        self.write(self._stop_line())

    def _stop_line(self) -> bytes:
        """The line end first, so that a command cut short can't swallow the zeros."""
        return b"\r\n" + self._zeros

    def _require(self) -> Any:
        if self._port is None:
            raise LinkLostError(f"{self.device} is closed", "call open() or env.reset() first")
        return self._port


def _too_late() -> LinkError:
    return LinkError("the program is about to end", "nothing drives any more: start it again")


def _drained(port: Any) -> bool:
    """Whether the port has sent everything soon.

    What a board doesn't take is dropped, for it would hold up whoever closes the port.
    """
    deadline = time.monotonic() + DRAIN
    while getattr(port, "out_waiting", 0):
        if time.monotonic() > deadline:
            port.reset_output_buffer()
            return False
        time.sleep(0.001)
    return True
