"""Output of results: tables in the terminal, JSON files, and the page of an evaluation."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.progress import track
from rich.segment import Segment
from rich.table import Table

from acsar_gym import reading
from acsar_gym.errors import ConfigError, escape_unprintable, explain_error
from acsar_gym.tools import page
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.metrics import EPISODE_ENDS, TOLD_PREFIX, Summary

Item = TypeVar("Item")
ODOMETRY_ALARM = 0.15
"""Mean odometry error above which a table warns [m]; the default tolerance of a goal."""


class SafeConsole(Console):
    """A console that escapes control characters, so that names from files can't send any."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Render with control characters escaped, as they are in source code."""
        for text, style, control in super().render(renderable, options):
            if not (control or text.isprintable()):  # line breaks are kept
                text = "\n".join(map(escape_unprintable, text.split("\n")))  # noqa: PLW2901
            yield Segment(text, style, control)

    def on_broken_pipe(self) -> None:
        """Leave the exit code to `streams.run_guarded`."""
        raise  # noqa: PLE0704 - the BrokenPipeError that rich has caught


def escape_text(text: str) -> str:
    """Escape markup and control characters, for text from files in a cell or a title."""
    return escape(escape_unprintable(text))


def print_tables(*tables: Table) -> None:
    """Print tables; piped output is wide enough for all columns, unless COLUMNS says otherwise."""
    console = SafeConsole()
    if not console.is_terminal and not os.environ.get("COLUMNS", "").strip("0").isdecimal():
        console = SafeConsole(width=160)
    for table in tables:
        console.print(table)


def watch_progress(what: str, items: Iterable[Item], total: int) -> Iterable[Item]:
    """Yield items, with a progress bar on a terminal."""
    console = SafeConsole(stderr=True)
    hidden = not console.is_terminal
    return track(items, what, total, console=console, transient=True, disable=hidden)


def check_writable(path: Path | None) -> None:
    """Check before a long run that its result can be written; ConfigError if not."""
    if path is None:
        return
    if path.is_dir() or not (path.parent.is_dir() and os.access(path.parent, os.W_OK)):
        raise ConfigError(f"{path}: can't be written: must be a file in a folder of yours")


def make_folder(path: Path) -> None:
    """Create a folder and its parents, unless it exists; ConfigError if that fails."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: can't be made a folder: {explain_error(error)}") from error


def write_json(path: Path | None, data: Mapping[str, Any], *, indent: int | None = 2) -> None:
    """Write a JSON file, on one line if `indent` is None; do nothing if `path` is None."""
    if path is None:
        return
    reading.write_atomically(
        path, (json.dumps(data, indent=indent, allow_nan=False) + "\n").encode()
    )


def fill_columns(
    rows: Sequence[Item], columns: Mapping[str, Callable[[Item], str]]
) -> dict[str, list[str]]:
    """Format rows as columns of cells by name; columns without any value are left out."""
    cells = {name: [cell(row) for row in rows] for name, cell in columns.items()}
    return {name: [c or "-" for c in column] for name, column in cells.items() if any(column)}


def _fill_rows(
    rows: Sequence[tuple[str, Summary]], columns: Mapping[str, Callable[[Summary], str]]
) -> dict[str, list[str]]:
    cells = fill_columns([summary for _, summary in rows], columns)
    return {"behind the wire": [link for link, _ in rows], **cells}


def _make_table(title: str, cells: Mapping[str, Sequence[str]]) -> Table:
    table = Table(title=escape_text(title), title_justify="left")
    for name in cells:
        table.add_column(name, justify="right" if table.columns else "left")
    for row in zip(*cells.values(), strict=True):
        table.add_row(*map(escape_text, row))
    return table


def summary_table(
    title: str, rows: Sequence[tuple[str, Summary]], notes: Sequence[str] = ()
) -> Table:
    """Format the summary of the runs on each link as a table, with lines below it."""
    table = _make_table(title, _fill_rows(rows, SUMMARY_COLUMNS))
    errors = [s.odometry_error for _, s in rows if not math.isnan(s.odometry_error)]
    worst = max(errors, default=0.0)
    captions = [escape_text(note) for note in notes]
    if worst > ODOMETRY_ALARM:
        captions.append(
            f"Odometry is off by {worst:.2f} m, so success by odometry means little: "
            "calibrate wheel_radius and wheel_separation_multiplier."
        )
    if any(summary.invalid for _, summary in rows):
        captions.append(
            "Invalid: ended by a fault, or with too many late ticks; --json tells each."
        )
    table.caption = "\n".join(captions) or None
    return table


def people_table(rows: Sequence[tuple[str, Summary]]) -> Table:
    """Format what the runs on each link tell about those who move as a table."""
    return _make_table("among people", _fill_rows(rows, PEOPLE_COLUMNS))


def write_evaluation_page(
    path: Path, title: str, link: str, summary: Summary, episodes: Sequence[Episode]
) -> None:
    """Write an evaluation as an HTML page; see `page.write_page`."""
    page.check_report_extra()
    from plotly import graph_objects  # noqa: PLC0415 - optional

    told = {f"{TOLD_PREFIX}{name}": value for name, value in summary.told.items()}
    values = {**asdict(summary), **told}
    intervals = [
        [name, *(f"{number:.4g}" for number in (values[name], *interval))]
        for name, interval in summary.intervals.items()
        if math.isfinite(values[name])
    ]
    figure = graph_objects.Figure(
        layout={"xaxis_title": "seed", "yaxis_title": "duration [s]", "template": "plotly_white"}
    )
    for name, is_ended_so in EPISODE_ENDS.items():
        chosen = [episode for episode in episodes if is_ended_so(episode)]
        figure.add_scatter(
            x=[episode.seed for episode in chosen],
            y=[episode.time for episode in chosen],
            mode="markers",
            name=name.removesuffix("_rate"),
        )
    parts = [("Means", "", SUMMARY_COLUMNS)]
    if not math.isnan(summary.closest_person):
        parts.append(("Among people", PEOPLE_NOTE, PEOPLE_COLUMNS))
    sections = []
    for heading, note, columns in parts:
        cells = _fill_rows([(link, summary)], columns)
        table = page.Table(list(cells), [*zip(*cells.values(), strict=True)])
        sections.append(page.Section(heading, note, table))
    sections += [
        page.Section(
            "95 % intervals",
            "Wilson's of rates, bootstrapped ones of means.",
            page.Table(("figure", "value", "low", "high"), intervals),
        ),
        page.Section("Episodes", figures=[figure]),
    ]
    page.write_page(path, title, sections)


def fact_table(title: str, rows: Iterable[tuple[str, str]]) -> Table:
    """Format names and values as a table of two columns."""
    table = Table(title=escape_text(title), title_justify="left", show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    for name, value in rows:
        table.add_row(
            escape_text(name), escape("".join(c if c.isprintable() else "?" for c in value))
        )
    return table


def _format_rate(share: float) -> str:
    return f"{share:.1%}" if share > 0.0 else ""


def _format_number(value: float, unit: str = "") -> str:
    return "" if math.isnan(value) else f"{value:.2f} {unit}".strip()


def _format_late(summary: Summary) -> str:
    """Format the number of late ticks and the largest lateness."""
    worst = _format_number(summary.worst_lateness * 1000.0, "ms")
    return f"{summary.late_ticks} of {summary.ticks}" + (f", {worst}" if worst else "")


def _format_round_trip(summary: Summary) -> str:
    """Format median, 95th percentile and number of round trips."""
    if not summary.round_trips:
        return ""
    median, longest = 1e3 * summary.round_trip, 1e3 * summary.round_trip_p95
    return f"{median:.0f} ms, 95 % {longest:.0f} ms, of {summary.round_trips}"


SUMMARY_COLUMNS: dict[str, Callable[[Summary], str]] = {
    "success": lambda summary: (
        f"{round(summary.success_rate * summary.episodes)}/{summary.episodes} "
        f"({summary.success_rate:.1%})"
    ),
    "collision": lambda summary: _format_rate(summary.collision_rate),
    "struck": lambda summary: _format_rate(summary.struck_rate),
    "time-out": lambda summary: _format_rate(summary.timeout_rate),
    "fault": lambda summary: _format_rate(summary.fault_rate),
    "SPL": lambda summary: _format_number(summary.spl),
    "BARN score": lambda summary: (
        f"{summary.told['barn_score']:.3f}" if "barn_score" in summary.told else ""
    ),
    "time to goal": lambda summary: _format_number(summary.time_to_goal, "s"),
    "path": lambda summary: _format_number(summary.path, "m"),
    "clearance": lambda summary: _format_number(summary.clearance * 100.0, "cm"),
    "energy": lambda summary: _format_number(summary.energy, "J"),
    "beside path": lambda summary: _format_number(summary.cross_track * 100.0, "cm"),
    "odometry error": lambda summary: _format_number(summary.odometry_error * 100.0, "cm"),
    "late ticks": _format_late,
    "round trip": _format_round_trip,
    "invalid": lambda summary: f"{summary.invalid}" if summary.invalid else "",
}
"""Functions that format the cells of each column; empty text means no value."""
PEOPLE_COLUMNS: dict[str, Callable[[Summary], str]] = {
    "ran into people": lambda summary: _format_rate(summary.person_collision_rate),
    "struck by people": lambda summary: _format_rate(summary.struck_rate),
    "closest person": lambda summary: _format_number(summary.closest_person * 100.0, "cm"),
    "time to collision": lambda summary: _format_number(summary.time_to_collision, "s"),
    "intrusions": lambda summary: _format_number(summary.intrusion_rate, "a minute"),
}
"""The same of what is told where somebody moves."""
PEOPLE_NOTE = (
    "Whoever moved into the other ran into them: a robot that was struck is no success, and no "
    "collision. Distances from hull to hull, and times until both would have touched, are the "
    "least of an episode. An intrusion is to come within 0.45 m of somebody."
)
