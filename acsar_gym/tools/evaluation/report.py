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
from rich.text import Text

from acsar_gym import reading
from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.tools import page
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.metrics import EPISODE_ENDS, Summary, find_figure

Item = TypeVar("Item")
Cells = Mapping[str, str]
Row = Mapping[str, Any]
"""Means by the names of figures, with their "intervals", as `Summary.as_row`. None is unknown."""
ODOMETRY_ALARM = 0.15
"""Mean odometry error above which a table warns [m]: the default tolerance of a goal."""
INTERVAL_NOTE = (
    "Intervals have 95 %: Wilson's for rates, the bootstrap over training seeds and scenes for "
    "means (Agarwal et al. 2021). Time, path and energy are means over successful episodes."
)
PIPED_WIDTH = 160
"""Columns of output that isn't a terminal: enough for all tables."""
PEOPLE_NOTE = (
    "A robot that a person ran into counts as struck: this is no success, and no collision of the "
    "robot. Distances are from hull to hull. Distances and times to contact are the least of an "
    "episode. An intrusion: the robot comes within 0.45 m of a person."
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


def title_line(title: str) -> Text:
    """Return a title that isn't broken at the width of a narrow table."""
    return Text(title, "table.title", overflow="ignore", no_wrap=True)


def print_tables(*tables: Table) -> None:
    """Print tables. Piped output is wide enough for all columns, unless COLUMNS is set."""
    console = SafeConsole()
    if not console.is_terminal and not os.environ.get("COLUMNS", "").strip("0").isdecimal():
        console = SafeConsole(width=PIPED_WIDTH)
    for table in tables:
        console.print(table)


def watch_progress(what: str, items: Iterable[Item], total: int) -> Iterable[Item]:
    """Yield items, with a progress bar on a terminal."""
    # On stderr, so that piped results stay clean.
    console = SafeConsole(stderr=True)
    hidden = not console.is_terminal
    return track(items, what, total, console=console, transient=True, disable=hidden)


def check_writable(path: Path | None) -> None:
    """Check before a long run that its result can be written. ConfigError if not."""
    if path is None:
        return
    if path.is_dir() or not (path.parent.is_dir() and os.access(path.parent, os.W_OK)):
        raise ConfigError(f"{path}: can't be written: must be a file in a folder of yours")


def write_json(path: Path | None, data: Mapping[str, Any], *, indent: int | None = 2) -> None:
    """Write a JSON file, on one line if `indent` is None. Do nothing if `path` is None."""
    if path is None:
        return
    reading.write_atomically(
        path, (json.dumps(data, indent=indent, allow_nan=False) + "\n").encode()
    )


def fill_cells(rows: Sequence[Cells]) -> page.Table:
    """Arrange rows of cells by column. Columns without any value are left out."""
    names = dict.fromkeys(name for row in rows for name in row)
    shown = [name for name in names if any(row.get(name) for row in rows)]
    return page.Table(shown, [[row.get(name) or "-" for name in shown] for row in rows])


def make_table(title: str, rows: Sequence[Cells], texts: Iterable[str] = ()) -> Table:
    """Format rows of cells for the terminal, as `fill_cells`.

    Args:
        title: Title of the table.
        rows: Cells by name of the column.
        texts: Names of the columns that are aligned left, by default the first column.
    """
    # Names are aligned left, numbers right.
    cells = fill_cells(rows)
    text_columns = {*texts} or {*cells.columns[:1]}
    table = Table(title=title_line(title), title_justify="left")
    for name in cells.columns:
        is_text = name in text_columns
        table.add_column(escape_text(name), justify="left" if is_text else "right", overflow="fold")
    for row in cells.rows:
        table.add_row(*map(escape_text, row))
    return table


def fact_table(title: str, rows: Iterable[tuple[str, str]]) -> Table:
    """Format names and values as a table of two columns without headings."""
    cells = [{"name": name, "value": value} for name, value in rows]
    table = make_table(title, cells, texts=("name", "value"))
    table.show_header = False
    return table


def format_figure(row: Row, name: str) -> str:
    """Format a mean with its interval, such as "0.885 (0.861 to 0.907)". Empty for none."""
    figure = find_figure(name)
    numbers = (row.get(name), *row["intervals"].get(name, ()))
    texts = [f"{n * figure.factor:.{figure.digits}f}" for n in numbers if n is not None]
    return "{} ({} to {})".format(*texts) if len(texts) == 3 else "".join(texts)


def figure_cells(row: Row) -> Cells:
    """Return the figures of a row as text, by name."""
    return {name: format_figure(row, name) for name in row["intervals"]}


def list_lines(columns: Mapping[str, Cells], corner: str = "figure") -> list[Cells]:
    """Return a line of a table for each figure that is known in a column.

    Args:
        columns: Cells by the names of figures, for each column.
        corner: Heading of the figures' names.
    """
    names = dict.fromkeys(name for cells in columns.values() for name in cells)
    lines: list[Cells] = []
    for name in names:
        values = {column: cells.get(name, "") for column, cells in columns.items()}
        if any(values.values()):
            lines.append({corner: find_figure(name).heading, **values})
    return lines


def count_cells(summary: Summary) -> dict[str, str]:
    """Return what is counted over the episodes, as far as it is known."""
    # Late ticks are 0 in simulation, whose ticks have no deadline.
    successes = round(summary.success_rate * summary.episodes)
    lateness = f"{summary.late_ticks} of {summary.ticks}"
    if not math.isnan(summary.worst_lateness):
        lateness += f", {summary.worst_lateness * 1e3:.2f} ms"

    cells = {
        "successes": f"{successes}/{summary.episodes} ({summary.success_rate:.1%})",
        "late ticks": lateness,
    }
    if summary.round_trips:
        cells["round trip"] = (
            f"{summary.round_trip * 1e3:.0f} ms, 95 % {summary.round_trip_p95 * 1e3:.0f} ms, "
            f"of {summary.round_trips}"
        )
    if summary.invalid:
        cells["invalid"] = f"{summary.invalid}"
    return cells


def summary_table(
    title: str, rows: Sequence[tuple[str, Summary]], notes: Sequence[str] = ()
) -> Table:
    """Format the figures of the runs on each link as a table, with lines below it."""
    # First what is counted, then the figures.
    corner = "behind the wire"
    counts = list_lines({link: count_cells(summary) for link, summary in rows}, corner)
    figures = {link: figure_cells(summary.as_row()) for link, summary in rows}
    table = make_table(title, [*counts, *list_lines(figures, corner)])

    # What makes the figures doubtful stands below them.
    captions = [escape_text(note) for note in notes]
    errors = [s.odometry_error for _, s in rows if s.odometry_error > ODOMETRY_ALARM]
    if errors:
        captions.append(
            f"Odometry is off by {max(errors):.2f} m, so success by odometry means little: "
            "calibrate wheel_radius and wheel_separation_multiplier."
        )
    if any(summary.invalid for _, summary in rows):
        captions.append(
            "Invalid: ended by a fault, or with too many late ticks. --json names the episodes."
        )
    table.caption = "\n".join(captions) or None
    return table


def write_evaluation_page(
    path: Path, title: str, link: str, summary: Summary, episodes: Sequence[Episode]
) -> None:
    """Write an evaluation as an HTML page, see `page.write_page`."""
    page.check_report_extra()
    from plotly import graph_objects  # noqa: PLC0415 - optional

    # A point for each episode, in a colour for each way to end.
    axes = {"xaxis_title": "seed", "yaxis_title": "duration [s]", "template": "plotly_white"}
    plot = graph_objects.Figure(layout=axes)
    for end in EPISODE_ENDS.values():
        chosen = [episode for episode in episodes if end.of(episode)]
        seeds = [episode.seed for episode in chosen]
        times = [episode.time for episode in chosen]
        plot.add_scatter(x=seeds, y=times, mode="markers", name=end.title)

    # Pages of worlds without people don't explain their figures.
    note = "" if math.isnan(summary.closest_person) else f"\n{PEOPLE_NOTE}"
    figures = {link: {**count_cells(summary), **figure_cells(summary.as_row())}}
    sections = [
        page.Section("All figures", f"{INTERVAL_NOTE}{note}", fill_cells(list_lines(figures))),
        page.Section("Episodes", figures=[plot]),
    ]
    page.write_page(path, title, sections)
