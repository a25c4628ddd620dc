"""A process of our own that commands zero where the program hangs, is suspended, starved or killed.

Nothing inside a process can stop a robot whose process doesn't run. So `SerialLink.open` starts
`watchdog_child.py`, which shares the open port, is deaf to the terminal's signals, and

- commands zero as soon as the program is dead, whatever killed it, and then lets the port go;
- goes on commanding zero where a port was lost, as where a cable comes loose, or its board fell
  silent, until it is there again and answers, whether the program still runs or not. It looks for a
  lost port only under a name that no other device can get, as in /dev/serial/by-id, and leaves it
  to any other program that locks it;
- commands zero where the newest command turns wheels and the program gave no sign of life for the
  time-out, and again every 50 ms for a second. The link then refuses to drive until it is reset.

While the newest command is zero it does nothing: whoever thinks between reset and the first step
isn't interrupted. Its zeros begin with a line end, so that a command cut short can't swallow them.

POSIX only: Windows processes can't share an open port in this way. `AVAILABLE` tells.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from acsar_gym.errors import LinkError

AVAILABLE = os.name == "posix"
"""Whether this operating system can have one."""
PATIENCE = 5.0
"""Longest wait for its start and for its end [s]; 20 ms and 1 ms are usual."""
PROGRAM = Path(__file__).resolve().with_name("watchdog_child.py")
STANDING = 0.0

if AVAILABLE:
    from acsar_gym.links.watchdog_child import BEAT, LEAVE, PAGE, TRIPPED


class Watchdog:
    """Watches this process from the moment it is made, and commands zero through `port`.

    `port` is the open port's descriptor, `zeros` the bytes that stop the robot, `timeout` how long
    no sign of life may come [s] while the newest command turns wheels, and `place` the name under
    which a lost port comes back, "" for none. Raises LinkError where no process can be started.

    `close` it before the port: the two processes share the port's lock.
    """

    def __init__(self, port: int, zeros: bytes, timeout: float, place: str = "") -> None:
        self._driving = False
        self._open = False
        with contextlib.ExitStack() as inherited, contextlib.ExitStack() as ours:
            page = _memory()
            inherited.callback(os.close, page)
            ear, self._lifeline = os.pipe()
            inherited.callback(os.close, ear)
            ours.callback(os.close, self._lifeline)
            self._ready, mouth = os.pipe()
            inherited.callback(os.close, mouth)
            ours.callback(os.close, self._ready)
            self._map = mmap.mmap(page, PAGE)
            ours.callback(self._map.close)
            self._page = memoryview(self._map).cast("d")
            ours.callback(self._page.release)
            self._process = _started((port, page, ear, mouth), timeout, zeros, place)
            self._ours = ours.pop_all()
            self._open = True

    def wait(self) -> None:
        """Return when it watches; LinkError where it doesn't come to that."""
        pipe = select.poll()
        pipe.register(self._ready, select.POLLIN)
        if not pipe.poll(1000.0 * PATIENCE):
            raise _failed("it doesn't answer")
        if not os.read(self._ready, 1):
            raise _failed("it ended at once")

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether its process runs."""
        return self._open and self._process.poll() is None

    @property
    def tripped(self) -> bool:
        """Whether it stopped the robot since the last `rearm`."""
        return self._open and self._page[TRIPPED] != 0.0

    def beat(self) -> None:
        """The program is alive; 0.2 us, and never waits. Changes nothing once it has tripped."""
        if self._driving and not self._page[TRIPPED]:
            self._page[BEAT] = time.monotonic()

    def drive(self) -> None:
        """A command that turns wheels goes out: call it before and after.

        Raises LinkError where the robot was stopped, or where nobody watches any more.
        """
        if self._page[TRIPPED]:
            raise self._stopped()
        if not self.alive:
            raise LinkError("the watchdog process has ended", "reset to start another one")
        self._driving = True
        self._page[BEAT] = time.monotonic()

    def stand(self) -> None:
        """A zero command went out: nothing has to be stopped."""
        self._driving = False
        if not self._page[TRIPPED]:
            self._page[BEAT] = STANDING

    def rearm(self) -> None:
        """Forget that it tripped; a zero command went out."""
        self._driving = False
        self._page[BEAT] = STANDING  # first, lest it trips again on the old one
        self._page[TRIPPED] = 0.0

    def _stopped(self) -> LinkError:
        # A stop between the trip and this error has left the last beat as it was.
        silent = max(self._page[TRIPPED], time.monotonic() - self._page[BEAT])
        return LinkError(
            f"the watchdog stopped the robot: nothing was commanded for {silent * 1000.0:.0f} ms",
            "find what held the program up, then reset",
        )

    def search(self, name: str) -> None:
        """Go on commanding zero on this port, which may be lost or its board silent.

        It ends after a minute, when the board answers, or with `call_back` of that name.
        """
        if self._open:
            self._let_go()
            self._process.returncode = 0  # it may outlive this program
            call_back(name)
            _searching[name] = self._process.pid

    def close(self) -> None:
        """End its process, without a word on the wire, and wait for that; twice is once."""
        if not self._open:
            return
        self._page[LEAVE] = 1.0
        self._let_go()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(PATIENCE)

    def abandon(self) -> None:
        """Let go without a word, as a forked child must do with its parent's watchdog."""
        if self._open:
            self._let_go()
            self._process.returncode = 0  # it isn't this process's to wait for

    def _let_go(self) -> None:
        self._open = False
        self._ours.close()


_searching: dict[str, int] = {}
"""Processes that look after a port which the program has given up, by its name."""


def call_back(name: str | None = None) -> None:
    """End whatever looks after the port with this name, or any: the program takes over."""
    for each, process in list(_searching.items()):
        if name in (None, each):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):  # a fork's parent has it
            if os.waitpid(process, 0 if name in (None, each) else os.WNOHANG) == (0, 0):
                continue
        del _searching[each]


def _memory() -> int:
    """A descriptor of one page of memory, all zero, that two processes can share."""
    if sys.platform == "linux":
        page = os.memfd_create("acsar-watchdog")
    else:
        with tempfile.TemporaryFile() as file:
            page = os.dup(file.fileno())
    os.ftruncate(page, PAGE)
    return page


def _started(
    shared: tuple[int, int, int, int], timeout: float, zeros: bytes, place: str
) -> subprocess.Popen[bytes]:
    """The watchdog's process: a session of its own, and no file but those that it needs."""
    options = map(str, (*shared, os.getpid(), timeout))
    # TTYs and pipes of this program must not stay open with its watchdog.
    nowhere = subprocess.DEVNULL
    try:
        return subprocess.Popen(
            [sys.executable, "-I", "-S", str(PROGRAM), *options, zeros.hex(), place],
            stdin=nowhere,
            stdout=nowhere,
            stderr=nowhere,
            cwd="/",
            pass_fds=shared,
            start_new_session=True,
        )
    except (OSError, subprocess.SubprocessError) as error:
        raise _failed(str(error)) from None


def _failed(reason: str) -> LinkError:
    return LinkError(
        f"the watchdog can't be started ({reason})",
        f"check that {sys.executable or 'a Python'} can run {PROGRAM}; "
        "watchdog_timeout=None drives without one",
    )
