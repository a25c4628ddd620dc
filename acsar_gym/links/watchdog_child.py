"""The watchdog's own process: it commands zero where the program that drives can't any more.

`watchdog.Watchdog` runs this file as a script, so it imports nothing of this package and starts in
20 ms. It shares the open port with the program, and a page of memory in which the program notes
when it last gave a sign of life. It sleeps until that is too old and looks again: seven times a
second, whatever the rate of the signs. A pipe whose other end only the program holds tells of the
program's death at once.
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
from typing import Protocol

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
SEARCH = 60.0
"""How long to look for a port that is lost [s]."""
SEARCH_EVERY = 0.02
"""[s]"""
LATE = 0.01
"""Whoever wakes up later than this was held up himself [s]: perhaps the whole machine stood."""
SURE = 0.02
"""So long the program may take to go on after the machine stood [s]."""
DEAF_TO = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP", "SIGTTIN", "SIGTTOU")


class Board(Protocol):
    """Where zero commands go."""

    def stop(self) -> bool:
        """Command zero; whether the port took it."""

    def find(self) -> bool:
        """Open a port that was lost, where it is back; whether there is one."""

    @property
    def taken(self) -> bool:
        """Whether the port is back, and another program has it."""


class Watch:
    """Watches one program, `parent`, until it closes the port or dies."""

    def __init__(
        self, page: memoryview[float], lifeline: int, parent: int, timeout: float, board: Board
    ) -> None:
        self._page = page
        self._lifeline = lifeline
        self._parent = parent
        self._timeout = timeout
        self._board = board
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
        """The program is dead, or has lost the port, which is looked for then."""
        deadline = time.monotonic() + SEARCH
        words = 0
        while words < LAST_WORDS and not self._page[LEAVE]:
            if self._board.stop():
                words += 1
                time.sleep(REPEAT * (words < LAST_WORDS))
            elif self._board.taken or time.monotonic() > deadline:
                return
            elif not self._board.find():
                time.sleep(SEARCH_EVERY)

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
        self._board.stop()
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
        self._board.stop()
        return now + REPEAT


class Port:
    """The open port that the program shares, and where it comes back under its `place`."""

    taken = False

    def __init__(self, descriptor: int, zeros: bytes, place: str) -> None:
        self._descriptor = descriptor
        self._zeros = zeros
        self._place = place
        self._settings = None
        with contextlib.suppress(termios.error):  # a socket has none
            self._settings = termios.tcgetattr(descriptor)

    def stop(self) -> bool:
        """Put the zero command on the wire, ahead of whatever is stuck there."""
        with contextlib.suppress(OSError, termios.error):
            try:
                os.write(self._descriptor, self._zeros)
            except BlockingIOError:
                termios.tcflush(self._descriptor, termios.TCOFLUSH)
                os.write(self._descriptor, self._zeros)
            return True
        return False

    def find(self) -> bool:
        """Open the port anew, with the settings it had; it is held exclusively."""
        if not self._place or self._settings is None:
            self.taken = True  # nowhere to look
            return False
        try:
            found = os.open(self._place, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError:
            return False
        try:
            fcntl.flock(found, fcntl.LOCK_EX | fcntl.LOCK_NB)
            termios.tcsetattr(found, termios.TCSANOW, self._settings)
        except (OSError, termios.error) as error:
            self.taken = isinstance(error, BlockingIOError)
            os.close(found)
            return False
        os.dup2(found, self._descriptor, inheritable=False)
        os.close(found)
        return True


def be_urgent() -> None:
    """Ahead of other processes, where this user may."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))


def main() -> None:
    """One byte goes into the mouth as soon as it watches.

    Arguments: port, page, lifeline, mouth (descriptors), parent (pid), time-out [s], zeros (hex),
    place.
    """
    for name in DEAF_TO:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    port, page, lifeline, mouth, parent = map(int, sys.argv[1:6])
    be_urgent()
    memory = memoryview(mmap.mmap(page, PAGE)).cast("d")
    board = Port(port, bytes.fromhex(sys.argv[7]), sys.argv[8])
    watch = Watch(memory, lifeline, parent, float(sys.argv[6]), board)
    with contextlib.suppress(OSError):
        os.write(mouth, b".")
    os.close(mouth)
    watch.run()
    os._exit(0)


if __name__ == "__main__":
    main()
