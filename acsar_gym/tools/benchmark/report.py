"""The table of a benchmark: in the terminal, as CSV, LaTeX, a figure and an HTML page."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.table import Table

from acsar_gym import reading
from acsar_gym.errors import ConfigError, check_extra
from acsar_gym.physics.bodies import BODIES
from acsar_gym.tools import page
from acsar_gym.tools.benchmark.plan import NOMINAL, ROS2
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.evaluation.metrics import FIGURES, TOLD_PREFIX, Figure

Row = Mapping[str, Any]
LINK_NAMES = {name: body.title for name, body in BODIES.items()} | {ROS2: "ROS 2"}
SCORES = {
    "score": Figure(lambda e: e.score, "score", digits=3),
    "score_iqm": Figure(lambda e: e.score, "score IQM", digits=3),
}
TABLE_FIGURES = SCORES | FIGURES
"""All figures of a row."""
TEXT_COLUMNS = ("scenes", "agent", "link", "condition")
INTRODUCTION = (
    "Every agent drives the same scenes with the same seeds. Intervals have 95 %: Wilson's for "
    "rates, the bootstrap over training seeds and scenes for means (Agarwal et al. 2021). The mean "
    "score counts every failure as 0; the interquartile mean (IQM) leaves out the worst and the "
    "best quarter. Differences are those to the best baseline, in pairs of episodes, in units of "
    "the score and in points of the success rate. Time, path and energy are means over successful "
    f"episodes. {report.PEOPLE_NOTE}"
)


def format_value(row: Row, name: str) -> str:
    """Format a figure with its interval, such as "0.885 (0.861 to 0.907)"; empty for none."""
    value = row.get(name)
    if value is None:
        return ""
    figure = TABLE_FIGURES.get(name, Figure(lambda _: math.nan, name))
    text = figure.format(value)
    ends = row["intervals"][name]
    if None in ends:  # of fewer than two episodes
        return text
    return f"{text} ({figure.format(ends[0])} to {figure.format(ends[1])})"


def format_difference(row: Row, name: str) -> str:
    """Format a paired difference, such as "+0.021 (+0.004 to +0.038) over dwa"."""
    difference = row["differences"][name]
    if difference is None:
        return ""
    factor, digits = (100.0, 1) if name == "success" else (1.0, 3)
    numbers = (difference["difference"], *difference["interval"])
    value, low, high = ("?" if n is None else f"{n * factor:+.{digits}f}" for n in numbers)
    return f"{value} ({low} to {high}) over {difference['over']}"


def main_cells(row: Row) -> dict[str, str]:
    """Return the cells of a row in the main table."""
    seeds = len(row["training_seeds"])
    people = row["person_collision_rate"]

    return {
        "agent": f"{row['agent']} (privileged)" if row["kind"] == "privileged" else row["agent"],
        "link": LINK_NAMES[row["link"]],
        "condition": "" if row["condition"] == NOMINAL else row["condition"],
        "seeds": f"{seeds}" if seeds > 1 else "",
        "episodes": f"{row['episodes']}",
        "score": format_value(row, "score"),
        "success [%]": format_value(row, "success_rate"),
        "worst seed [%]": f"{100.0 * min(row['seed_success']):.1f}" if seeds > 1 else "",
        "ran into people [%]": FIGURES["person_collision_rate"].format(people) if people else "",
        "score difference": format_difference(row, "score"),
        "success difference [points]": format_difference(row, "success"),
    }


def group_rows(result: Mapping[str, Any]) -> dict[str, list[Row]]:
    """Return the rows that drove by id and set, the best score of a link and condition first."""
    conditions = list(result["header"]["conditions"])
    groups: dict[str, list[Row]] = {name: [] for name in result["header"]["scenes"]}
    for row in result["rows"]:
        if not row["refused"]:
            groups[f"{row['id']} {row['scenes']}"].append(row)
    for group in groups.values():
        group.sort(
            key=lambda row: (
                list(LINK_NAMES).index(row["link"]),
                conditions.index(row["condition"]),
                -row["score"],
            )
        )
    return {name: group for name, group in groups.items() if group}


def list_refusals(result: Mapping[str, Any]) -> list[str]:
    """Return why agents couldn't drive somewhere, each reason once."""
    return list(dict.fromkeys(row["refused"] for row in result["rows"] if row["refused"]))


def result_table(result: Mapping[str, Any]) -> Table:
    """Format the result as a table."""
    cells = [
        {"scenes": name, **main_cells(row)}
        for name, rows in group_rows(result).items()
        for row in rows
    ]
    return report.make_table("Benchmark", cells, TEXT_COLUMNS)


def write_csv(path: Path, result: Mapping[str, Any]) -> None:
    """Write a line for each row that drove, with a column for each end of an interval."""
    lines = []
    for rows in group_rows(result).values():
        for row in rows:
            line = {name: row[name] for name in ("id", "scenes", "link", "condition")}
            about = result["header"]["scenes"][f"{row['id']} {row['scenes']}"]
            line |= {"robot": about["robot"], "agent": row["agent"], "kind": row["kind"]}
            line |= {"training_seeds": len(row["training_seeds"]), "episodes": row["episodes"]}
            for name, interval in row["intervals"].items():
                line[name] = row[name]
                line[f"{name}_low"], line[f"{name}_high"] = interval
            for name, difference in row["differences"].items():
                if difference is not None:
                    line[f"{name}_difference"] = difference["difference"]
                    line[f"{name}_difference_low"] = difference["interval"][0]
                    line[f"{name}_difference_high"] = difference["interval"][1]
                    line[f"{name}_over"] = difference["over"]
            lines.append(line)

    stream = io.StringIO()
    names = dict.fromkeys(name for line in lines for name in line)
    writer = csv.DictWriter(stream, list(names), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    reading.write_atomically(path, stream.getvalue().encode())


def write_latex(path: Path, result: Mapping[str, Any]) -> None:
    """Write the main table for LaTeX with the package booktabs."""
    rows = []
    for name, group in group_rows(result).items():
        rows += [{"scenes": name, **main_cells(row)} for row in group]
    names = [name for name in rows[0] if any(row[name] for row in rows)] if rows else []
    align = "".join("l" if name in TEXT_COLUMNS else "r" for name in names)
    body = [" & ".join(map(_escape_latex, (row[name] for name in names))) for row in rows]
    header = " & ".join(map(_escape_latex, names))
    lines = [f"% {reading.describe_origin()}", f"\\begin{{tabular}}{{{align}}}", "\\toprule"]
    lines += [f"{header} \\\\", "\\midrule", *(f"{line} \\\\" for line in body)]
    lines += ["\\bottomrule", "\\end{tabular}", ""]
    reading.write_atomically(path, "\n".join(lines).encode())


def _escape_latex(text: str) -> str:
    for character in "&%$#_{}":
        text = text.replace(character, f"\\{character}")
    return text


def check_figure(figure: Path | None, html: Path | None) -> None:
    """Check before a long run that a figure, of its own or in a page, can be drawn."""
    if figure is not None or html is not None:
        check_extra("a figure", "plot", "matplotlib")
    if figure is not None and figure.suffix not in (".svg", ".pdf"):
        raise ConfigError(f"--figure {figure}: must end in .svg or .pdf")


def draw_figure(groups: Mapping[str, Sequence[Row]], kind: str) -> bytes:
    """Draw mean scores with their intervals, and a point for each training seed.

    Args:
        groups: Rows by id and set, a plot for each.
        kind: "svg" or "pdf".
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415 - optional, slow
    from matplotlib.figure import Figure as Drawing  # noqa: PLC0415

    heights = [len(rows) + 2.0 for rows in groups.values()]
    drawing = Drawing(figsize=(7.0, 0.3 * sum(heights)), layout="constrained")
    FigureCanvasAgg(drawing)
    axes = drawing.subplots(len(groups), squeeze=False, height_ratios=heights)[:, 0]
    for axis, (name, rows) in zip(axes, groups.items(), strict=True):
        for place, row in enumerate(rows):
            seeds = row["seed_scores"]
            low, high = row["intervals"]["score"]
            ends = [[row["score"] - low], [high - row["score"]]] if low is not None else None
            axis.errorbar(row["score"], place, xerr=ends, fmt="o", color="C0", capsize=2.0)
            axis.plot(seeds, [place] * len(seeds), ".", color="C1", zorder=3, markersize=4.0)
        axis.set_yticks(range(len(rows)), [_label(row) for row in rows])
        axis.set(title=name, ylim=(len(rows) - 0.5, -0.5), xlim=(0.0, None))
        axis.grid(axis="x")
    axes[-1].set_xlabel("score: mean, 95 % interval, and each training seed")
    stream = io.BytesIO()
    drawing.savefig(stream, format=kind, metadata={})
    return stream.getvalue()


def write_figure(path: Path, result: Mapping[str, Any]) -> None:
    """Write the figure as SVG or PDF, by the end of its name."""
    reading.write_atomically(path, draw_figure(group_rows(result), path.suffix[1:]))


def _label(row: Row) -> str:
    condition = "" if row["condition"] == NOMINAL else f", {row['condition']}"
    return f"{row['agent']}, {LINK_NAMES[row['link']]}{condition}"


def write_benchmark_page(path: Path, result: Mapping[str, Any]) -> None:
    """Write the result as an HTML page; see `page.write_page`."""
    page.check_report_extra()
    header = result["header"]
    refused = list_refusals(result)
    sections = [page.Section("How to read it", "\n".join([INTRODUCTION, *refused]))]

    for name, rows in group_rows(result).items():
        cells = [main_cells(row) for row in rows]
        shown = [column for column in cells[0] if any(row[column] for row in cells)]
        table = page.Table(shown, [[row[column] or "-" for column in shown] for row in cells])
        drawing = draw_figure({name: rows}, "svg").decode()
        about = describe_scenes(header["scenes"][name])
        sections.append(page.Section(name, about, table, [drawing]))
        for (link, condition), group in groupby(rows, lambda row: (row["link"], row["condition"])):
            heading = f"{name}: all figures, {LINK_NAMES[link]}, {condition}"
            sections.append(page.Section(heading, table=_figure_table([*group])))
    sections.append(page.Section("Provenance", "", _provenance_table(header)))
    page.write_page(path, "Benchmark", sections)


def _figure_table(rows: Sequence[Row]) -> page.Table:
    """Make a table of all figures of agents at one place, a figure a line."""
    names = dict.fromkeys(name for row in rows for name in row["intervals"])
    lines = []
    for name in names:
        figure = TABLE_FIGURES.get(name)
        heading = figure.heading if figure else name.removeprefix(TOLD_PREFIX)
        lines.append([heading, *(format_value(row, name) or "-" for row in rows)])
    shown = [line for line in lines if any(cell != "-" for cell in line[1:])]
    return page.Table(["figure", *(row["agent"] for row in rows)], shown)


def _provenance_table(header: Mapping[str, Any]) -> page.Table:
    """Make a table of versions and hashes."""
    rows = [[name, version] for name, version in header["versions"].items()]
    rows += [[name, f"sha256 {about['sha256']}"] for name, about in header["scenes"].items()]
    rows += [
        [f"{name} on {policy['id']}, {policy['file']}", f"sha256 {policy['sha256']}"]
        for name, policies in header["agents"].items()
        for policy in policies
    ]
    return page.Table(("what", "version"), rows)


def describe_scenes(about: Mapping[str, Any]) -> str:
    """Describe a set of scenes in a line."""
    kind = "seeds" if about["kind"] == "seeds" else f"worlds of {about['kind']}"
    last = about["first"] + about["count"] - 1
    return (
        f"Robot {about['robot']}, score {about['score']}, {about['count']} {kind}, "
        f"{about['first']} to {last}, version {about['version']}, sha256 {about['sha256'][:16]}."
    )
