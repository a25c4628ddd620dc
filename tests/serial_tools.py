"""The emulator and the command line in processes of their own, and what the emulator's log says."""

from __future__ import annotations

import contextlib
import gc
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from processes import Program, first_line, program

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


class Started(subprocess.Popen[bytes]):
    """Any other program that serves a board: it is not forked."""

    def __init__(self, *command: str) -> None:
        super().__init__(command, stdout=subprocess.PIPE, bufsize=0)

    def close(self) -> None:
        """Let go of the pipe."""
        assert self.stdout is not None
        self.stdout.close()


class Emulated(EmulatedBoard):
    """An emulator in another process: `device` is what links open."""

    def __init__(self, process: Program | Started, device: str, log: Path) -> None:
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
        process: Started | Program = Started(*shlex.split(board), *options)
    else:
        process = Program("import boards; boards.emulate()", "emulate", *options)
    emulated = Emulated(process, first_line(process).split(" ")[-1], log)
    if not emulated.device.startswith("/dev/"):
        emulated.end()
        raise AssertionError(f"no device from {board or options}")
    return emulated


def cli(*arguments: str | Path, timeout: float = TIMEOUT) -> subprocess.CompletedProcess[str]:
    """`acsar-gym ARGUMENTS`, to its end, without a keyboard."""
    with program(HEEDING_CTRL_C, *map(str, arguments)) as process:
        output, errors = process.communicate(timeout)
        return subprocess.CompletedProcess(arguments, process.wait(), output, errors)


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
