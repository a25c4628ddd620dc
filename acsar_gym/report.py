"""Tables for people and JSON for programs."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from acsar_gym.errors import ConfigError
from acsar_gym.evaluation import Summary

ALARM = 0.15
"""Mean odometry error at which a table says so: the default tolerance of a goal [m]."""


def show(table: Table) -> None:
    """Print a table; piped output gets enough columns to hold it."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=110)
    console.print(table)


def check_writable(path: Path | None) -> None:
    """ConfigError if `path` can't be written: better now than after a long run."""
    if path is not None and not (path.parent.is_dir() and os.access(path.parent, os.W_OK)):
        raise ConfigError(f"{path}: can't be written: is there such a folder, and is it yours?")


def write_json(path: Path | None, data: Mapping[str, Any]) -> None:
    """Write `data` to `path` if there is one. Raises ConfigError where that can't be done."""
    if path is None:
        return
    try:
        path.write_text(json.dumps(data, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: can't be written: {error}") from None


def summary_table(title: str, rows: Sequence[tuple[str, Summary]]) -> Table:
    """One row for each way in which the same policy was run."""
    table = Table(title=title, title_justify="left")
    table.add_column("behind the wire")
    for column in ("success", "time to goal", "path", "odometry error", "late ticks"):
        table.add_column(column, justify="right")
    for name, summary in rows:
        wins = round(summary.success_rate * summary.episodes)
        table.add_row(
            name,
            f"{wins}/{summary.episodes} ({summary.success_rate:.1%})",
            _number(summary.time_to_goal, "s"),
            _number(summary.path, "m"),
            _number(summary.odometry_error * 100.0, "cm"),
            f"{summary.late_ticks} of {summary.ticks}",
        )
    worst = max(
        (s.odometry_error for _, s in rows if not math.isnan(s.odometry_error)), default=0.0
    )
    if worst > ALARM:
        table.caption = (
            f"Odometry is off by {worst:.2f} m, so success by odometry means little: "
            "calibrate wheel_radius and wheel_separation_multiplier."
        )
    return table


def _number(value: float, unit: str) -> str:
    return "not known" if math.isnan(value) else f"{value:.2f} {unit}"
