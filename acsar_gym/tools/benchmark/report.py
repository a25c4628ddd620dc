"""The result of a benchmark, and its table: as text, CSV, LaTeX, a figure and an HTML page.

Intervals of scores and means are those of the bootstrap over training seeds and scenes, see
`metrics.bootstrap_interval`. An agent without training has one seed.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from acsar_gym import reading
from acsar_gym.errors import ConfigError, check_extra
from acsar_gym.physics.bodies import BODIES
from acsar_gym.tools import page
from acsar_gym.tools.benchmark.plan import BASELINE, NOMINAL, ROS2, Agent, Cell, Place
from acsar_gym.tools.evaluation import provenance, report
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.metrics import (
    bootstrap_interval,
    find_figure,
    measure_figures,
    replace_nonfinite,
)
from acsar_gym.tools.evaluation.report import Row

LINK_NAMES = {name: body.title for name, body in BODIES.items()} | {ROS2: "ROS 2"}
TEXT_COLUMNS = ("scenes", "agent", "link", "condition")
MAIN_FIGURES = ("score", "success_rate", "person_collision_rate")
DIFFERENCES = {"score": ("score difference", 1.0, 3), "success": ("success [points]", 100.0, 1)}
"""Fields of `Episode` by whose means agents are compared with the best baseline: heading, factor
and digits of the differences."""
INTRODUCTION = (
    "Every agent drives the same scenes with the same seeds. The mean score counts every failure "
    "as 0. Differences are those to the best baseline, in pairs of episodes, in units of the score "
    f"and in points of the success rate. {report.INTERVAL_NOTE} {report.PEOPLE_NOTE}"
)


BENCHMARK_SCHEMA = 6
"""Version of `benchmark.json`."""


@dataclass(frozen=True)
class CellResult:
    """The episodes of a cell, in the order of its scenes."""

    episodes: list[Episode] = field(default_factory=list)
    seconds: float = 0.0
    """CPU time that it took [s]."""
    refused: str = ""
    """Why the agent couldn't drive there. Empty if it did."""


@dataclass
class AgentRow:
    """An agent at a place, over all its training seeds."""

    agent: Agent
    place: Place
    groups: dict[int | None, list[Episode]] = field(default_factory=dict)
    """Episodes by training seed, of those that drove."""
    refused: str = ""

    def matrix(self, name: str) -> NDArray[np.float64]:
        """Return a field of `Episode`, (training seeds, scenes)."""
        groups = self.groups.values()
        return np.array([[getattr(e, name) for e in group] for group in groups], np.float64)

    def mean(self, name: str) -> float:
        """Return the mean of a field over all episodes."""
        return float(self.matrix(name).mean()) if self.groups else 0.0

    def as_dict(self, rivals: Sequence[AgentRow]) -> dict[str, Any]:
        """Return figures, intervals and differences to the best baseline of `rivals`, for JSON."""
        about = {"agent": self.agent.name, "kind": self.agent.kind, **self.place._asdict()}

        # An agent that couldn't drive has a row without figures.
        if not self.groups:
            return {**about, "refused": self.refused}
        return {
            **about,
            "refused": "",
            "training_seeds": list(self.groups),
            "episodes": self.matrix("score").size,
            **measure_figures([*self.groups.values()]),
            "seed_scores": self.matrix("score").mean(axis=1).tolist(),
            "seed_success": self.matrix("success").mean(axis=1).tolist(),
            "differences": {name: self._compare(name, rivals) for name in DIFFERENCES},
        }

    def _compare(self, name: str, rivals: Sequence[AgentRow]) -> dict[str, Any] | None:
        """Compare with the best baseline, in pairs of episodes of the same scene and seed.

        Of baselines that succeed equally often, the best has the highest score. None if there is
        no other baseline.
        """
        # Agents that know the simulator's truth are no baselines.
        baselines = [row for row in rivals if row.agent.kind == BASELINE and row.groups]
        best = max(baselines, key=lambda row: (row.mean(name), row.mean("score")), default=self)
        if best is self:
            return None

        # A baseline has one seed, with which each training seed is compared.
        differences = self.matrix(name) - best.matrix(name)[:1]
        return {
            "over": best.agent.name,
            "difference": float(differences.mean()),
            "interval": bootstrap_interval(differences),
        }


def make_rows(cells: Mapping[Cell, CellResult]) -> list[AgentRow]:
    """Group cells to rows, of all training seeds of an agent, the best score of a place first."""
    # Training seeds of an agent share its row, refused or not.
    rows: dict[tuple[Place, str], AgentRow] = {}
    for cell, result in cells.items():
        agent = cell.agent
        row = rows.setdefault((cell.place, agent.name), AgentRow(agent, cell.place))
        row.refused = row.refused or result.refused
        if result.episodes:  # a seed that couldn't drive doesn't count
            row.groups[agent.training_seed] = result.episodes

    # The order of the plan, and the best agent first.
    places = list(dict.fromkeys(place for place, _ in rows))
    return sorted(rows.values(), key=lambda row: (places.index(row.place), -row.mean("score")))


def make_result(plan: Mapping[str, Any], cells: Mapping[Cell, CellResult]) -> dict[str, Any]:
    """Compute the content of `benchmark.json`.

    Args:
        plan: The plan, as `Plan.as_dict`.
        cells: The cells and their results.

    Returns:
        | key | content |
        |---|---|
        | `schema` | `BENCHMARK_SCHEMA` |
        | `header` | `versions`, and the plan: `scenes`, by id and set (`robot`, `score`, |
        | | `sha256`, ...), `agents`, by name, `conditions`, by name, `links` |
        | `cells` | a list: agent, training seed and place, `refused` (why it couldn't drive, |
        | | else ""), `seconds`, and `episodes`: the fields of every `Episode` |
        | `rows` | figures over all training seeds of an agent at a place, with `intervals`, |
        | | and `differences` of score and success to the best baseline in the same scenes |
    """
    rows = make_rows(cells)
    versions = provenance.library_versions(*provenance.DRIVING_LIBRARIES)
    result: dict[str, Any] = replace_nonfinite(
        {
            "schema": BENCHMARK_SCHEMA,
            "header": {"versions": versions, **plan},
            "cells": [{**cell.about, **vars(result)} for cell, result in cells.items()],
            "rows": [
                row.as_dict([rival for rival in rows if rival.place == row.place]) for row in rows
            ],
        }
    )
    return result


def format_difference(row: Row, name: str) -> str:
    """Format a paired difference, such as "+0.021 (+0.004 to +0.038) over dwa"."""
    difference = row["differences"][name]
    if difference is None:
        return ""
    _, factor, digits = DIFFERENCES[name]

    # The interval of a single scene isn't known.
    numbers = (difference["difference"], *difference["interval"])
    value, low, high = ("?" if n is None else f"{n * factor:+.{digits}f}" for n in numbers)
    return f"{value} ({low} to {high}) over {difference['over']}"


def main_cells(row: Row) -> dict[str, str]:
    """Return the cells of a row in the main table."""
    seeds = len(row["training_seeds"])
    return {
        "scenes": f"{row['id']} {row['scenes']}",
        "agent": f"{row['agent']} (privileged)" if row["kind"] == "privileged" else row["agent"],
        "link": LINK_NAMES[row["link"]],
        "condition": "" if row["condition"] == NOMINAL else row["condition"],
        "seeds": f"{seeds}" if seeds > 1 else "",
        "episodes": f"{row['episodes']}",
        **{find_figure(name).heading: report.format_figure(row, name) for name in MAIN_FIGURES},
        **{heading: format_difference(row, name) for name, (heading, _, _) in DIFFERENCES.items()},
    }


def list_rows(result: Mapping[str, Any]) -> list[Row]:
    """Return the rows of agents that drove."""
    return [row for row in result["rows"] if not row["refused"]]


def list_refusals(result: Mapping[str, Any]) -> list[str]:
    """Return why agents couldn't drive somewhere, each reason once."""
    return list(dict.fromkeys(row["refused"] for row in result["rows"] if row["refused"]))


def result_table(result: Mapping[str, Any]) -> Table:
    """Format the result as a table."""
    return report.make_table("Benchmark", [*map(main_cells, list_rows(result))], TEXT_COLUMNS)


def write_csv(path: Path, result: Mapping[str, Any]) -> None:
    """Write a line for each row that drove, with a column for each end of an interval."""
    # Lists and dicts have columns of their own, and agents that were refused have no line.
    lines = []
    for row in list_rows(result):
        line = {name: value for name, value in row.items() if not isinstance(value, list | dict)}
        line.pop("refused")
        line["robot"] = result["header"]["scenes"][f"{row['id']} {row['scenes']}"]["robot"]
        line["training_seeds"] = len(row["training_seeds"])
        for name, interval in row["intervals"].items():
            line |= zip((f"{name}_low", f"{name}_high"), interval, strict=True)

        # A row without another baseline at its place has no differences.
        for name, difference in row["differences"].items():
            if difference is not None:
                columns = [f"{name}_difference{end}" for end in ("", "_low", "_high")]
                numbers = (difference["difference"], *difference["interval"])
                line |= zip(columns, numbers, strict=True)
                line[f"{name}_over"] = difference["over"]
        lines.append(line)

    # Tasks have numbers of their own, so rows may have different columns.
    stream = io.StringIO()
    names = dict.fromkeys(name for line in lines for name in line)
    writer = csv.DictWriter(stream, list(names), lineterminator="\n")
    if lines:  # an empty file may be replaced, one with an empty line not
        writer.writeheader()
    writer.writerows(lines)
    reading.write_atomically(path, stream.getvalue().encode())


def write_latex(path: Path, result: Mapping[str, Any]) -> None:
    """Write the main table for LaTeX with the package booktabs."""
    # Texts are aligned left, numbers right.
    table = report.fill_cells([*map(main_cells, list_rows(result))])
    align = "".join("l" if name in TEXT_COLUMNS else "r" for name in table.columns)
    header, *body = (
        f"{' & '.join(map(_escape_latex, cells))} \\\\" for cells in (table.columns, *table.rows)
    )
    lines = [f"% {reading.describe_origin()}", f"\\begin{{tabular}}{{{align}}}", "\\toprule"]
    lines += [header, "\\midrule", *body, "\\bottomrule", "\\end{tabular}", ""]
    reading.write_atomically(path, "\n".join(lines).encode())


def _escape_latex(text: str) -> str:
    for character in "&%$#_{}":
        text = text.replace(character, f"\\{character}")
    return text


CSV_MARK = "agent,kind,"
"""How the files of `write_csv` start."""
FIGURE_MARKS = {".svg": "matplotlib.org", ".pdf": "%PDF-1.4"}
"""Words near the start of the files of `write_figure`, by the end of the name."""


def check_figure(figure: Path | None, html: Path | None) -> None:
    """Check before a long run that a figure, in a file or in a page, can be drawn."""
    if figure is not None or html is not None:
        check_extra("a figure", "plot", "matplotlib")
    if figure is not None and figure.suffix not in FIGURE_MARKS:
        raise ConfigError(f"--figure {figure}: must end in .svg or .pdf")


def draw_figure(rows: Sequence[Row], kind: str) -> bytes:
    """Draw mean scores with their intervals, and a point for each training seed.

    Args:
        rows: Rows of agents that drove.
        kind: "svg" or "pdf".
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - optional, slow
    from matplotlib.figure import Figure  # noqa: PLC0415

    # Without pyplot, which keeps figures and may look for a display.
    drawing = Figure(figsize=(8.0, 1.0 + 0.3 * len(rows)), layout="constrained")
    FigureCanvasAgg(drawing)
    axis = drawing.subplots()
    for place, row in enumerate(rows):
        ends = [row["score"] if end is None else end for end in row["intervals"]["score"]]
        seeds = row["seed_scores"]
        axis.plot(ends, [place, place], "|-", color="C0")
        axis.plot([row["score"]], [place], "o", color="C0")  # None isn't drawn
        axis.plot(seeds, [place] * len(seeds), ".", color="C1", zorder=3, markersize=4.0)

    # The best agent of a place is at its top.
    labels = [", ".join(filter(None, [*main_cells(row).values()][:4])) for row in rows]
    axis.set_yticks(range(len(rows)), labels)
    axis.set(ylim=(max(len(rows), 1) - 0.5, -0.5), xlim=(0.0, None))
    axis.set_xlabel("score, 95 % interval, seeds")
    axis.grid(axis="x")
    stream = io.BytesIO()
    drawing.savefig(stream, format=kind, metadata={})
    return stream.getvalue()


def write_figure(path: Path, result: Mapping[str, Any]) -> None:
    """Write the figure as SVG or PDF, by the end of its name."""
    reading.write_atomically(path, draw_figure(list_rows(result), path.suffix[1:]))


def write_benchmark_page(path: Path, result: Mapping[str, Any]) -> None:
    """Write the result as an HTML page, see `page.write_page`."""
    page.check_report_extra()

    # The main table, below what its columns mean, and the figure.
    rows = list_rows(result)
    introduction = "\n".join([INTRODUCTION, *list_refusals(result)])
    drawing = draw_figure(rows, "svg").decode()
    table = report.fill_cells([*map(main_cells, rows)])
    sections = [page.Section("Scores and success", introduction, table, [drawing])]

    # All figures, of agents that drove at the same place next to each other.
    for heading, place in groupby(rows, _name_place):
        figures = report.list_lines({row["agent"]: report.figure_cells(row) for row in place})
        sections.append(page.Section(heading, table=report.fill_cells(figures)))

    # What is needed to repeat it.
    header = result["header"]
    facts = [*header["versions"].items()]
    facts += [(name, describe_scenes(about)) for name, about in header["scenes"].items()]
    for name, policies in header["agents"].items():
        for policy in policies:
            title = f"{name} on {policy['id']}, {policy['file']}"
            facts.append((title, f"sha256 {policy['sha256']}"))
    sections.append(page.Section("Provenance", "", page.Table(("what", "version"), facts)))
    page.write_page(path, "Benchmark", sections)


def _name_place(row: Row) -> str:
    link = LINK_NAMES[row["link"]]
    return f"All figures: {row['id']} {row['scenes']}, {link}, {row['condition']}"


def describe_scenes(about: Mapping[str, Any]) -> str:
    """Describe a set of scenes in a line."""
    kind = "seeds" if about["kind"] == "seeds" else f"worlds of {about['kind']}"
    last = about["first"] + about["count"] - 1
    return (
        f"Robot {about['robot']}, score {about['score']}, {about['count']} {kind}, "
        f"{about['first']} to {last}, version {about['version']}, sha256 {about['sha256']}"
    )
