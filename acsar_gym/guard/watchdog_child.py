"""The watchdog process: commands zero when the driving program no longer can.

`watchdog.Watchdog` runs this file as a script. It imports nothing of this package, to start in 20
ms. It shares the open port with the program, and a page of memory in which the program stores the
time of its last sign of life. The watchdog checks that four times per time-out, and stores a sign
of life as well. A lifeline, whose other end only the program holds, reports its death at once.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import select
import signal
import sys
import termios
import time
from collections.abc import Callable
from functools import partial

SLOTS = 5
BEAT, TRIPPED, LEAVE, STOOD, AWAKE = range(SLOTS)
"""Slots of the page: 8-byte doubles, which are stored atomically. Times: `boot_clock` [s].

BEAT: Time of the program's last sign of life, or 0 while the newest command is zero.
TRIPPED: Age of that sign when the robot was stopped [s], or 0 if it wasn't stopped.
LEAVE: 1 if the watchdog must end, as the program closes the port.
STOOD: Time of the program's last zero command, or 0 before its first reset.
AWAKE: Time at which the watchdog last ran.
"""
PAGE_SIZE = 8 * SLOTS

CHECKS_PER_TIMEOUT = 4
LONGEST_SLEEP = 0.05  # between two checks [s]. After a few the program takes it for suspended
ZERO_INTERVAL = 0.1  # interval of repeating the zero command of a program that sends nothing [s]

WRITE_ATTEMPTS = 4  # while the program writes to the port
WRITE_PAUSE = 0.0005  # between them [s]
REPEAT_INTERVAL = 0.05  # interval of repeated zero commands [s], as some may be lost
HANG_ZEROS = 21  # number of zero commands while the program hangs
DEATH_ZEROS = 7  # number of zero commands after the program died, before the port is released
IGNORED_SIGNALS = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP", "SIGTTIN", "SIGTTOU")


def boot_clock() -> float:
    """Return the time [s]. Unlike `time.monotonic`, it goes on while the computer is suspended."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def stop_robot(descriptor: int, zeros: bytes) -> None:
    """Send the zero command to a port. If the port is stuck, unsent bytes are discarded."""
    with contextlib.suppress(OSError, termios.error):
        for _ in range(WRITE_ATTEMPTS):
            with contextlib.suppress(BlockingIOError):
                os.write(descriptor, zeros)
                return
            time.sleep(WRITE_PAUSE)
        termios.tcflush(descriptor, termios.TCOFLUSH)
        os.write(descriptor, zeros)


class ProgramWatch:
    """Watches a program until it closes the port or dies.

    Args:
        page: Memory that the program shares.
        timeout: Longest time between two signs of life while wheels turn [s].
        stop_robot: Commands zero.
    """

    def __init__(
        self, page: memoryview[float], timeout: float, stop_robot: Callable[[], None]
    ) -> None:
        self._page = page
        self._timeout = timeout
        self._stop_robot = stop_robot
        self._last_trip = 0.0
        self._repeats = 0
        self._last_repeat = 0.0
        page[AWAKE] = boot_clock()

    def run(self, lifeline: int, parent: int) -> None:
        """Watch until the program closes the port, or is dead and zeros have been sent.

        Args:
            lifeline: Descriptor of a socket that the program's death closes.
            parent: PID of the program, whose children may hold its other end as well.
        """
        death = select.poll()
        death.register(lifeline, select.POLLIN)
        pace = min(self._timeout / CHECKS_PER_TIMEOUT, LONGEST_SLEEP)
        due = boot_clock() + pace
        while not self._page[LEAVE]:
            wait = math.ceil(1000.0 * max(0.0, due - boot_clock()))
            if death.poll(wait) or os.getppid() != parent:
                self._stop_for_good()
                return
            now = boot_clock()
            self._page[AWAKE] = now
            due = min(self.check(now), now + pace)

    def _stop_for_good(self) -> None:
        for _ in range(DEATH_ZEROS):
            if self._page[LEAVE]:
                return
            self._stop_robot()
            time.sleep(REPEAT_INTERVAL)

    def check(self, now: float) -> float:
        """Command zero if that is due, and return the time of the next check."""
        tripped = self._page[TRIPPED]
        if not tripped:
            beat = self._page[BEAT]
            if not beat:
                return self._repeat_last_zero(now)
            if now < beat + self._timeout:
                return beat + self._timeout
            tripped = self._page[TRIPPED] = now - beat  # before the zeros: no command follows them

        if tripped != self._last_trip:  # the program can trip as well
            self._last_trip = tripped
            self._repeats = HANG_ZEROS
        if not self._repeats:
            return now + self._timeout
        self._repeats -= 1
        self._stop_robot()
        return now + REPEAT_INTERVAL

    def _repeat_last_zero(self, now: float) -> float:
        """Repeat the last zero command if the program sends nothing, as it may have been lost."""
        stood = self._page[STOOD]
        due = max(stood, self._last_repeat) + ZERO_INTERVAL
        if now < due:
            return due
        if stood:
            self._last_repeat = now
            self._stop_robot()
        return now + ZERO_INTERVAL


def join_program(make_stop: Callable[[list[str]], Callable[[], None]]) -> None:
    """Run a watchdog, which writes a byte to the lifeline when it watches.

    The first arguments: page, lifeline (descriptors), parent (PID), time-out [s]. The others are
    for `make_stop`, which returns what commands zero.
    """
    for name in IGNORED_SIGNALS:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    page, lifeline, parent = map(int, sys.argv[1:4])
    timeout = float(sys.argv[4])
    with contextlib.suppress(OSError, AttributeError):  # ahead of the program, if that is allowed
        priority = os.sched_getparam(0).sched_priority + 1
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))

    memory = memoryview(mmap.mmap(page, PAGE_SIZE)).cast("d")
    watch = ProgramWatch(memory, timeout, make_stop(sys.argv[5:]))
    with contextlib.suppress(OSError):
        os.write(lifeline, b".")
    watch.run(lifeline, parent)
    os._exit(0)


if __name__ == "__main__":
    join_program(lambda port: partial(stop_robot, int(port[0]), bytes.fromhex(port[1])))
