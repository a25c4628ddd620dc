"""The watchdog process: commands zero when the driving program can't any more.

`watchdog.Watchdog` runs this file as a script. It imports nothing of this package, to start in 20
ms. It shares the open port with the program, and a page of memory in which the program stores the
time of its last sign of life. The watchdog checks that four times per time-out, and stores a sign
of life of its own. A pipe whose other end only the program holds reports the program's death at
once.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import mmap
import os
import select
import signal
import sys
import termios
import time
from collections.abc import Callable

SLOTS = 5
BEAT, TRIPPED, LEAVE, STOOD, AWAKE = range(SLOTS)
"""Slots of the page; 8-byte doubles, which are stored atomically. Times: `clock` [s].

BEAT: time of the program's last sign of life; 0 while the newest command is zero.
TRIPPED: age of that when the robot was stopped [s]; 0 if it wasn't.
LEAVE: 1 if the watchdog must end, as the program closes the port.
STOOD: time of the program's last zero command; 0 before its first reset.
AWAKE: time at which the watchdog last ran.
"""
PAGE_SIZE = 8 * SLOTS

CHECKS_PER_TIMEOUT = 4  # checks per time-out
LONGEST_SLEEP = 0.05  # between two checks [s]; the program takes it for suspended after a few
ZERO_INTERVAL = 0.1  # interval of repeating the zero command of a program that sends nothing [s]

WRITE_ATTEMPTS, WRITE_PAUSE = 4, 0.0005  # while the program writes to the port; pause in [s]
REPEAT_INTERVAL = 0.05  # interval of repeated zero commands [s], as some may be lost
HANG_ZEROS = 21  # number of zero commands while the program hangs
DEATH_ZEROS = 7  # fewest zero commands after the program died; then the port is released
SEARCH_TIMEOUT = 60.0  # longest search for a lost port, or wait for the answer of a board [s]
SEARCH_INTERVAL = 0.02  # interval of the search [s]
ANSWER_CHUNK = 4096
IGNORED_SIGNALS = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP", "SIGTTIN", "SIGTTOU")


def boot_clock() -> float:
    """Return the time [s]; unlike `time.monotonic`, it goes on while the computer is suspended."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Stopper:
    """What commands zero for the program.

    Attributes: `taken`, whether it can't any more, as another program drives.
    """

    taken = False

    def stop_robot(self, wanted: Callable[[], bool] = lambda: True) -> bool:
        """Command zero if `wanted()`; returns whether that was sent."""
        raise NotImplementedError

    def has_answer(self) -> bool:
        """Return whether the robot has shown since the last call that it hears."""
        return True

    def share(self) -> None:
        """Let other programs drive until the next `stop_robot`."""

    def find_again(self) -> bool:
        """Find a lost robot again; returns whether it is there."""
        return False


class SharedPort(Stopper):
    """The port that the program shares, and the name under which it reappears."""

    def __init__(self, descriptor: int, zeros: bytes, place: str) -> None:
        self._descriptor = descriptor
        self._zeros = zeros
        self._place = place
        self._settings = None
        with contextlib.suppress(termios.error):  # a socket has none
            self._settings = termios.tcgetattr(descriptor)

    def stop_robot(self, wanted: Callable[[], bool] = lambda: True) -> bool:
        """Send the zero command if `wanted()`; returns whether the port accepted it.

        Unsent bytes are discarded if the port is stuck.
        """
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.taken = True
        except OSError:  # not every descriptor can be locked
            pass
        if self.taken or not wanted():
            return False
        with contextlib.suppress(OSError, termios.error):
            for _ in range(WRITE_ATTEMPTS):
                with contextlib.suppress(BlockingIOError):
                    os.write(self._descriptor, self._zeros)
                    return True
                time.sleep(WRITE_PAUSE)
            termios.tcflush(self._descriptor, termios.TCOFLUSH)
            os.write(self._descriptor, self._zeros)
            return True
        return False

    def has_answer(self) -> bool:
        """Return whether anything has arrived since the last call."""
        with contextlib.suppress(OSError):
            return bool(os.read(self._descriptor, ANSWER_CHUNK))
        return False

    def share(self) -> None:
        """Unlock the port for other programs; the next `stop_robot` tries to lock it again."""
        with contextlib.suppress(OSError):
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)

    def find_again(self) -> bool:
        """Open a lost port again, exclusively and with its former settings."""
        if not self._place or self._settings is None:
            self.taken = True  # its name isn't known
            return False
        try:
            descriptor = os.open(
                self._place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC
            )
        except OSError:
            return False
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            termios.tcsetattr(descriptor, termios.TCSANOW, self._settings)
            os.dup2(descriptor, self._descriptor, inheritable=False)
        except (OSError, termios.error) as error:
            self.taken = isinstance(error, BlockingIOError)
            return False
        finally:
            os.close(descriptor)
        return True


class ProgramWatch:
    """Watches one program until it closes the port or dies."""

    def __init__(
        self, page: memoryview[float], lifeline: int, parent: int, timeout: float, port: Stopper
    ) -> None:
        self._page = page
        self._lifeline = lifeline
        self._parent = parent
        self._timeout = timeout
        self._port = port
        self._answered = 0.0
        self._repeats = 0
        self._until = 0.0
        self._said = 0.0
        page[AWAKE] = boot_clock()

    def run(self) -> None:
        """Watch until the program closes the port, or is dead and zeros have been sent."""
        pipe = select.poll()
        pipe.register(self._lifeline, select.POLLIN)
        pace = min(self._timeout / CHECKS_PER_TIMEOUT, LONGEST_SLEEP)
        due = boot_clock() + pace
        while not self._page[LEAVE]:
            wait = math.ceil(1000.0 * max(0.0, due - boot_clock()))
            if pipe.poll(wait) or os.getppid() != self._parent:
                self._stop_for_good()
                return
            now = boot_clock()
            self._page[AWAKE] = now
            due = min(self.check(now), now + pace)

    def _stop_for_good(self) -> None:
        """Command zero for a program that is dead, or lost its port, or whose board is silent."""
        port = self._port
        deadline = time.monotonic() + SEARCH_TIMEOUT
        sent = 0
        while not self._page[LEAVE] and not port.taken and time.monotonic() < deadline:
            if port.stop_robot():
                sent += 1
                if sent >= DEATH_ZEROS:
                    if port.has_answer():
                        return
                    port.share()
                time.sleep(REPEAT_INTERVAL)
            elif not port.find_again():
                time.sleep(SEARCH_INTERVAL)

    def check(self, now: float) -> float:
        """Command zero if that is due; returns the time of the next check."""
        tripped = self._page[TRIPPED]
        if not tripped:
            beat = self._page[BEAT]
            if not beat:
                return self._repeat_last_zero(now)
            if now < beat + self._timeout:
                return beat + self._timeout
            tripped = self._page[TRIPPED] = now - beat  # before the zeros: no command follows them
        if tripped != self._answered:  # the program may have found it, too
            self._answered, self._repeats, self._until = tripped, HANG_ZEROS, now + SEARCH_TIMEOUT
        if not self._repeats or self._port.taken or now > self._until:
            return now + self._timeout
        if self._port.stop_robot() or (self._port.find_again() and self._port.stop_robot()):
            self._repeats -= 1
            return now + REPEAT_INTERVAL
        return now + SEARCH_INTERVAL

    def _repeat_last_zero(self, now: float) -> float:
        """Repeat the last zero command if the program sends nothing, as it may have been lost."""
        stood = self._page[STOOD]
        due = max(stood, self._said) + ZERO_INTERVAL
        if stood and now >= due:
            self._said = now
            self._port.stop_robot(lambda: not self._page[BEAT])
        return due if now < due else now + ZERO_INTERVAL


def join_program(make_stopper: Callable[[list[str]], Stopper]) -> None:
    """Run a watchdog; it writes one byte to `ready` when it watches.

    The first arguments: page, lifeline, ready (descriptors), parent (PID), time-out [s]; the rest
    is for `make_stopper`.
    """
    for name in IGNORED_SIGNALS:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    page, lifeline, ready, parent = map(int, sys.argv[1:5])
    with contextlib.suppress(OSError, AttributeError):  # ahead of the program, if that is allowed
        priority = os.sched_getparam(0).sched_priority + 1
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    memory = memoryview(mmap.mmap(page, PAGE_SIZE)).cast("d")
    stopper = make_stopper(sys.argv[6:])
    watch = ProgramWatch(memory, lifeline, parent, float(sys.argv[5]), stopper)
    with contextlib.suppress(OSError):
        os.write(ready, b".")
    os.close(ready)
    watch.run()
    os._exit(0)


if __name__ == "__main__":
    join_program(lambda rest: SharedPort(int(rest[0]), bytes.fromhex(rest[1]), rest[2]))
