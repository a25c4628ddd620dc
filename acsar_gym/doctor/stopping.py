"""How soon the wheels are commanded to stop, whatever befalls the program that drives them.

Three processes, as in earnest: the emulator, whose log tells when a command arrived; the program,
which drives at 100 Hz; and whoever does something to it. All share one monotonic clock. A time is
from the fault to the first zero command at the emulator, which looks every 5 ms. Through a cable
that is out no command can come, so there it is from the moment at which it is plugged in again.

`acsar-gym doctor --stopping` measures all kinds of faults.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.doctor.stopping_programs import CONTAINED, KINDS, REPLUGGED, no_namespace
from acsar_gym.errors import AcsarError, ConfigError, shown, suggestion
from acsar_gym.protocol import ZERO, Decoder

MOST_TRIALS = 100_000
"""Of each kind of fault."""
LIMIT = 0.25
"""So soon the zero command shall be there [s]."""
PATIENCE = 3.0
"""A zero command that isn't there after so long won't come [s]."""
SURE = 1.0
"""For so long no other command may follow the zeros [s]: a program that resets takes half of it."""
TRIES = 3
"""Programs that may end before they are harmed."""
POLL = 0.005
PULLED = (0.05, 0.5)
"""A cable is out for a time drawn from this range [s]."""

Told = Callable[[str, float], None]
"""Told of each trial's kind and time [s]."""


@dataclass(frozen=True, slots=True)
class Stops:
    """The times from one kind of fault to the zero command [s]; inf where none came."""

    kind: str
    times: tuple[float, ...]
    skipped: str = ""
    """Why it can't be had on this computer."""

    @property
    def sound(self) -> bool:
        """Whether no trial was too late."""
        return self.in_time == len(self.times)

    @property
    def in_time(self) -> int:
        """How many were within LIMIT."""
        return sum(time <= LIMIT for time in self.times)


def measure(
    trials: int = 100,
    kinds: Sequence[str] = tuple(KINDS),
    config: RobotConfig | None = None,
    progress: Told | None = None,
) -> list[Stops]:
    """So many trials of each kind of fault, each in a program of its own, on an emulated robot.

    Raises ConfigError for an unknown kind, for no trials and too many of them, and AcsarError where
    no program can drive.
    """
    _check(trials, kinds)
    config = config or RobotConfig.of(None)
    skipped = no_namespace() if set(kinds) & set(CONTAINED) else ""
    stops = []
    with _emulator(config) as board, _programs(board.device, config) as programs:
        for kind in kinds:
            if skipped and kind in CONTAINED:
                stops.append(Stops(kind, (), skipped))
            else:
                times = tuple(_trial(kind, programs, board, progress) for _ in range(trials))
                stops.append(Stops(kind, times))
    return stops


def measure_visibly(trials: int, kinds: Sequence[str] | None, config: RobotConfig) -> list[Stops]:
    """As `measure`, behind a progress bar; all kinds where none are named."""
    kinds = kinds or tuple(KINDS)
    _check(trials, kinds)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, transient=True) as bar:
        task = bar.add_task("", total=trials * len(kinds))
        return measure(
            trials,
            kinds,
            config,
            lambda kind, _: bar.update(task, advance=1, description=escape(KINDS[kind])),
        )


def _check(trials: int, kinds: Sequence[str]) -> None:
    if not 1 <= trials <= MOST_TRIALS:
        raise ConfigError(f"trials = {shown(trials)}: must be 1 to {MOST_TRIALS:,}")
    for kind in kinds:
        if kind not in KINDS:
            raise ConfigError(f"kind {kind!r} of fault is unknown{suggestion(kind, KINDS)}")


def _trial(kind: str, programs: _Programs, board: _Board, progress: Told | None) -> float:
    board.log.forget()
    fault = _fault(kind, programs)
    if kind in REPLUGGED:
        fault = board.replug()
    took = board.log.zero_after(fault)
    programs.bury()
    if board.log.turns_wheels():
        took = math.inf
    if progress is not None:
        progress(kind, took)
    return took


def _fault(kind: str, programs: _Programs) -> float:
    """When a program that drove was harmed; another one where a busy machine had stopped it."""
    for _ in range(TRIES - 1):
        try:
            return programs.fault(kind)
        except AcsarError:
            programs.bury()
    return programs.fault(kind)


class _Log:
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
class _Board:
    """An emulator in another process."""

    process: subprocess.Popen[str]
    device: str
    log: _Log

    def replug(self) -> float:
        """Pull the cable and plug it in again; when that was [s, monotonic clock]."""
        self.process.send_signal(signal.SIGUSR1)
        time.sleep(random.uniform(*PULLED))
        now = time.monotonic()
        self.process.send_signal(signal.SIGUSR2)
        return now


@contextlib.contextmanager
def _emulator(config: RobotConfig) -> Iterator[_Board]:
    """`acsar-gym emulate`, whose device keeps its name."""
    with tempfile.TemporaryDirectory(prefix="acsar-stopping-") as folder:
        log, robot = Path(folder, "log.jsonl"), Path(folder, "robot.yaml")
        robot.write_text(config.model_dump_json(), encoding="utf-8")  # YAML contains JSON
        name = Path(folder, "robot")
        options = ["--log", str(log), "--robot", str(robot), "--name", str(name)]
        with _process(["-m", "acsar_gym", "emulate", *options]) as process:
            _line(process)
            with log.open(encoding="ascii") as file:
                yield _Board(process, str(name), _Log(file))


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


class _Programs:
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
def _programs(device: str, config: RobotConfig) -> Iterator[_Programs]:
    code = "import sys; from acsar_gym.doctor import stopping_programs as s; s.serve(*sys.argv[1:])"
    with _process(["-c", code, device, config.model_dump_json()]) as process:
        try:
            yield _Programs(process)
        finally:  # it ends its program first
            with contextlib.suppress(OSError, subprocess.TimeoutExpired):
                process.communicate(timeout=PATIENCE)


def as_json(stops: Sequence[Stops]) -> dict[str, Any]:
    """The times [s] for programs; null where no zero command came."""
    return {
        "limit": LIMIT,
        "stops": {
            one.kind: {
                "fault": KINDS[one.kind],
                "in_time": one.in_time,
                "skipped": one.skipped or None,
                "times": [took if math.isfinite(took) else None for took in one.times],
            }
            for one in stops
        },
    }


def table(stops: Sequence[Stops]) -> Table:
    """The times for people [ms]."""
    drawn = Table(title=escape("from fault to zero command [ms]"), title_justify="left")
    drawn.add_column("fault")
    for column in ("min", "median", "max", f"within {LIMIT * 1000.0:.0f}"):
        drawn.add_column(column, justify="right")
    for one in stops:
        if one.times:
            figures = (min(one.times), statistics.median(one.times), max(one.times))
            shown = (f"{figure * 1000.0:.1f}" for figure in figures)
            drawn.add_row(KINDS[one.kind], *shown, f"{one.in_time} of {len(one.times)}")
        else:
            drawn.add_row(KINDS[one.kind], "-", "-", "-", "skipped")
            drawn.caption = escape(f"skipped: {one.skipped}")
    return drawn
