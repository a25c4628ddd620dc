"""Output of results: tables in the terminal, JSON files, and the page of an evaluation."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping, Sequence
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
from acsar_gym.tools.evaluation.metrics import EPISODE_ENDS, FIGURES, TOLD_PREFIX, Summary

Item = TypeVar("Item")
ODOMETRY_ALARM = 0.15
"""Mean odometry error above which a table warns [m]; the default tolerance of a goal."""
PIPED_WIDTH = 160
"""Columns of output that isn't a terminal: enough for all tables."""
PEOPLE_NOTE = (
    "A robot that somebody ran into is struck: no success, and no collision of its own. Distances "
    "are from hull to hull. Distances and times until both would have touched are the least of an "
    "episode. An intrusion is to come within 0.45 m of somebody."
)


class SafeConsole(Console):
    """A console that escapes control characters, so that names from files can't send any."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """Render with control characters escaped, as they are in source code."""
        for text, style, control in super().render(renderable, options):
            if control or text.isprintable():
                yield Segment(text, style, control)
            else:  # line breaks are kept
                yield Segment("\n".join(map(escape_unprintable, text.split("\n"))), style, control)

    def on_broken_pipe(self) -> None:
        """Leave the exit code to `streams.run_guarded`."""
        raise  # noqa: PLE0704 - the BrokenPipeError that rich has caught


def escape_text(text: str) -> str:
    """Escape markup and control characters, for text from files in a cell or a title."""
    return escape(escape_unprintable(text))


def print_tables(*tables: Table) -> None:
    """Print tables; piped output is wide enough for all columns, unless COLUMNS is set."""
    console = SafeConsole()
    if not console.is_terminal and not os.environ.get("COLUMNS", "").strip("0").isdecimal():
        console = SafeConsole(width=PIPED_WIDTH)
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


def make_table(title: str, rows: Sequence[Mapping[str, str]], texts: Iterable[str] = ()) -> Table:
    """Format rows of cells by column; columns without any value are left out.

    Args:
        title: Title of the table.
        rows: Cells by name of the column.
        texts: Names of the columns that are aligned left; by default the first one.
    """
    table = Table(title=escape_text(title), title_justify="left")
    names = dict.fromkeys(name for row in rows for name in row)
    shown = [name for name in names if any(row.get(name) for row in rows)]
    text_columns = {*texts} or {*shown[:1]}
    for name in shown:
        table.add_column(escape_text(name), justify="left" if name in text_columns else "right")
    for row in rows:
        table.add_row(*(escape_text(row.get(name) or "-") for name in shown))
    return table


def format_figure(name: str, value: float) -> str:
    """Format a mean with its unit, for a table; empty for NaN and for a rate of 0."""
    figure = FIGURES[name]
    is_rate = figure.unit == "%"
    text = figure.format(value)
    if not text or (is_rate and value == 0.0):
        return ""
    return f"{text}%" if is_rate else f"{text} {figure.unit}".strip()


def figure_cells(summary: Summary, table: str) -> dict[str, str]:
    """Return the cells of the figures of a table."""
    return {
        figure.title: format_figure(name, getattr(summary, name))
        for name, figure in FIGURES.items()
        if figure.table == table
    }


def summary_cells(summary: Summary) -> dict[str, str]:
    """Return the cells of a summary's row in the main table."""
    hits = round(summary.success_rate * summary.episodes)
    cells = figure_cells(summary, "main")
    cells["success"] = f"{hits}/{summary.episodes} ({summary.success_rate:.1%})"
    if "barn_score" in summary.told:
        cells["BARN score"] = f"{summary.told['barn_score']:.3f}"

    lateness = f"{summary.late_ticks} of {summary.ticks}"
    if not math.isnan(summary.worst_lateness):
        lateness += f", {summary.worst_lateness * 1e3:.2f} ms"
    cells["late ticks"] = lateness
    if summary.round_trips:
        median = f"{summary.round_trip * 1e3:.0f} ms"
        longest = f"{summary.round_trip_p95 * 1e3:.0f} ms"
        cells["round trip"] = f"{median}, 95 % {longest}, of {summary.round_trips}"
    cells["invalid"] = f"{summary.invalid}" if summary.invalid else ""
    return cells


def summary_table(
    title: str, rows: Sequence[tuple[str, Summary]], notes: Sequence[str] = ()
) -> Table:
    """Format the summary of the runs on each link as a table, with lines below it."""
    links = [{"behind the wire": link, **summary_cells(summary)} for link, summary in rows]
    table = make_table(title, links)

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
            "Invalid: ended by a fault, or with too many late ticks; --json names the episodes."
        )
    table.caption = "\n".join(captions) or None
    return table


def people_table(rows: Sequence[tuple[str, Summary]]) -> Table:
    """Format what the runs on each link have about those who move as a table."""
    links = [{"behind the wire": link, **figure_cells(summary, "people")} for link, summary in rows]
    return make_table("among people", links)


def write_evaluation_page(
    path: Path, title: str, summary: Summary, episodes: Sequence[Episode]
) -> None:
    """Write an evaluation as an HTML page; see `page.write_page`."""
    page.check_report_extra()
    from plotly import graph_objects  # noqa: PLC0415 - optional

    rows = []
    for name, interval in summary.intervals.items():
        figure = FIGURES.get(name)
        if figure is not None:
            values = [figure.format(value) for value in (getattr(summary, name), *interval)]
            rows.append([figure.heading, *values])
        else:
            short = name.removeprefix(TOLD_PREFIX)
            rows.append([short, *(f"{value:.4g}" for value in (summary.told[short], *interval))])
    rows = [row for row in rows if row[1] not in ("", "nan")]
    ends = graph_objects.Figure(
        layout={"xaxis_title": "seed", "yaxis_title": "duration [s]", "template": "plotly_white"}
    )
    for end in EPISODE_ENDS.values():
        chosen = [episode for episode in episodes if end.of(episode)]
        ends.add_scatter(
            x=[episode.seed for episode in chosen],
            y=[episode.time for episode in chosen],
            mode="markers",
            name=end.title,
        )
    note = "Wilson's intervals of rates, bootstrapped intervals of means."
    is_among_people = not math.isnan(summary.closest_person)
    page.write_page(
        path,
        title,
        [
            page.Section(
                "Means and their 95 % intervals",
                f"{note}\n{PEOPLE_NOTE}" if is_among_people else note,
                page.Table(("figure", "mean", "low", "high"), rows),
            ),
            page.Section("Episodes", figures=[ends]),
        ],
    )


def fact_table(title: str, rows: Iterable[tuple[str, str]]) -> Table:
    """Format names and values as a table of two columns."""
    table = Table(title=escape_text(title), title_justify="left", show_header=False)
    table.add_column()
    table.add_column(overflow="fold")
    for name, value in rows:
        printable = "".join(c if c.isprintable() else "?" for c in value)
        table.add_row(escape_text(name), escape(printable))
    return table
