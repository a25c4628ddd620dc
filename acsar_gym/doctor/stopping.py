"""How soon the wheels are commanded to stop, whatever befalls the program that drives them.

Three processes, as in earnest: the emulator, whose log tells when a command arrived; the program,
which drives at 100 Hz; and whoever does something to it. All share one monotonic clock. A time is
from the fault to the first zero command at the emulator, which looks every 5 ms. Through a cable
that is out no command can come, so there it is from the moment at which it is plugged in again.

`acsar-gym doctor --stopping` measures all kinds of faults.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.doctor.stopping_processes import Board, Programs, emulator, programs
from acsar_gym.doctor.stopping_programs import CONTAINED, KINDS, REPLUGGED, no_namespace
from acsar_gym.errors import AcsarError, ConfigError, shown, suggestion

MOST_TRIALS = 100_000
"""Of each kind of fault."""
LIMIT = 0.25
"""So soon the zero command shall be there [s]."""
TRIES = 3
"""Programs that may end before they are harmed."""
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
    with emulator(config) as board, programs(board.device, config) as started:
        for kind in kinds:
            if skipped and kind in CONTAINED:
                stops.append(Stops(kind, (), skipped))
            else:
                times = tuple(_trial(kind, started, board, progress) for _ in range(trials))
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


def _trial(kind: str, program: Programs, board: Board, progress: Told | None) -> float:
    board.log.forget()
    fault = _fault(kind, program)
    if kind in REPLUGGED:
        fault = board.replug()
    took = board.log.zero_after(fault)
    program.bury()
    if board.log.turns_wheels():
        took = math.inf
    if progress is not None:
        progress(kind, took)
    return took


def _fault(kind: str, program: Programs) -> float:
    """When a program that drove was harmed; another one where a busy machine had stopped it."""
    for _ in range(TRIES - 1):
        try:
            return program.fault(kind)
        except AcsarError:
            program.bury()
    return program.fault(kind)


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
