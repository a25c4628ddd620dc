"""Helper processes of `doctor --stopping`: the emulator, and one that causes faults."""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.protocol import ZERO, Decoder

PATIENCE = 3.0
"""Longest wait for a zero command [s]."""
SURE = 1.0
"""Time after a zero command without other commands [s]; a reset takes half of it."""
POLL = 0.005
PULLED = (0.05, 0.5)
"""Range of the random time for which a cable is unplugged [s]."""


class Log:
    """Reads new events of the emulator's log."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._line = ""
        self._decoder = Decoder()

    def forget(self) -> None:
        """Skip what has been written so far."""
        self._line = ""
        self._file.seek(0, os.SEEK_END)

    def zero_after(self, fault: float) -> float:
        """Wait for a zero command that no other command follows.

        Args:
            fault: time of the fault [s, monotonic clock].

        Returns:
            Time from the fault to that command [s]; inf if there is none.
        """
        self._decoder.reset()
        zero = math.inf
        while time.monotonic() - min(zero, fault + PATIENCE) < SURE:
            for stamp, stopped in self._commands():
                if stamp >= fault:
                    zero = min(zero, stamp) if stopped else math.inf
            time.sleep(POLL)
        return zero - fault

    def turns_wheels(self) -> bool:
        """Return whether any later command isn't zero."""
        return not all(stopped for _, stopped in self._commands())

    def _commands(self) -> Iterator[tuple[float, bool]]:
        """Yield the time of each command, and whether it is zero."""
        for event in self._events():
            for reading in self._decoder.feed(str(event.get("rx", "")).encode("latin-1")):
                yield float(event["t"]), reading.speeds == ZERO

    def _events(self) -> Iterator[dict[str, Any]]:
        """Yield the complete events of the log."""
        for piece in self._file:
            self._line += piece
            if self._line.endswith("\n"):
                line, self._line = self._line, ""
                with contextlib.suppress(ValueError):  # the first line may be incomplete
                    yield json.loads(line)


@dataclass(frozen=True, slots=True)
class Board:
    """An emulator in another process."""

    process: subprocess.Popen[str]
    device: str
    log: Log

    def replug(self, meanwhile: Callable[[], object] = lambda: None) -> float:
        """Unplug the cable and plug it in again; returns the time of that [s, monotonic clock].

        Args:
            meanwhile: called while the cable is out.
        """
        self.process.send_signal(signal.SIGUSR1)
        time.sleep(random.uniform(*PULLED))
        meanwhile()
        now = time.monotonic()
        self.process.send_signal(signal.SIGUSR2)
        return now


@contextlib.contextmanager
def emulator(config: RobotConfig, board: str | None = None) -> Iterator[Board]:
    """Run `acsar-gym emulate` with a device name that stays the same.

    Args:
        config: configuration of the robot.
        board: command of another program with the emulator's --log, --name, output and signals.
    """
    with tempfile.TemporaryDirectory(prefix="acsar-stopping-") as folder:
        log, robot = Path(folder, "log.jsonl"), Path(folder, "robot.yaml")
        robot.write_text(config.model_dump_json(), encoding="utf-8")  # YAML contains JSON
        name = Path(folder, "robot")
        options = ["--log", str(log), "--name", str(name)]
        emulate = [sys.executable, "-m", "acsar_gym", "emulate", "--robot", str(robot)]
        with _process([*(shlex.split(board) if board else emulate), *options]) as process:
            _line(process)
            with log.open(encoding="ascii") as file:
                yield Board(process, str(name), Log(file))


@contextlib.contextmanager
def _process(command: list[str]) -> Iterator[subprocess.Popen[str]]:
    """Run a command in another process, which ignores Ctrl-C and ends with the context."""
    with subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _line(process: subprocess.Popen[str]) -> str:
    """Read a line of the output; AcsarError if the process has ended."""
    assert process.stdout is not None  # noqa: S101 - for the type checker
    line = process.stdout.readline().strip()
    if not line:
        raise AcsarError(f"{process.args!r} ended: its own message says why")
    return line


class Programs:
    """Starts driving programs and causes faults; client of `stopping_programs.serve`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def fault(self, kind: str) -> float:
        """Start a program, let it drive, and cause a fault.

        Args:
            kind: key of KINDS.

        Returns:
            Time of the fault [s, monotonic clock].

        Raises:
            AcsarError: the program didn't drive.
        """
        self._say(kind)
        answer = _line(self._process)
        try:
            return float(answer)
        except ValueError:
            raise AcsarError(f"{kind}: the program didn't drive: {answer}") from None

    def bury(self) -> None:
        """End the program, if it still runs."""
        self._say("")
        _line(self._process)

    def _say(self, line: str) -> None:
        """Send a line to the process."""
        assert self._process.stdin is not None  # noqa: S101 - for the type checker
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()


@contextlib.contextmanager
def programs(device: str, config: RobotConfig) -> Iterator[Programs]:
    """Run a process that starts programs and causes faults."""
    code = (
        "import sys; from acsar_gym.tools.doctor import stopping_programs as s; "
        "s.serve(*sys.argv[1:])"
    )
    command = [sys.executable, "-c", code, device, config.model_dump_json()]
    with _process(command) as process:
        try:
            yield Programs(process)
        finally:  # it ends its program before itself
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                process.communicate(timeout=PATIENCE)
