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

POSIX only: Windows processes can't share an open port in this way (see `AVAILABLE`).
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
from pathlib import Path

from acsar_gym.config import RobotConfig
from acsar_gym.errors import BUSY_HINT, LinkError
from acsar_gym.links.ports import MORE_FILES_ADVICE, OpenPort, PortLocation

WATCHDOG_AVAILABLE = os.name == "posix"
"""Whether watchdogs work on this operating system."""
CHILD_TIMEOUT = 5.0
"""Longest wait for its start and its end [s]; usually 20 ms and 1 ms."""
ASLEEP_TIME = 0.2
"""It counts as halted if it didn't run during this driving time [s]: several times LONGEST."""
LONGEST_TICK = 0.05
"""Most driving time counted between two commands [s]; a stalled machine delays both processes."""
CHILD_PROGRAM = Path(__file__).resolve().with_name("watchdog_child.py")
STANDING_BEAT = 0.0

if WATCHDOG_AVAILABLE:
    from acsar_gym.links.watchdog_child import (
        AWAKE,
        BEAT,
        LEAVE,
        PAGE_SIZE,
        STOOD,
        TRIPPED,
        boot_clock,
    )


class Watchdog:
    """Watches this process, and commands zero through a shared port.

    Args:
        port: descriptor of the open port; close the watchdog before it, as they share its lock.
        zeros: bytes that stop the robot.
        timeout: longest time without a sign of life while the newest command turns wheels [s].
        place: name under which a lost port reappears; empty if there is none.

    Raises:
        LinkError: the process can't be started.
    """

    def __init__(self, port: int, zeros: bytes, timeout: float, place: str = "") -> None:
        self._driving = False
        self._open = False
        self._halted = False
        self._resting = False
        self._awake = self._unseen = self._drove = 0.0
        self._timeout = timeout
        try:
            self._start(port, zeros, timeout, place)
        except OSError as error:
            raise _failed(str(error)) from None

    def _start(self, port: int, zeros: bytes, timeout: float, place: str) -> None:
        with contextlib.ExitStack() as inherited, contextlib.ExitStack() as ours:
            page = _memory()
            inherited.callback(os.close, page)
            watched, self._lifeline = os.pipe()
            inherited.callback(os.close, watched)
            ours.callback(os.close, self._lifeline)
            self._ready, ready = os.pipe()
            inherited.callback(os.close, ready)
            ours.callback(os.close, self._ready)
            self._map = mmap.mmap(page, PAGE_SIZE)
            ours.callback(self._map.close)
            self._page = memoryview(self._map).cast("d")
            ours.callback(self._page.release)
            self._process = _started((port, page, watched, ready), timeout, zeros, place)
            self._ours = ours.pop_all()
            self._open = True

    def wait(self) -> None:
        """Wait until it is ready; LinkError if that fails."""
        pipe = select.poll()
        pipe.register(self._ready, select.POLLIN)
        if not pipe.poll(1000.0 * CHILD_TIMEOUT):
            raise _failed("it doesn't answer")
        try:
            answer = os.read(self._ready, 1)
        except OSError:
            raise _failed("another thread closed it") from None
        if not answer:
            raise _failed("it ended at once")

    @property
    def pid(self) -> int:
        """Its PID."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether its process runs, and was never suspended."""
        return self._open and self._runs()

    def _runs(self) -> bool:
        """Update and return whether the process runs."""
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
    def tripped(self) -> bool:
        """Whether it stopped the robot since the last `rearm`."""
        return self._open and self._page[TRIPPED] != 0.0

    def beat(self) -> None:
        """Give a sign of life while wheels turn; trips if the last one is too old."""
        if not self._driving or self._page[TRIPPED]:
            return
        now = boot_clock()
        if (gap := now - self._page[BEAT]) > self._timeout:
            self._page[TRIPPED] = gap
        else:
            self._page[BEAT] = now

    def drive(self) -> None:
        """Call before a command that turns wheels, and `driven` after it; LinkError if refused."""
        self.driven()
        now = self._page[BEAT]
        if self._page[AWAKE] != self._awake:
            self._awake, self._unseen = self._page[AWAKE], 0.0
        else:
            self._unseen += min(now - self._drove, LONGEST_TICK)
        self._drove = now
        if self._unseen > ASLEEP_TIME or not self.alive:
            self._halted = True  # so that it is replaced at the next reset
            raise self._absent()

    def driven(self) -> None:
        """Call after a command that turns wheels; LinkError if the robot was stopped meanwhile."""
        if not self._driving and not self._page[TRIPPED]:
            self._driving = True
            self._page[BEAT] = boot_clock()
        self.beat()
        if self._page[TRIPPED]:
            raise self._stopped()

    def stand(self) -> None:
        """Call after a zero command."""
        self._driving = False
        if self._resting:
            self._page[STOOD] = boot_clock()
        if not self._page[TRIPPED]:
            self._page[BEAT] = STANDING_BEAT

    def rearm(self) -> None:
        """Allow driving again; from now on the last zero command is repeated.

        Not earlier, as the bootloader of a starting board may interpret any byte.
        """
        self._driving = False
        self._resting = True
        self._page[STOOD] = boot_clock()
        self._page[BEAT] = STANDING_BEAT  # before TRIPPED, or it would trip on the old value
        self._page[TRIPPED] = 0.0

    def _absent(self) -> LinkError:
        """Return the error for a watchdog that doesn't run."""
        why = "is suspended"
        if self._process.returncode is not None:
            why = "has ended"
        elif self._unseen > ASLEEP_TIME:
            why = f"hasn't run for {self._unseen:.2f} s"
        return LinkError(
            f"the watchdog process {why} (PID {self.pid})",
            "find what did that, then reset to start another one",
        )

    def _stopped(self) -> LinkError:
        """Return the error for a robot that the watchdog stopped."""
        # `stand` keeps BEAT after a trip: it is the time of the last sign of life.
        silent = max(self._page[TRIPPED], boot_clock() - self._page[BEAT])
        return LinkError(
            f"the watchdog stopped the robot: nothing was commanded for {silent * 1000.0:.0f} ms",
            f"find what held the program up, then reset; on a busy computer {BUSY_HINT}",
        )

    def search(self, name: str) -> None:
        """Keep commanding zero after closing; ends by an answer, `call_back`, or after a minute."""
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
        self._page[LEAVE] = 1.0
        self._let_go()
        deadline = time.monotonic() + CHILD_TIMEOUT
        while self._runs() and time.monotonic() < deadline:
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
        self._open = False
        self._ours.close()


_searching: dict[str, int] = {}
"""PIDs of watchdogs that search for ports which the program has closed, by name."""
if hasattr(os, "register_at_fork"):  # PIDs of the parent's children
    os.register_at_fork(after_in_child=_searching.clear)


def end_searches(name: str | None = None) -> None:
    """End the watchdogs that search for the port with this name, or all of them."""
    for each, process in list(_searching.items()):
        if name in (None, each):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):  # it is a child of this process's parent
            if os.waitpid(process, 0 if name in (None, each) else os.WNOHANG) == (0, 0):
                continue
        del _searching[each]


def _memory() -> int:
    """Return a descriptor of one shared page of memory, filled with zeros."""
    if sys.platform == "linux":
        page = os.memfd_create("acsar-watchdog")
    else:
        with tempfile.TemporaryFile() as file:
            page = os.dup(file.fileno())
    os.ftruncate(page, PAGE_SIZE)
    return page


def _started(
    shared: tuple[int, int, int, int], timeout: float, zeros: bytes, place: str
) -> subprocess.Popen[bytes]:
    """Start the process, in a new session and with only the descriptors that it needs."""
    options = map(str, (*shared, os.getpid(), timeout))
    # The watchdog must not keep TTYs and pipes of this program open.
    nowhere = subprocess.DEVNULL
    try:
        return subprocess.Popen(
            [sys.executable, "-I", "-S", str(CHILD_PROGRAM), *options, zeros.hex(), place],
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
    """Return the error for a watchdog that can't be started."""
    if any(os.strerror(code) in reason for code in (errno.EMFILE, errno.ENFILE)):
        return LinkError(f"the watchdog can't be started ({reason})", MORE_FILES_ADVICE)
    return LinkError(
        f"the watchdog can't be started ({reason})",
        f"check that {sys.executable or 'a Python'} can run {CHILD_PROGRAM}; "
        "watchdog_timeout=None drives without one",
    )


# Manages the watchdog of one link, if it has one.


class WatchdogHandle:
    """Starts, signals and ends the watchdog, if it is configured and the port can be shared.

    Callers prevent concurrent calls from several threads, except for `wait`.

    Attributes:
        watchdog: the watchdog; None if there is none.
        nap: longest sleep of the link between two `beat` calls [s].
    """

    def __init__(self, config: RobotConfig, location: PortLocation, zeros: bytes) -> None:
        self._timeout = config.watchdog_timeout
        self._location = location
        self._zeros = zeros
        self.watchdog: Watchdog | None = None
        self.nap = math.inf

    def start(self, port: OpenPort) -> None:
        """Start the watchdog; LinkError if that fails."""
        descriptor = port.fileno()
        if self._timeout is None or not WATCHDOG_AVAILABLE or descriptor is None:
            return
        name = self._location.path if self._location.path and self._location.lasts else ""
        self.watchdog = Watchdog(descriptor, self._zeros, self._timeout, name)
        self.nap = self._timeout / 3.0

    def renew(self, port: OpenPort) -> bool:
        """Restart a watchdog that doesn't run any more; returns whether that was necessary."""
        running = self.watchdog
        if running is None or running.alive:
            return False
        self.watchdog = None
        running.close()
        self.start(port)
        return True

    def wait(self) -> None:
        """Wait until the watchdog is ready; LinkError if that fails."""
        if (running := self.watchdog) is not None:
            running.wait()

    @property
    def alive(self) -> bool:
        """Whether there is a watchdog and it runs."""
        return (running := self.watchdog) is not None and running.alive

    @property
    def pid(self) -> int | None:
        """PID of the watchdog; None if there is none."""
        return None if (running := self.watchdog) is None else running.pid

    def rearm(self) -> None:
        """Allow driving again after the watchdog stopped the robot."""
        if (running := self.watchdog) is not None:
            running.rearm()

    def beat(self) -> None:
        """Signal that the program runs."""
        if (running := self.watchdog) is not None:
            running.beat()

    def stand(self) -> None:
        """Note that a zero command was sent."""
        if (running := self.watchdog) is not None:
            running.stand()

    def drive(self) -> None:
        """Call before a command that turns wheels; LinkError if the watchdog doesn't run."""
        if (running := self.watchdog) is not None:
            running.drive()

    def driven(self) -> None:
        """Call after a command that turns wheels; LinkError if the robot was stopped meanwhile."""
        if (running := self.watchdog) is not None:
            running.driven()

    def end(self, *, lost: bool) -> None:
        """End the watchdog; if the port is lost, it continues to search for it."""
        running, self.watchdog = self.watchdog, None
        if running is not None and lost:
            running.search(self._name)
        elif running is not None:
            running.close()

    def end_search(self) -> None:
        """End a former search for the port; call once the port is there."""
        end_searches(self._name)

    def abandon(self) -> None:
        """Release the watchdog without ending it, for a forked child."""
        running, self.watchdog = self.watchdog, None
        if running is not None:
            running.abandon()

    @property
    def _name(self) -> str:
        return self._location.path or self._location.name
