"""A watchdog process that commands zero if the driving program hangs, is suspended or killed.

Code inside a process can't stop a robot while the process doesn't run. So a link starts
`watchdog_child.py`, which shares the open port, ignores the terminal's signals, and

- commands zero as soon as the program is dead, seven times, and then releases the port,
- commands zero if the newest command turns wheels and the program gave no sign of life for the
  time-out, and again every 50 ms for a second. The link then refuses to drive until it is reset.

After a suspension of both, of a container or of the computer, either may run first. So the program
compares times as well, and each trips if it finds such a gap.

While the newest command is zero, the program may pause, as between reset and first step. A zero
command that is the newest command for 0.1 s is repeated, as it may have been lost. Zeros start with
a line end, which ends a truncated command.

Driving needs a running watchdog: not a suspended watchdog, which hasn't run for long.

POSIX only: Windows processes can't share an open port in this way (see `WATCHDOG_AVAILABLE`).
"""

from __future__ import annotations

import contextlib
import math
import mmap
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO

from acsar_gym.errors import BUSY_HINT, MORE_FILES_ADVICE, TOO_MANY_FILES, LinkError

WATCHDOG_AVAILABLE = os.name == "posix"  # whether watchdogs work on this operating system
CHILD_TIMEOUT = 5.0  # longest wait for its start and its end [s], usually 20 ms and 1 ms
ASLEEP_TIME = 0.2  # it is suspended if it ran in none of this driving time, or its time-out [s]
LONGEST_TICK = 0.05
"""Most driving time counted between two commands [s], as a stall delays both processes."""
BEATS_PER_TIMEOUT = 3  # signs of life that a link gives in each time-out while it waits
CHILD_PROGRAM = Path(__file__).resolve().with_name("watchdog_child.py")

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
    """Watches this process, from each `start` until it is closed.

    While it isn't started, it refuses nothing. Callers prevent concurrent calls, except for
    `wait_ready`.

    Args:
        zeros: Zero command.
        timeout: Longest time between two signs of life while wheels turn [s]. None: there is
            no watchdog.

    Attributes:
        page: Memory that both processes share, see `watchdog_child`.
        is_started: Whether it was started and not closed since. It may have died.
    """

    page: memoryview[float]
    _process: subprocess.Popen[bytes]
    _channel: socket.socket

    def __init__(self, zeros: bytes, timeout: float | None) -> None:
        self._zeros = zeros
        self._timeout = timeout or math.inf
        self._asleep_time = max(ASLEEP_TIME, timeout or 0.0)
        self._can_start = timeout is not None and WATCHDOG_AVAILABLE
        self._resources = contextlib.ExitStack()
        self.is_started = False
        self._is_driving = False
        self._last_awake = 0.0
        self._last_drive = 0.0
        self._unseen_time = 0.0

    def start(self, port: int | None) -> None:
        """Start the process, unless time-out or port are missing. LinkError if that fails."""
        if port is not None:
            command = (sys.executable, "-I", "-S", str(CHILD_PROGRAM))
            self.launch(command, (str(port), self._zeros.hex()), inherited=(port,))

    def launch(
        self,
        command: Sequence[str],
        arguments: Sequence[str],
        inherited: Sequence[int] = (),
        environment: Mapping[str, str] | None = None,
    ) -> None:
        """Start a process that watches (see `watchdog_child.join_program`).

        Args:
            command: Program.
            arguments: Arguments that it gets after those of every watchdog.
            inherited: Descriptors that it shares.
            environment: Environment of the process, by default that of this process.

        Raises:
            LinkError: It can't be started.
        """
        if not self._can_start:
            return
        self._unseen_time = 0.0
        try:
            with contextlib.ExitStack() as kept:
                self._channel, shared_end = socket.socketpair()
                kept.enter_context(self._channel)
                with shared_end, _open_shared_page() as page:
                    page.truncate(PAGE_SIZE)
                    memory = kept.enter_context(mmap.mmap(page.fileno(), PAGE_SIZE))
                    self.page = kept.enter_context(memoryview(memory).cast("d"))
                    shared = (page.fileno(), shared_end.fileno())
                    common = map(str, (*shared, os.getpid(), self._timeout))

                    # A new session, and none of this program's TTYs and pipes: it would hold them.
                    self._process = subprocess.Popen(
                        [*command, *common, *arguments],
                        stdin=subprocess.DEVNULL,
                        stdout=subprocess.DEVNULL,
                        stderr=subprocess.DEVNULL,
                        cwd="/",
                        pass_fds=(*shared, *inherited),
                        start_new_session=True,
                        env=environment,
                    )
                self._resources = kept.pop_all()
                self.is_started = True
        except (OSError, subprocess.SubprocessError) as error:
            raise _start_error(str(error), getattr(error, "errno", None)) from error

    def wait_ready(self, timeout: float = CHILD_TIMEOUT) -> None:
        """Wait until it watches, at most for the time-out [s]. LinkError if that fails."""
        if not self.is_started:
            return
        self._channel.settimeout(timeout)
        try:
            answer = self._channel.recv(1)
        except OSError as error:
            raise _start_error(f"no answer: {error}") from error
        if not answer:
            raise _start_error("it ended at once")

    @property
    def pid(self) -> int | None:
        """Its PID, or None if it isn't started."""
        return self._process.pid if self.is_started else None

    @property
    def beat_interval(self) -> float:
        """Longest pause between two calls of `beat` [s]."""
        return self._timeout / BEATS_PER_TIMEOUT if self.is_started else math.inf

    @property
    def is_alive(self) -> bool:
        """Whether its process runs, as far as it is known."""
        if not self.is_started or self._unseen_time > self._asleep_time:
            return False
        return self._process.poll() is None

    @property
    def has_tripped(self) -> bool:
        """Whether it stopped the robot since the last `rearm`."""
        return self.is_started and self.page[TRIPPED] != 0.0

    def beat(self) -> None:
        """Give a sign of life while wheels turn. Trips if the last sign is too old."""
        if not self.is_started or not self._is_driving or self.page[TRIPPED]:
            return
        now = boot_clock()
        gap = now - self.page[BEAT]
        if gap > self._timeout:
            self.page[TRIPPED] = gap
        else:
            self.page[BEAT] = now

    def allow_drive(self) -> None:
        """Call before a command that turns wheels. LinkError if it tripped, or doesn't run."""
        if not self.is_started:
            return
        self.note_drive()

        now = self.page[BEAT]
        if self.page[AWAKE] != self._last_awake:
            self._last_awake = self.page[AWAKE]
            self._unseen_time = 0.0
        else:
            self._unseen_time += min(now - self._last_drive, LONGEST_TICK)
        self._last_drive = now

        if not self.is_alive:
            why = "has ended"
            if self._process.returncode is None:
                why = f"hasn't run for {self._unseen_time:.2f} s"
            raise LinkError(
                f"the watchdog process {why} (PID {self.pid})",
                "find the cause, then reset to start another watchdog",
            )

    def note_drive(self) -> None:
        """Call after a command that turns wheels. LinkError if the robot was stopped meanwhile."""
        if not self.is_started:
            return
        if not self._is_driving and not self.page[TRIPPED]:
            self._is_driving = True
            self.page[BEAT] = boot_clock()
        self.beat()
        if self.page[TRIPPED]:
            # `note_stop` keeps BEAT after a trip: it is the time of the last sign of life.
            silence = max(self.page[TRIPPED], boot_clock() - self.page[BEAT])
            raise LinkError(
                "the watchdog stopped the robot: nothing was commanded for "
                f"{silence * 1000.0:.0f} ms",
                f"find what held the program up, then reset; on a busy computer {BUSY_HINT}",
            )

    def note_stop(self) -> None:
        """Call after a zero command."""
        self._is_driving = False
        if not self.is_started:
            return
        if self.page[STOOD]:
            self.page[STOOD] = boot_clock()
        if not self.page[TRIPPED]:
            self.page[BEAT] = 0.0

    def rearm(self) -> None:
        """Allow driving again. From now on the last zero command is repeated.

        Not earlier, as the bootloader of a starting board may interpret any byte.
        """
        if not self.is_started:
            return
        self._is_driving = False
        self.page[STOOD] = boot_clock()
        self.page[BEAT] = 0.0  # before TRIPPED, or it would trip on the old value
        self.page[TRIPPED] = 0.0

    def close(self) -> None:
        """End the process, which sends nothing, and wait for that. Idempotent."""
        if not self.is_started:
            return
        self.page[LEAVE] = 1.0
        if not self.is_alive:  # a suspended process would keep the port busy
            self._process.kill()
        self._release()
        try:
            self._process.wait(CHILD_TIMEOUT)
        except subprocess.TimeoutExpired:
            self._process.kill()
            # A driver may hold even a killed process: closing the link must not wait for it.
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(CHILD_TIMEOUT)

    def abandon(self) -> None:
        """Release the parent's watchdog in a forked child."""
        if self.is_started:
            self._release()
            self._process.returncode = 0  # only the parent can wait for it

    def _release(self) -> None:
        self.is_started = False
        self._is_driving = False
        self._resources.close()


def _open_shared_page() -> IO[bytes]:
    if sys.platform == "linux":
        return open(os.memfd_create("acsar-watchdog"), "r+b")
    return tempfile.TemporaryFile()


def _start_error(reason: str, code: int | None = None) -> LinkError:
    advice = (
        f"check that {sys.executable} can run {CHILD_PROGRAM}; watchdog_timeout=None drives "
        "without one"
    )
    if code in TOO_MANY_FILES:
        advice = MORE_FILES_ADVICE
    return LinkError(f"the watchdog can't be started ({reason})", advice)
