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

While the newest command is zero, whoever thinks between reset and the first step isn't interrupted.
A zero command that has been the program's last word for 0.1 s is repeated, since a wire may have
swallowed it. Zeros begin with a line end, so that a command cut short can't swallow them.

Driving needs a watchdog that runs: one that is suspended, or hasn't run for long, is as good as
none.

POSIX only: Windows processes can't share an open port in this way. `AVAILABLE` tells.
"""

from __future__ import annotations

import contextlib
import errno
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
from acsar_gym.links.ports import MORE_FILES

AVAILABLE = os.name == "posix"
"""Whether this operating system can have one."""
PATIENCE = 5.0
"""Longest wait for its start and for its end [s]; 20 ms and 1 ms are usual."""
ASLEEP = 0.5
"""While the program drove for so long and a time-out [s], it should have run."""
TICK = 0.05
"""So much of that counts between two commands, at most: a machine that stood held up both [s]."""
PROGRAM = Path(__file__).resolve().with_name("watchdog_child.py")
STANDING = 0.0

if AVAILABLE:
    from acsar_gym.links.watchdog_child import AWAKE, BEAT, LEAVE, PAGE, STOOD, TRIPPED


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
        self._halted = False
        self._resting = False
        self._awake = self._unseen = self._drove = 0.0
        self._asleep = ASLEEP + timeout
        try:
            self._start(port, zeros, timeout, place)
        except OSError as error:
            raise _failed(str(error)) from None

    def _start(self, port: int, zeros: bytes, timeout: float, place: str) -> None:
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
        try:
            answer = os.read(self._ready, 1)
        except OSError:
            raise _failed("another thread closed it") from None
        if not answer:
            raise _failed("it ended at once")

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether its process runs, and wasn't suspended since it was started."""
        return self._open and self._runs()

    def _runs(self) -> bool:
        if self._process.returncode is None and not self._halted:
            try:
                process, status = os.waitpid(self._process.pid, os.WNOHANG | os.WUNTRACED)
            except ChildProcessError:  # somebody else has waited for it
                self._process.returncode = 0
                return False
            if process and os.WIFSTOPPED(status):
                self._halted = True  # for good: the kernel says it once
            elif process:
                self._process.returncode = os.waitstatus_to_exitcode(status)
        return self._process.returncode is None and not self._halted

    @property
    def tripped(self) -> bool:
        """Whether it stopped the robot since the last `rearm`."""
        return self._open and self._page[TRIPPED] != 0.0

    def beat(self) -> None:
        """The program is alive; 0.2 us, and never waits. Changes nothing once it has tripped."""
        if self._driving and not self._page[TRIPPED]:
            self._page[BEAT] = time.monotonic()

    def drive(self) -> None:
        """A command that turns wheels goes out now; say `driven` afterwards.

        Raises LinkError where the robot was stopped, or where nobody watches any more.
        """
        self.driven()
        now = self._page[BEAT]
        if self._page[AWAKE] != self._awake:
            self._awake, self._unseen = self._page[AWAKE], 0.0
        else:
            self._unseen += min(now - self._drove, TICK)
        self._drove = now
        if self._unseen > self._asleep or not self.alive:
            raise self._absent()

    def driven(self) -> None:
        """A command that turns wheels went out. LinkError where the robot was stopped meanwhile."""
        if self._page[TRIPPED]:
            raise self._stopped()
        self._driving = True
        self._page[BEAT] = time.monotonic()

    def stand(self) -> None:
        """A zero command went out: nothing has to be stopped."""
        self._driving = False
        if self._resting:
            self._page[STOOD] = time.monotonic()
        if not self._page[TRIPPED]:
            self._page[BEAT] = STANDING

    def rearm(self) -> None:
        """Forget that it tripped; a zero command went out, which it repeats from now on.

        Not before: the bootloader of a board that starts may take any byte for its own affair.
        """
        self._driving = False
        self._resting = True
        self._page[STOOD] = time.monotonic()
        self._page[BEAT] = STANDING  # first, lest it trips again on the old one
        self._page[TRIPPED] = 0.0

    def _absent(self) -> LinkError:
        why = "has ended"
        if self._halted:
            why = "is suspended"
        elif self._process.returncode is None:
            why = f"hasn't run for {self._unseen:.2f} s"
        return LinkError(
            f"the watchdog process {why} (PID {self.pid})",
            "find what did that, then reset to start another one",
        )

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
            if self._halted:
                self._process.send_signal(signal.SIGCONT)
            self._process.returncode = 0  # it may outlive this program
            call_back(name)
            _searching[name] = self._process.pid

    def close(self) -> None:
        """End its process, without a word on the wire, and wait for that; idempotent."""
        if not self._open:
            return
        self._page[LEAVE] = 1.0
        self._let_go()
        deadline = time.monotonic() + PATIENCE
        while self._runs() and time.monotonic() < deadline:
            time.sleep(0.001)
        if self._process.returncode is None:  # it would keep the port busy
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
if hasattr(os, "register_at_fork"):  # they are the parent's; a number may soon be another's
    os.register_at_fork(after_in_child=_searching.clear)


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
    if any(os.strerror(code) in reason for code in (errno.EMFILE, errno.ENFILE)):
        return LinkError(f"the watchdog can't be started ({reason})", MORE_FILES)
    return LinkError(
        f"the watchdog can't be started ({reason})",
        f"check that {sys.executable or 'a Python'} can run {PROGRAM}; "
        "watchdog_timeout=None drives without one",
    )
