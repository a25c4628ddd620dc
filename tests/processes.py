"""Python programs in other processes, forked from one that has imported everything.

A fork takes 20 ms instead of 1 s, and runs its code as a script of its own would, down to the
interpreter's end."""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import functools
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import psutil

from acsar_gym.protocol import ZERO, encode
from acsar_gym.testing import TIMEOUT

PRELOADED = ["acsar_gym.links.serial", "acsar_gym.recording", "preloaded"]
"""Modules that programs need not import any more."""
SERVER = """
import importlib, json, os, signal, socket, sys

asked = socket.socket(fileno=int(sys.argv[1]))
for module in sys.argv[2:]:
    importlib.import_module(module)
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
code = ""
while not code:
    request, (out, err, report), _, _ = socket.recv_fds(asked, 1 << 20, 3)
    if os.fork() == 0:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        program = os.fork()
        if program:
            os.write(report, f"{program}\\n".encode())
            _, status = os.waitpid(program, 0)
            os.write(report, f"{os.waitstatus_to_exitcode(status)}\\n".encode())
            os._exit(0)
        asked.close()
        os.close(report)
        os.dup2(out, 1)
        os.dup2(err, 2)
        # Those of before know whether they were files.
        sys.stdout = open(1, "w", closefd=False)
        sys.stderr = open(2, "w", buffering=1, closefd=False, errors="backslashreplace")
        code, sys.argv[1:], environment, folder = json.loads(request)
        os.environ.clear()
        os.environ.update(environment)
        os.chdir(folder)
    for descriptor in (out, err):
        os.close(descriptor)
    if not code:
        os.close(report)
exec(compile(code, "<program>", "exec"), {"__name__": "__main__"})
"""


@functools.cache
def _start_server() -> socket.socket:
    """Start the process that forks programs, which ends with this one."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, "-c", SERVER, str(theirs.fileno()), *PRELOADED]
    folder = str(Path(__file__).parent)
    paths = os.pathsep.join([folder, *filter(None, [os.environ.get("PYTHONPATH")])])
    with theirs:
        server = subprocess.Popen(
            command,
            pass_fds=(theirs.fileno(),),
            stdin=subprocess.DEVNULL,
            env=os.environ | {"PYTHONPATH": paths},
        )
    atexit.register(server.kill)
    return ours


class Program:
    """A program, with the part of `subprocess.Popen` that tests need."""

    def __init__(self, code: str, *arguments: str) -> None:
        self.returncode: int | None = None
        self._errors: IO[str] = tempfile.TemporaryFile("w+")  # noqa: SIM115 - closed in `close`
        ear, mouth = os.pipe()
        fcntl.fcntl(mouth, fcntl.F_SETPIPE_SZ, 1 << 20)  # so that no program waits to be read
        report, reporter = os.pipe()
        # Unbuffered, so that `select` tells whether there is more.
        self.stdout = open(ear, "rb", buffering=0)  # noqa: SIM115
        self._report = open(report, "rb", buffering=0)  # noqa: SIM115
        request = json.dumps([code, arguments, dict(os.environ), str(Path.cwd())]).encode()
        descriptors = [mouth, self._errors.fileno(), reporter]
        socket.send_fds(_start_server(), [request], descriptors)
        os.close(mouth)
        os.close(reporter)
        self.pid = int(self._report.readline())

    def poll(self) -> int | None:
        """Its exit status, minus the signal that killed it. None while it runs."""
        return self.returncode if self.returncode is not None else self._status(0.0)

    def wait(self, timeout: float = TIMEOUT) -> int:
        """The same when it has ended."""
        status = self.poll() if self.returncode is not None else self._status(timeout)
        if status is None:
            raise subprocess.TimeoutExpired("a program", timeout)
        return status

    def _status(self, timeout: float) -> int | None:
        if select.select([self._report], [], [], timeout)[0]:
            self.returncode = int(self._report.readline())
        return self.returncode

    def communicate(self, timeout: float = TIMEOUT) -> tuple[str, str]:
        """Its output and its errors, when it has ended."""
        self.wait(timeout)
        os.set_blocking(self.stdout.fileno(), False)  # a child of its own may hold the other end
        output = b""
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(self.stdout.fileno(), 4096):
                output += piece
        return output.decode(), self.errors

    @property
    def errors(self) -> str:
        """What it has written to standard error so far."""
        size = os.fstat(self._errors.fileno()).st_size  # its position is shared with the program
        return os.pread(self._errors.fileno(), size, 0).decode()

    def send_signal(self, number: int) -> None:
        """Unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Send SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """Send SIGKILL."""
        self.send_signal(signal.SIGKILL)

    def close(self) -> None:
        """Kill it and let go."""
        self.kill()
        self.wait()
        self.stdout.close()
        self._errors.close()
        self._report.close()


@contextlib.contextmanager
def program(code: str, *arguments: str) -> Iterator[Program]:
    """A Python program in another process, killed at the end of the block if it still runs."""
    running = Program(code, *arguments)
    try:
        yield running
    finally:
        running.close()


def first_line(process: Program | subprocess.Popen[bytes]) -> str:
    """The first line of a program that then prints no more, or waits."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], TIMEOUT)
    return process.stdout.readline().decode().strip() if ready else ""


def ended(process: Program) -> tuple[int, str]:
    """Exit status and standard error."""
    _, error = process.communicate(TIMEOUT)
    return process.wait(), error


TURNING = encode((3.0, 3.0, 3.0, 3.0))
ZEROS = b"\r\n" + encode(ZERO)
HASTY = 0.5
"""Time-out of a watchdog that shall trip, and not before a busy machine has gone on [s]."""


def children() -> list[psutil.Process]:
    """Watchdogs of this process, living and dead. A dead process has no command line."""

    def watches(process: psutil.Process) -> bool:
        with contextlib.suppress(psutil.Error):
            return any("watchdog_child" in word for word in process.cmdline())
        return True

    return [child for child in psutil.Process().children() if watches(child)]
