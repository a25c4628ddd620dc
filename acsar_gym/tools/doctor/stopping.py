"""Measures how soon wheels are commanded to stop after a fault of the driving program.

Three processes take part: the emulator, whose log holds the times of commands; the program, which
drives at 100 Hz; and one that causes faults. All use the same monotonic clock. The measured time is
from the fault to the first zero command at the emulator, which polls every 5 ms. While a cable is
unplugged no command can arrive, so then it starts when the cable is plugged in again.

`acsar-gym doctor --stopping` measures all kinds of faults.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.errors import AcsarError, ConfigError, show_value, suggest_name
from acsar_gym.safety.estop import stop_all
from acsar_gym.tools.doctor.stopping_processes import Board, Programs, emulator, programs
from acsar_gym.tools.doctor.stopping_programs import CONTAINED, KINDS, REPLUGGED, no_namespace

MOST_TRIALS = 100_000
"""Most trials of each kind of fault."""
LIMIT = 0.25
"""Required time from fault to zero command [s]."""
TRIES = 3
"""Attempts per trial, as a program may end before its fault."""
OnTrial = Callable[[str, float], None]
"""Called after each trial with its kind and time [s]."""


@dataclass(frozen=True, slots=True)
class Stops:
    """Times from one kind of fault to the zero command [s]; inf if none arrived."""

    kind: str
    times: tuple[float, ...]
    skipped: str = ""
    """Why this kind can't be tested on this computer; empty if it can."""

    @property
    def sound(self) -> bool:
        """Whether all trials were within LIMIT."""
        return self.in_time == len(self.times)

    @property
    def in_time(self) -> int:
        """Number of trials within LIMIT."""
        return sum(time <= LIMIT for time in self.times)


def measure(
    trials: int = 100,
    kinds: Sequence[str] = tuple(KINDS),
    config: RobotConfig | None = None,
    progress: OnTrial | None = None,
    board: str | None = None,
) -> list[Stops]:
    """Run trials of each kind of fault on an emulated robot, each with a new program.

    Args:
        trials: number of trials of each kind.
        kinds: keys of KINDS.
        config: configuration of the robot; None for the default.
        progress: called after each trial.
        board: command of another program that emulates a board; see `stopping_processes.emulator`.

    Returns:
        One result per kind.

    Raises:
        ConfigError: a kind is unknown, or `trials` is out of range.
        AcsarError: no program can drive.
    """
    _check(trials, kinds)
    config = config or RobotConfig.of(None)
    skipped = no_namespace() if set(kinds) & set(CONTAINED) else ""
    stops = []
    with emulator(config, board) as emulated, programs(emulated.device, config) as started:
        for kind in kinds:
            if skipped and kind in CONTAINED:
                stops.append(Stops(kind, (), skipped))
            else:
                times = tuple(_trial(kind, started, emulated, progress) for _ in range(trials))
                stops.append(Stops(kind, times))
    return stops


def measure_visibly(
    trials: int, kinds: Sequence[str] | None, config: RobotConfig, board: str | None = None
) -> list[Stops]:
    """Run `measure` with a progress bar.

    Args:
        trials: number of trials of each kind.
        kinds: keys of KINDS; None for all.
        config: configuration of the robot.
        board: as for `measure`.
    """
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
            board,
        )


def _check(trials: int, kinds: Sequence[str]) -> None:
    """Validate the arguments of `measure`."""
    if not 1 <= trials <= MOST_TRIALS:
        raise ConfigError(f"trials = {show_value(trials)}: must be 1 to {MOST_TRIALS:,}")
    for kind in kinds:
        if kind not in KINDS:
            raise ConfigError(f"kind {kind!r} of fault is unknown{suggest_name(kind, KINDS)}")


def _trial(kind: str, program: Programs, board: Board, progress: OnTrial | None) -> float:
    """Run one trial; returns the time from fault to zero command [s]."""
    board.log.forget()
    fault = _fault(kind, program)
    if kind in REPLUGGED:
        fault = board.replug()
    elif kind == "estop-out":
        fault = board.replug(lambda: stop_all(board.device))
    elif kind == "estop-resets":
        fault = time.monotonic()
        stop_all(board.device)
    took = board.log.zero_after(fault)
    program.bury()
    if board.log.turns_wheels():
        took = math.inf
    if progress is not None:
        progress(kind, took)
    return took


def _fault(kind: str, program: Programs) -> float:
    """Cause a fault and return its time; retries if the program stopped before."""
    for _ in range(TRIES - 1):
        try:
            return program.fault(kind)
        except AcsarError:
            program.bury()
    return program.fault(kind)


def as_json(stops: Sequence[Stops]) -> dict[str, Any]:
    """Format times [s] for JSON; null if no zero command arrived."""
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
    """Format times [ms] as a table."""
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
