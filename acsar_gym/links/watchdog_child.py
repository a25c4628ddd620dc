"""The watchdog's own process: it commands zero where the program that drives can't any more.

`watchdog.Watchdog` runs this file as a script, so it imports nothing of this package and starts in
20 ms. It shares the open port with the program, and a page of memory in which the program notes
when it last gave a sign of life. It looks at that four times in each time-out, whatever the rate of
the signs, and leaves a sign of its own there. A pipe whose other end only the program holds tells
of the program's death at once.
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
from typing import Protocol

SLOTS = 5
BEAT, TRIPPED, LEAVE, STOOD, AWAKE = range(SLOTS)
"""What the page holds, doubles of 8 bytes each, which are stored at once.

BEAT: when the program last gave a sign of life [s, monotonic clock]; 0 while the newest command is
zero. TRIPPED: how old that was when the robot was stopped [s]; 0 where it wasn't. LEAVE: 1 where
the watchdog shall end, for the program closes the port in order. STOOD: when the program last
commanded zero [s]; 0 before its first reset. AWAKE: when the watchdog last ran [s].
"""
PAGE = 8 * SLOTS

LOOKS = 4
"""It looks so often in each time-out, and then says that it is awake."""
LONGEST = 0.25
"""But it sleeps no longer than this [s]."""
STANDS = 0.1
"""A program that stands and says nothing has its zero command repeated every so often [s]."""

TURNS, TURN = 4, 0.0005
"""A port refuses a write while the program writes to it, too: tries, and the pause between [s]."""
REPEAT = 0.05
"""Zero commands come again after so long, since a wire may swallow one [s]."""
REPEATS = 21
"""So often while the program hangs."""
LAST_WORDS = 7
"""Zero commands for a program that is dead, at least; then the port is free."""
SEARCH = 60.0
"""How long to look for a port that is lost, or to wait for a board's answer [s]."""
SEARCH_EVERY = 0.02
"""[s]"""
CHUNK = 4096
LATE = 0.01
"""Whoever wakes up later than this was held up himself [s]: perhaps the whole machine stood."""
SURE = 0.02
"""So long the program may take to go on after the machine stood [s]."""
DEAF_TO = ("SIGHUP", "SIGINT", "SIGQUIT", "SIGTERM", "SIGTSTP", "SIGTTIN", "SIGTTOU")


class Board(Protocol):
    """Where zero commands go."""

    def stop(self, wanted: Callable[[], bool] = ...) -> bool:
        """Command zero, where it is still wanted; whether the port took it."""

    def find(self) -> bool:
        """Open a port that was lost, where it is back; whether there is one."""

    def answers(self) -> bool:
        """Whether the board has said anything since it was last asked."""

    def share(self) -> None:
        """Let another program have the port, until the next zero command."""

    @property
    def taken(self) -> bool:
        """Whether another program has the port, or nobody knows where to look for it."""


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
        self._pace = min(timeout / LOOKS, LONGEST)
        self._due = time.monotonic() + self._pace
        self._seen = 0.0
        self._since = 0.0
        self._excused = False
        self._repeats = 0
        self._until = 0.0
        self._said = 0.0
        page[AWAKE] = time.monotonic()

    def run(self) -> None:
        """Until the program closes the port; until it is dead and the zeros are on the wire."""
        pipe = select.poll()
        pipe.register(self._lifeline, select.POLLIN)
        while not self._page[LEAVE]:
            wait = math.ceil(1000.0 * max(0.0, self._due - time.monotonic()))
            if pipe.poll(wait) or os.getppid() != self._parent:
                self._bury()
                return
            now = time.monotonic()
            self._page[AWAKE] = now
            self._due = min(self._look(now), now + self._pace)

    def _bury(self) -> None:
        """The program is dead, has lost the port, or has given up a board that is silent."""
        deadline = time.monotonic() + SEARCH
        words = 0
        while not self._page[LEAVE] and not self._board.taken and time.monotonic() < deadline:
            if self._board.stop():
                words += 1
                if words >= LAST_WORDS:
                    if self._board.answers():
                        return
                    self._board.share()
                time.sleep(REPEAT)
            elif not self._board.find():
                time.sleep(SEARCH_EVERY)

    def _look(self, now: float) -> float:
        """Command zero where that is due; when to look again."""
        if self._page[TRIPPED]:
            return self._repeat(now)
        beat = self._page[BEAT]
        if not beat:
            return self._stand(now)
        due = max(beat + self._timeout, self._watched_since(beat, now) + SURE)
        if now < due:
            return due
        self._page[TRIPPED] = now - beat  # first, so that no command can follow the zeros unnoticed
        self._repeats, self._until = REPEATS, now + SEARCH
        return self._repeat(now)

    def _watched_since(self, beat: float, now: float) -> float:
        """Since when this sign has been the newest, on a machine that ran all the while."""
        if beat != self._seen:
            self._seen, self._since, self._excused = beat, now, False
        elif now - self._due > LATE and not self._excused:
            self._since, self._excused = now, now + SURE > beat + self._timeout
        return self._since

    def _stand(self, now: float) -> float:
        """Repeat the zero command where the program says nothing: a wire may have swallowed it."""
        stood = self._page[STOOD]
        due = max(stood, self._said) + STANDS
        if stood and now >= due:
            self._said = now
            self._board.stop(lambda: not self._page[BEAT])
        return due if now < due else now + STANDS

    def _repeat(self, now: float) -> float:
        """The zeros of a program that hangs; through a lost port when it is found again."""
        if not self._repeats or self._board.taken or now > self._until:
            return now + self._timeout
        if self._board.stop() or (self._board.find() and self._board.stop()):
            self._repeats -= 1
            return now + REPEAT
        return now + SEARCH_EVERY


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

    def stop(self, wanted: Callable[[], bool] = lambda: True) -> bool:
        """Put the zero command on the wire, ahead of whatever is stuck there."""
        if not self._locked() or not wanted():
            return False
        with contextlib.suppress(OSError, termios.error):
            for _ in range(TURNS):
                with contextlib.suppress(BlockingIOError):
                    os.write(self._descriptor, self._zeros)
                    return True
                time.sleep(TURN)
            termios.tcflush(self._descriptor, termios.TCOFLUSH)
            os.write(self._descriptor, self._zeros)
            return True
        return False

    def _locked(self) -> bool:
        """Whether the lock is ours: the program's own, or one that is taken now."""
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.taken = True
        except OSError:  # not every descriptor has one
            pass
        return not self.taken

    def answers(self) -> bool:
        """Whether anything has arrived."""
        with contextlib.suppress(OSError):
            return bool(os.read(self._descriptor, CHUNK))
        return False

    def share(self) -> None:
        """Unlock the port; the next `stop` tries to lock it again."""
        with contextlib.suppress(OSError):
            fcntl.flock(self._descriptor, fcntl.LOCK_UN)

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
            os.dup2(found, self._descriptor, inheritable=False)
        except (OSError, termios.error) as error:
            self.taken = isinstance(error, BlockingIOError)
            return False
        finally:
            os.close(found)
        return True


def be_urgent() -> None:
    """Ahead of other processes, and of the program that started this one, where this user may."""
    with contextlib.suppress(OSError, AttributeError):
        priority = os.sched_getparam(0).sched_priority + 1
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


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
