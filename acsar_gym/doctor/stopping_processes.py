"""The other processes of `doctor --stopping`: the emulator with its log, and who harms programs."""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError
from acsar_gym.protocol import ZERO, Decoder

PATIENCE = 3.0
"""A zero command that isn't there after so long won't come [s]."""
SURE = 1.0
"""For so long no other command may follow the zeros [s]: a program that resets takes half of it."""
POLL = 0.005
PULLED = (0.05, 0.5)
"""A cable is out for a time drawn from this range [s]."""


class Log:
    """The end of the emulator's log."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file
        self._line = ""
        self._decoder = Decoder()

    def forget(self) -> None:
        """What has been written is of no concern."""
        self._line = ""
        self._file.seek(0, os.SEEK_END)

    def zero_after(self, fault: float) -> float:
        """Time from the fault to the zero command that no other command follows; inf for none."""
        self._decoder.reset()
        zero = math.inf
        while time.monotonic() - min(zero, fault + PATIENCE) < SURE:
            for stamp, stopped in self._commands():
                if stamp >= fault:
                    zero = min(zero, stamp) if stopped else math.inf
            time.sleep(POLL)
        return zero - fault

    def turns_wheels(self) -> bool:
        """Whether any command since then does."""
        return not all(stopped for _, stopped in self._commands())

    def _commands(self) -> Iterator[tuple[float, bool]]:
        """When commands arrived, and whether they were zero."""
        for event in self._events():
            for reading in self._decoder.feed(str(event.get("rx", "")).encode("latin-1")):
                yield float(event["t"]), reading.speeds == ZERO

    def _events(self) -> Iterator[dict[str, Any]]:
        for piece in self._file:
            self._line += piece
            if self._line.endswith("\n"):
                line, self._line = self._line, ""
                with contextlib.suppress(ValueError):  # the first one may be cut
                    yield json.loads(line)


@dataclass(frozen=True, slots=True)
class Board:
    """An emulator in another process."""

    process: subprocess.Popen[str]
    device: str
    log: Log

    def replug(self) -> float:
        """Pull the cable and plug it in again; when that was [s, monotonic clock]."""
        self.process.send_signal(signal.SIGUSR1)
        time.sleep(random.uniform(*PULLED))
        now = time.monotonic()
        self.process.send_signal(signal.SIGUSR2)
        return now


@contextlib.contextmanager
def emulator(config: RobotConfig) -> Iterator[Board]:
    """`acsar-gym emulate`, whose device keeps its name."""
    with tempfile.TemporaryDirectory(prefix="acsar-stopping-") as folder:
        log, robot = Path(folder, "log.jsonl"), Path(folder, "robot.yaml")
        robot.write_text(config.model_dump_json(), encoding="utf-8")  # YAML contains JSON
        name = Path(folder, "robot")
        options = ["--log", str(log), "--robot", str(robot), "--name", str(name)]
        with _process(["-m", "acsar_gym", "emulate", *options]) as process:
            _line(process)
            with log.open(encoding="ascii") as file:
                yield Board(process, str(name), Log(file))


@contextlib.contextmanager
def _process(options: list[str]) -> Iterator[subprocess.Popen[str]]:
    """This Python in another process, safe from Ctrl-C; ended with the block."""
    with subprocess.Popen(
        [sys.executable, *options],
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
    """What it says next."""
    assert process.stdout is not None  # noqa: S101 - for the type checker
    line = process.stdout.readline().strip()
    if not line:
        raise AcsarError(f"{process.args!r} ended: its own message says why")
    return line


class Programs:
    """Starts programs that drive, and harms them: see `stopping_programs.serve`."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def fault(self, kind: str) -> float:
        """When a new program, which drove, was harmed [s, monotonic clock]."""
        self._say(kind)
        answer = _line(self._process)
        try:
            return float(answer)
        except ValueError:
            raise AcsarError(f"{kind}: the program didn't drive: {answer}") from None

    def bury(self) -> None:
        """End what is left of the program."""
        self._say("")
        _line(self._process)

    def _say(self, line: str) -> None:
        assert self._process.stdin is not None  # noqa: S101 - for the type checker
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()


@contextlib.contextmanager
def programs(device: str, config: RobotConfig) -> Iterator[Programs]:
    """A process that starts programs on the device, and harms them."""
    code = "import sys; from acsar_gym.doctor import stopping_programs as s; s.serve(*sys.argv[1:])"
    with _process(["-c", code, device, config.model_dump_json()]) as process:
        try:
            yield Programs(process)
        finally:  # it ends its program first
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                process.communicate(timeout=PATIENCE)
