"""A watchdog process that commands zero if the driving program hangs, is suspended or killed.

Code inside a process can't stop a robot while the process doesn't run. So `SerialLink.open` starts
`watchdog_child.py`, which shares the open port, ignores the terminal's signals, and

- commands zero as soon as the program is dead, and then releases the port;
- keeps commanding zero when a port was lost, as with a loose cable, or its board fell silent, until
  it is back and answers, even without the program. A lost port is searched only under a name that
  no other device can get, as in /dev/serial/by-id, and left to any program that locks it;
- commands zero if the newest command turns wheels and the program gave no sign of life for the
  time-out, and again every 50 ms for a second. The link then refuses to drive until it is reset.

After a suspension of both, of a container or of the computer, either may run first. So the program
compares times likewise, and each trips if it finds such a gap.

While the newest command is zero, the program may pause, as between reset and first step. A zero
command that is the newest one for 0.1 s is repeated, as it may have been lost. Zeros begin with a
line end, which ends a truncated command.

Driving needs a running watchdog: not one that is suspended, or hasn't run for long.

POSIX only: Windows processes can't share an open port in this way (see `WATCHDOG_AVAILABLE`).
"""

from __future__ import annotations

import contextlib
import errno
import math
import mmap
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from acsar_gym.errors import BUSY_HINT, MORE_FILES_ADVICE, LinkError

WATCHDOG_AVAILABLE = os.name == "posix"  # whether watchdogs work on this operating system
CHILD_TIMEOUT = 5.0  # longest wait for its start and its end [s]; usually 20 ms and 1 ms
ASLEEP_TIME = 0.2  # it is halted if it ran in none of this driving time, or its own time-out [s]
LONGEST_TICK = 0.05
"""Most driving time counted between two commands [s]; a stalled machine delays both processes."""
BEATS_PER_TIMEOUT = 3  # signs of life that a link gives in each time-out while it waits
CHILD_PROGRAM = Path(__file__).resolve().with_name("watchdog_child.py")
STANDING_BEAT = 0.0

if WATCHDOG_AVAILABLE:
    from acsar_gym.guard.watchdog_child import (
        AWAKE,
        BEAT,
        LEAVE,
        PAGE_SIZE,
        STOOD,
        TRIPPED,
        boot_clock,
    )


class Watchdog:
    """Watches this process through a shared port, from each `start` until it is closed.

    While it isn't started, it refuses nothing. Callers prevent concurrent calls, except for
    `wait_ready`.

    Attributes: `page`, the memory that both processes share, see `watchdog_child`; `lifeline`, the
    descriptor by whose closing the watchdog notices that this process is dead.
    """

    page: memoryview[float]
    lifeline: int
    _process: subprocess.Popen[bytes]

    def __init__(self, zeros: bytes, timeout: float | None) -> None:
        self._zeros = zeros
        self._timeout = timeout or math.inf
        self._asleep_time = max(ASLEEP_TIME, timeout or 0.0)
        self._can_start = timeout is not None
        self._ours = contextlib.ExitStack()
        self._open = self._driving = self._halted = self._resting = False
        self._awake = self._unseen = self._drove = 0.0

    def start(self, port: int | None, place: str = "") -> None:
        """Start the process, unless time-out or port are missing; LinkError where it can't."""
        if port is not None:
            command = (sys.executable, "-I", "-S", str(CHILD_PROGRAM))
            self.launch(command, (str(port), self._zeros.hex(), place), (port,))

    def launch(
        self,
        command: Sequence[str],
        arguments: Sequence[str],
        inherited: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Start a process that watches; see `watchdog_child.join_program`.

        Args:
            command: the program.
            arguments: its own.
            inherited: descriptors that it shares.
            environment: of the process; None for that of this one.
        """
        if not self._can_start or not WATCHDOG_AVAILABLE:
            return
        self._driving = self._halted = self._resting = False
        self._awake = self._unseen = self._drove = 0.0
        try:
            with contextlib.ExitStack() as shared_ends, contextlib.ExitStack() as ours:
                page = _create_shared_page()
                shared_ends.callback(os.close, page)
                watched, self.lifeline = os.pipe()
                shared_ends.callback(os.close, watched)
                ours.callback(os.close, self.lifeline)
                self._ready, ready = os.pipe()
                shared_ends.callback(os.close, ready)
                ours.callback(os.close, self._ready)
                shared = mmap.mmap(page, PAGE_SIZE)
                ours.callback(shared.close)
                self.page = memoryview(shared).cast("d")
                ours.callback(self.page.release)
                # In a new session, and without TTYs and pipes of this program: it would hold them.
                common = map(str, (page, watched, ready, os.getpid(), self._timeout))
                self._process = subprocess.Popen(
                    [*command, *common, *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    cwd="/",
                    pass_fds=(page, watched, ready, *inherited),
                    start_new_session=True,
                    env=environment,
                )
                self._ours = ours.pop_all()
                self._open = True
        except (OSError, subprocess.SubprocessError) as error:
            raise _start_error(str(error)) from error

    def wait_ready(self, timeout: float = CHILD_TIMEOUT) -> None:
        """Wait until it watches, for so long at most [s]; LinkError if that fails."""
        if not self._open:
            return
        pipe = select.poll()
        pipe.register(self._ready, select.POLLIN)
        if not pipe.poll(1000.0 * timeout):
            raise _start_error("it doesn't answer")
        try:
            answer = os.read(self._ready, 1)
        except OSError as error:
            raise _start_error("another thread closed it") from error
        if not answer:
            raise _start_error("it ended at once")

    @property
    def pid(self) -> int | None:
        """Its PID; None if there is none."""
        return self._process.pid if self._open else None

    @property
    def beat_interval(self) -> float:
        """Longest pause between two calls of `beat` [s]."""
        return self._timeout / BEATS_PER_TIMEOUT if self._open else math.inf

    @property
    def is_started(self) -> bool:
        """Whether it was started and not closed since; it may have died."""
        return self._open

    @property
    def is_alive(self) -> bool:
        """Whether its process runs, and was never suspended."""
        return self._open and self._is_running()

    def _is_running(self) -> bool:
        if self._process.returncode is None and not self._halted:
            try:
                process, status = os.waitpid(self._process.pid, os.WNOHANG | os.WUNTRACED)
            except ChildProcessError:  # another part of the program has reaped it
                self._process.returncode = 0
                return False
            if process and os.WIFSTOPPED(status):
                self._halted = True  # permanently, as the kernel reports it only once, if at all
            elif process:
                self._process.returncode = os.waitstatus_to_exitcode(status)
        return self._process.returncode is None and not self._halted

    @property
    def has_tripped(self) -> bool:
        """Whether it stopped the robot since the last `rearm`."""
        return self._open and self.page[TRIPPED] != 0.0

    def beat(self) -> None:
        """Give a sign of life while wheels turn; trips if the last one is too old."""
        if not self._open or not self._driving or self.page[TRIPPED]:
            return
        now = boot_clock()
        if (gap := now - self.page[BEAT]) > self._timeout:
            self.page[TRIPPED] = gap
        else:
            self.page[BEAT] = now

    def allow_drive(self) -> None:
        """Call before a command that turns wheels; LinkError where it tripped, or is dead."""
        if not self._open:
            return
        self.note_drive()
        now = self.page[BEAT]
        if self.page[AWAKE] != self._awake:
            self._awake, self._unseen = self.page[AWAKE], 0.0
        else:
            self._unseen += min(now - self._drove, LONGEST_TICK)
        self._drove = now
        if self._unseen <= self._asleep_time and self._is_running():
            return
        self._halted = True  # so that it is replaced at the next reset
        why = "is suspended"
        if self._process.returncode is not None:
            why = "has ended"
        elif self._unseen > self._asleep_time:
            why = f"hasn't run for {self._unseen:.2f} s"
        raise LinkError(
            f"the watchdog process {why} (PID {self.pid})",
            "find what did that, then reset to start another one",
        )

    def note_drive(self) -> None:
        """Call after a command that turns wheels; LinkError if the robot was stopped meanwhile."""
        if not self._open:
            return
        if not self._driving and not self.page[TRIPPED]:
            self._driving = True
            self.page[BEAT] = boot_clock()
        self.beat()
        if self.page[TRIPPED]:
            # `note_stop` keeps BEAT after a trip: it is the time of the last sign of life.
            silent = max(self.page[TRIPPED], boot_clock() - self.page[BEAT])
            raise LinkError(
                "the watchdog stopped the robot: nothing was commanded for "
                f"{silent * 1000.0:.0f} ms",
                f"find what held the program up, then reset; on a busy computer {BUSY_HINT}",
            )

    def note_stop(self) -> None:
        """Call after a zero command."""
        self._driving = False
        if not self._open:
            return
        if self._resting:
            self.page[STOOD] = boot_clock()
        if not self.page[TRIPPED]:
            self.page[BEAT] = STANDING_BEAT

    def rearm(self) -> None:
        """Allow driving again; from now on the last zero command is repeated.

        Not earlier, as the bootloader of a starting board may interpret any byte.
        """
        if not self._open:
            return
        self._driving = False
        self._resting = True
        self.page[STOOD] = boot_clock()
        self.page[BEAT] = STANDING_BEAT  # before TRIPPED, or it would trip on the old value
        self.page[TRIPPED] = 0.0

    def search(self, name: str) -> None:
        """Close it, but let it keep commanding zero at a lost port.

        Ends by an answer of the board, `end_searches`, or after a minute.
        """
        if self._open:
            self._let_go()
            if self._halted:
                self._process.send_signal(signal.SIGCONT)
            self._process.returncode = 0  # don't wait for it: it may outlive this program
            end_searches(name)
            _searching[name] = self._process.pid

    def close(self) -> None:
        """End the process, and wait for that; it sends nothing. Idempotent."""
        if not self._open:
            return
        self.page[LEAVE] = 1.0
        self._let_go()
        deadline = time.monotonic() + CHILD_TIMEOUT
        while self._is_running() and time.monotonic() < deadline:
            time.sleep(0.001)
        if self._process.returncode is None:  # it would keep the port busy
            self._process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(CHILD_TIMEOUT)

    def abandon(self) -> None:
        """Release the parent's watchdog in a forked child."""
        if self._open:
            self._let_go()
            self._process.returncode = 0  # only the parent can wait for it

    def _let_go(self) -> None:
        self._open = self._driving = False
        self._ours.close()


_searching: dict[str, int] = {}  # PIDs of watchdogs that search for a lost port, by name
if hasattr(os, "register_at_fork"):  # PIDs of the parent's children
    os.register_at_fork(after_in_child=_searching.clear)


def list_searches() -> dict[str, int]:
    """Return the PIDs of the watchdogs that search for a lost port, by the port's name."""
    return dict(_searching)


def end_searches(name: str | None = None) -> None:
    """End the watchdogs that search for the port with this name, or all of them."""
    for port, process in list(_searching.items()):
        if name in (None, port):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):  # it is a child of this process's parent
            if os.waitpid(process, 0 if name in (None, port) else os.WNOHANG) == (0, 0):
                continue
        del _searching[port]


def _create_shared_page() -> int:
    if sys.platform == "linux":
        page = os.memfd_create("acsar-watchdog")
    else:
        with tempfile.TemporaryFile() as file:
            page = os.dup(file.fileno())
    os.ftruncate(page, PAGE_SIZE)
    return page


def _start_error(reason: str) -> LinkError:
    if any(os.strerror(code) in reason for code in (errno.EMFILE, errno.ENFILE)):
        return LinkError(f"the watchdog can't be started ({reason})", MORE_FILES_ADVICE)
    return LinkError(
        f"the watchdog can't be started ({reason})",
        f"check that {sys.executable or 'a Python'} can run {CHILD_PROGRAM}; "
        "watchdog_timeout=None drives without one",
    )
