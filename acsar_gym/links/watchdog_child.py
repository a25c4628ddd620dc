"""The watchdog's own process: it commands zero where the program that drives can't any more.

`watchdog.Watchdog` runs this file as a script, so it imports nothing of this package and starts in
20 ms. It shares the open port with the program, and a page of memory in which the program notes
when it last gave a sign of life. It sleeps until that is too old and looks again: seven times a
second, whatever the rate of the signs. A pipe whose other end only the program holds tells of the
program's death at once.
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

SLOTS = 3
BEAT, TRIPPED, LEAVE = range(SLOTS)
"""What the page holds, doubles of 8 bytes each, which are stored at once.

BEAT: when the program last gave a sign of life [s, monotonic clock]; 0 while the newest command is
zero. TRIPPED: how old that was when the robot was stopped [s]; 0 where it wasn't. LEAVE: 1 where
the watchdog shall end, for the program closes the port in order.
"""
PAGE = 8 * SLOTS

REPEAT = 0.05
"""Zero commands come again after so long, since a wire may swallow one [s]."""
REPEATS = 20
"""So often while the program hangs."""
LAST_WORDS = 7
"""Zero commands for a program that is dead; then the port is free."""
LATE = 0.01
"""Whoever wakes up later than this was held up himself [s]: perhaps the whole machine stood."""
SURE = 0.02
"""So long the program may take to go on after the machine stood [s]."""
DEAF_TO = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP", "SIGTTIN", "SIGTTOU")


class Watch:
    """Watches one program, `parent`, until it closes the port or dies."""

    def __init__(
        self,
        page: memoryview[float],
        lifeline: int,
        parent: int,
        timeout: float,
        send: Callable[[], None],
    ) -> None:
        self._page = page
        self._lifeline = lifeline
        self._parent = parent
        self._timeout = timeout
        self._send = send
        self._due = time.monotonic() + timeout
        self._seen = 0.0
        self._since = 0.0
        self._excused = False
        self._repeats = 0

    def run(self) -> None:
        """Until the program closes the port; until it is dead and the zeros are on the wire."""
        pipe = select.poll()
        pipe.register(self._lifeline, select.POLLIN)
        while not self._page[LEAVE]:
            wait = math.ceil(1000.0 * max(0.0, self._due - time.monotonic()))
            if pipe.poll(wait) or os.getppid() != self._parent:
                self._bury()
                return
            self._due = self._look(time.monotonic())

    def _bury(self) -> None:
        for words in range(LAST_WORDS):
            if self._page[LEAVE]:
                return
            if words:
                time.sleep(REPEAT)
            self._send()

    def _look(self, now: float) -> float:
        """Command zero where that is due; when to look again."""
        if self._page[TRIPPED]:
            return self._repeat(now)
        beat = self._page[BEAT]
        if not beat:
            return now + self._timeout
        due = max(beat + self._timeout, self._watched_since(beat, now) + SURE)
        if now < due:
            return due
        self._page[TRIPPED] = now - beat  # first, so that no command can follow the zeros unnoticed
        self._send()
        self._repeats = REPEATS
        return now + REPEAT

    def _watched_since(self, beat: float, now: float) -> float:
        """Since when this sign has been the newest, on a machine that ran all the while."""
        if beat != self._seen:
            self._seen, self._since, self._excused = beat, now, False
        elif now - self._due > LATE and not self._excused:
            self._since, self._excused = now, True
        return self._since

    def _repeat(self, now: float) -> float:
        if not self._repeats:
            return now + self._timeout
        self._repeats -= 1
        self._send()
        return now + REPEAT


def sender(port: int, zeros: bytes) -> Callable[[], None]:
    """Puts the zero command on the wire, ahead of whatever is stuck there; a lost port is none."""

    def send() -> None:
        with contextlib.suppress(OSError, termios.error):
            try:
                os.write(port, zeros)
            except BlockingIOError:
                termios.tcflush(port, termios.TCOFLUSH)
                os.write(port, zeros)

    return send


def be_urgent() -> None:
    """Ahead of other processes, where this user may."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))


def main() -> None:
    """Arguments: port, page, lifeline, mouth (descriptors), parent (pid), time-out [s], zeros.

    One byte goes into the mouth as soon as it watches.
    """
    for name in DEAF_TO:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    port, page, lifeline, mouth, parent = map(int, sys.argv[1:6])
    be_urgent()
    memory = memoryview(mmap.mmap(page, PAGE)).cast("d")
    send = sender(port, bytes.fromhex(sys.argv[7]))
    watch = Watch(memory, lifeline, parent, float(sys.argv[6]), send)
    with contextlib.suppress(OSError):
        os.write(mouth, b".")
    os.close(mouth)
    watch.run()
    os._exit(0)


if __name__ == "__main__":
    main()
