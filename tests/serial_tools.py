"""The emulator and the command line in processes of their own, and what the emulator's log says."""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import select
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from typing import IO

import boards
import pytest

from acsar_gym import testing
from acsar_gym.guard.shutdown import install_handlers
from acsar_gym.testing import EmulatedBoard

TIMEOUT = testing.TIMEOUT
wait_until = testing.wait_until
TRIALS = 3
"""A machine that stalls makes a board look slow: it is measured again, at most so often."""
CLI = (sys.executable, "-m", "acsar_gym")
HEEDING_CTRL_C = """
import signal
from acsar_gym.tools.cli import main

signal.signal(signal.SIGINT, signal.default_int_handler)
main()
"""
"""The command line as in an interactive shell, however the tests were started."""
DRIVER = """
import os, resource, signal, sys
from acsar_gym import Robot, RobotConfig, open_link

# As in an interactive shell, however the tests were started.
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
signal.signal(signal.SIGINT, signal.default_int_handler)
for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
    signal.signal(number, signal.SIG_DFL)

config = RobotConfig.preset("acsar").with_(
    connect_timeout=20.0, feedback_timeout=5.0, watchdog_timeout=2.0
)
robot = Robot(open_link(sys.argv[1], config), config)


def drive(ticks):
    for _ in range(ticks):
        robot.drive(0.2, 0.0)
"""
"""Beginning of a program that drives the robot behind the device in argv[1]."""
BRIDGE = """
import os, select, socket, sys

tty = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
server = socket.create_server(("127.0.0.1", 0))
print(server.getsockname()[1], flush=True)
client, _ = server.accept()
while True:
    ready, _, _ = select.select([client, tty], [], [])
    if tty in ready:
        client.sendall(os.read(tty, 4096))
    if client in ready:
        os.write(tty, client.recv(4096))
"""
"""A serial device server: the device in argv[1] behind the TCP port that it prints."""

StartEmulator = Callable[..., "Emulated"]
RobotFile = Callable[..., Path]


class Forked:
    """`main()` with command line arguments, in a process that has imported everything already.

    With what tests use of subprocess.Popen.
    """

    def __init__(self, *arguments: str, main: Callable[[], None] | None = None) -> None:
        self.args = arguments
        context = _fork_server()
        inputs, outputs = zip(*(context.Pipe(duplex=False) for _ in range(2)), strict=True)
        task = (main, arguments, dict(os.environ), outputs)
        self._process = context.Process(target=_run, args=task, daemon=True)
        self._process.start()
        for end in outputs:
            end.close()
        self.stdout, self.stderr = map(_as_text, inputs)

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float) -> int:
        """The exit status. Raises TimeoutExpired where it still runs after `timeout` [s]."""
        self._process.join(timeout)
        code = self.poll()
        if code is None:
            raise subprocess.TimeoutExpired(self.args, timeout)
        return code

    def send_signal(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def close(self) -> None:
        self.stdout.close()
        self.stderr.close()


class Started(subprocess.Popen[str]):
    """Any other program that serves a board: it is not forked."""

    def __init__(self, *command: str) -> None:
        super().__init__(command, stdout=subprocess.PIPE, text=True)

    def close(self) -> None:
        """Let go of the pipe."""
        assert self.stdout is not None
        self.stdout.close()


def _as_text(pipe: Connection) -> IO[str]:
    with pipe:
        return os.fdopen(os.dup(pipe.fileno()), encoding="utf-8")


@functools.cache
def _fork_server() -> ForkServerContext:
    """Multiprocessing's, running, with everything that an emulator needs."""
    context = get_context("forkserver")
    context.set_forkserver_preload(["__main__", "serial_tools", "lidar_tools", "emulator_process"])
    with pytest.MonkeyPatch.context() as patch:  # Python 3.11's doesn't pass sys.path on
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        ensure_running()
    return context


def _run(
    main: Callable[[], None] | None,
    arguments: tuple[str, ...],
    environment: dict[str, str],
    said: tuple[Connection, Connection],
) -> None:
    """Run `main`, or acsar-gym, with `said` as standard output and error."""
    from acsar_gym.tools import cli

    os.environ.clear()
    os.environ.update(environment)
    for number, pipe in enumerate(said, start=1):
        os.dup2(pipe.fileno(), number)
        pipe.close()
    sys.stdout, sys.stderr = (os.fdopen(n, "w", buffering=1, closefd=False) for n in (1, 2))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["acsar-gym", *arguments]
    (main or cli.main)()


class Emulated(EmulatedBoard):
    """An emulator in another process: `device` is what links open."""

    def __init__(self, process: Forked | Started, device: str, log: Path) -> None:
        super().__init__(process.send_signal, device, log)
        self.process = process
        self.log = log

    def forget(self) -> None:
        """Begin a new log once what was written until now has arrived, and the robot stands."""
        now = time.monotonic()

        def has_arrived() -> bool:
            """A late emulator reads all in one loop, a UART takes another one or two."""
            loops = [event for event in self.events() if "pose" in event and event["t"] > now]
            return len(loops) >= 5

        wait_until(lambda: has_arrived() and self.stands(loops=20), "a robot that stands")
        self._events.clear()

    def devices(self) -> list[str]:
        """The name of the device after each pull and plug, "" where the cable was out."""
        return [event["device"] for event in self.events() if "device" in event]

    def since_plugged(self) -> bytes:
        """What clients have put on the wire since the cable moved for the last time."""
        data = ""
        for event in self.events():
            data = "" if "device" in event else data + event.get("rx", "")
        return data.encode("latin-1")

    def kill(self) -> None:
        """Unplug: the device goes away at once."""
        self.process.kill()
        self.process.wait(TIMEOUT)

    def end(self) -> int:
        """Switch off in order, and return the exit status. Idempotent."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.terminate()
        try:
            return self.process.wait(TIMEOUT)
        finally:
            self.process.kill()
            self.process.close()

    def close(self) -> None:
        """Switch off, for `contextlib.closing`."""
        self.end()


def start(log: Path, *arguments: str, board: str | None = None) -> Emulated:
    """An emulator that serves. Its log is at `log`.

    `board` is the command of another program with the same output, log and signals.
    """
    options = ("--log", str(log), *arguments)
    if board:
        process: Started | Forked = Started(*shlex.split(board), *options)
    else:
        process = Forked("emulate", *options, main=boards.emulate)
    emulated = Emulated(process, first_line(process).split(" ")[-1], log)
    if not emulated.device.startswith("/dev/"):
        emulated.end()
        raise AssertionError(f"no device from {board or options}")
    return emulated


def first_line(process: subprocess.Popen[str] | Forked) -> str:
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], TIMEOUT)
    return process.stdout.readline().strip() if ready else ""


def cli(*arguments: str | Path, timeout: float = TIMEOUT) -> subprocess.CompletedProcess[str]:
    """`acsar-gym ARGUMENTS`, to its end, without a keyboard."""
    process = Forked(*map(str, arguments))
    with ThreadPoolExecutor(2) as readers:
        try:
            texts = [readers.submit(stream.read) for stream in (process.stdout, process.stderr)]
            code = process.wait(timeout)
        finally:
            process.kill()
    process.close()
    return subprocess.CompletedProcess(arguments, code, *(text.result() for text in texts))


@contextlib.contextmanager
def program(code: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A Python program in another process, killed at the end of the block if it still runs."""
    command = [sys.executable, "-c", code, *arguments]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def open_files() -> int:
    """How many descriptors this process holds."""
    gc.collect()
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - the count is all that is wanted


@contextlib.contextmanager
def no_leak() -> Iterator[None]:
    """Fails where the block leaves a descriptor open."""
    install_handlers()  # which opens a pipe, once in a process
    files = open_files()
    yield
    assert open_files() == files, "a descriptor was left open"
