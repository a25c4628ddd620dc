"""The table of a benchmark in the terminal, and its HTML page, from the content of its JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from acsar_gym.physics.bodies import BODIES
from acsar_gym.tools import page
from acsar_gym.tools.benchmark.figures import COMPARED_FIGURES, PLACE
from acsar_gym.tools.benchmark.plan import NOMINAL
from acsar_gym.tools.evaluation.report import escape_text, fill_columns

Row = Mapping[str, Any]
LINK_NAMES = {name: body.title for name, body in BODIES.items()} | {
    "port": "emulated port",
    "ros2": "ROS 2",
}
INTRODUCTION = (
    "Every agent drives the same scenes with the same seeds. Intervals have 95 %: Wilson's for "
    "success, the stratified bootstrap over training seeds and scenes for scores, as Agarwal et "
    "al. 2021 define it. The mean score counts every failure, the interquartile mean (IQM) leaves "
    "out the worst and the best quarter. Differences are those to the best baseline, in pairs of "
    "episodes: intervals by the paired bootstrap, p of success by McNemar's exact test. Clearance, "
    "jerk and drift are means over episodes, time and energy over successful ones. Into people are "
    "the episodes that ended because the robot ran into somebody, struck those in which somebody "
    "ran into the robot."
)


def _format_number(key: str, digits: int, factor: float = 1.0) -> Callable[[Row], str]:
    """Format a figure; empty where there is none."""

    def text(row: Row) -> str:
        value = row.get(key, row["told"].get(key))
        return "" if value is None else f"{value * factor:.{digits}f}"

    return text


def _format_rate(key: str) -> Callable[[Row], str]:
    """Format a share of the episodes; empty where there is none."""

    def text(row: Row) -> str:
        return f"{row[key]:.1%}" if row[key] else ""

    return text


def _format_success(row: Row) -> str:
    """Success rate with its interval [%], and that of the worst seed where there are some."""
    low, high = row["success_interval"]
    text = f"{row['success_rate']:.1%} ({100 * low:.1f} to {100 * high:.1f})"
    if len(row["training_seeds"]) > 1:
        text += f", worst seed {row['success_worst_seed']:.1%}"
    return text


def _format_score(figure: str) -> Callable[[Row], str]:
    """Format a score with its interval."""

    def text(row: Row) -> str:
        low, high = row["intervals"][figure]
        return f"{row[figure]:.3f} ({low:.3f} to {high:.3f})"

    return text


def _format_difference(figure: str) -> Callable[[Row], str]:
    """A paired difference, such as "+0.021 (+0.004 to +0.038) over dwa, p 0.012"."""

    def text(row: Row) -> str:
        pair = row["pairs"].get(figure)
        if pair is None:
            return ""
        factor, digits, unit = (100.0, 1, " points") if figure == "success" else (1.0, 3, "")
        low, high = (f"{factor * end:+.{digits}f}" for end in pair["interval"])
        p = "p < 0.001" if pair["p"] < 0.001 else f"p {pair['p']:.3f}"
        value = f"{factor * pair['difference']:+.{digits}f}{unit}"
        return f"{value} ({low} to {high}) over {pair['over']}, {p}"

    return text


MAIN_COLUMNS: dict[str, Callable[[Row], str]] = {
    "agent": lambda row: (
        f"{row['agent']} (knows all)" if row["kind"] == "privileged" else row["agent"]
    ),
    "link": lambda row: LINK_NAMES[row["link"]],
    "condition": lambda row: "" if row["condition"] == NOMINAL else row["condition"],
    "episodes": lambda row: str(row["episodes"]),
    "score": _format_score("score"),
    "success": _format_success,
    "into people": _format_rate("person_collision_rate"),
    "struck": _format_rate("struck_rate"),
    "score difference": _format_difference("score"),
    "success difference": _format_difference("success"),
}
"""Cells of the table in the terminal; empty text means no value, and columns without any are left
out."""
PAGE_COLUMNS: dict[str, Callable[[Row], str]] = {
    **MAIN_COLUMNS,
    "seeds": lambda row: str(len(row["training_seeds"])) if row["kind"] == "learned" else "",
    "score IQM": _format_score("score_iqm"),
    "SPL": _format_number("spl", 3),
    "BARN score, own speed": _format_number("barn_score_own", 3),
    "BARN score, 2 m/s": _format_number("barn_score", 3),
    "cross-track [cm]": _format_number("cross_track", 2, 100.0),
    "time [s]": _format_number("time_to_goal", 2),
    "clearance [cm]": _format_number("clearance", 1, 100.0),
    "closest person [cm]": _format_number("closest_person", 1, 100.0),
    "time to collision [s]": _format_number("time_to_collision", 2),
    "intrusions [1/min]": _format_number("intrusion_rate", 2),
    "turning [rad/m]": _format_number("smoothness", 2),
    "jerk [m/s³]": _format_number("jerk", 2),
    "energy [J]": _format_number("energy", 2),
    "drift [%]": _format_number("odometry_drift", 2, 100.0),
}
"""Cells of the page's tables."""


def group_rows(result: Mapping[str, Any]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Return the rows that drove by id and set, the best score of a link and condition first.

    Each has its comparisons with the best baselines under "pairs", by figure.
    """
    pairs = {
        tuple(pair[name] for name in (*PLACE, "agent", "figure")): pair for pair in result["paired"]
    }
    conditions = list(result["header"]["conditions"])
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in result["rows"]:
        if not row["refused"]:
            key = tuple(row[name] for name in (*PLACE, "agent"))
            compared = {f: pairs[*key, f] for f in COMPARED_FIGURES if (*key, f) in pairs}
            groups.setdefault((row["id"], row["scenes"]), []).append({**row, "pairs": compared})
    for group in groups.values():
        group.sort(
            key=lambda row: (
                list(LINK_NAMES).index(row["link"]),
                conditions.index(row["condition"]),
                -row["score"],
            )
        )
    return groups


def list_refusals(result: Mapping[str, Any]) -> list[str]:
    """Why agents couldn't drive somewhere, each reason once."""
    return list(dict.fromkeys(row["refused"] for row in result["rows"] if row["refused"]))


def result_table(result: Mapping[str, Any]) -> Table:
    """Format the result as a table."""
    table = Table(title="Benchmark", title_justify="left")
    groups = group_rows(result)
    cells = fill_columns([row for group in groups.values() for row in group], MAIN_COLUMNS)
    names = [f"{env_id} {scenes}" for (env_id, scenes), group in groups.items() for _ in group]
    for name in ("scenes", *cells):
        is_text = name in ("scenes", "agent", "link", "condition")
        table.add_column(name, justify="left" if is_text else "right")
    for row in zip(names, *cells.values(), strict=True):
        table.add_row(*map(escape_text, row))
    return table


def write_benchmark_page(path: Path, result: Mapping[str, Any]) -> None:
    """Write the result as an HTML page; see `page.write_page`."""
    page.check_report_extra()
    header, groups = result["header"], group_rows(result)
    refused = list_refusals(result)
    sections = [page.Section("How to read it", "\n".join([INTRODUCTION, *refused]))]
    for (env_id, scenes), rows in groups.items():
        columns = fill_columns(rows, PAGE_COLUMNS)
        sections.append(
            page.Section(
                f"{env_id}, {scenes}",
                describe_scenes(header["scenes"][env_id][scenes]),
                page.Table(list(columns), [*zip(*columns.values(), strict=True)]),
                [_draw_scores([row for row in rows if row["condition"] == NOMINAL])],
            )
        )
    provenance = [[name, version] for name, version in header["versions"].items()]
    provenance += [
        [f"{env_id} {name}", f"sha256 {about['sha256']}"]
        for env_id, sets in header["scenes"].items()
        for name, about in sets.items()
    ]
    provenance += [
        [f"{name} on {policy['id']}, {policy['file']}", f"sha256 {policy['sha256']}"]
        for name, policies in header["agents"].items()
        for policy in policies
        if policy["sha256"]
    ]
    sections.append(page.Section("Provenance", "", page.Table(("what", "version"), provenance)))
    page.write_page(path, "Benchmark", sections)


def describe_scenes(about: Mapping[str, Any]) -> str:
    """Describe a set of scenes in a line."""
    kind = "seeds" if about["kind"] == "seeds" else f"worlds of {about['kind']}"
    last = about["first"] + about["count"] - 1
    return (
        f"Robot {about['robot']}, score {about['score']}, {about['count']} {kind}, "
        f"{about['first']} to {last}, version {about['version']}, sha256 {about['sha256'][:16]}."
    )


def _draw_scores(rows: Sequence[Row]) -> Any:
    """Plot the mean scores with their intervals, an agent a row."""
    from plotly import graph_objects  # noqa: PLC0415 - optional

    figure = graph_objects.Figure(
        layout={
            "xaxis": {"title": "score, 95 % intervals", "rangemode": "tozero"},
            "yaxis": {"autorange": "reversed"},
            "template": "plotly_white",
        }
    )
    for link in dict.fromkeys(row["link"] for row in rows):
        behind = [row for row in rows if row["link"] == link]
        ends = [row["intervals"]["score"] for row in behind]
        figure.add_scatter(
            x=[row["score"] for row in behind],
            y=[row["agent"] for row in behind],
            mode="markers",
            name=LINK_NAMES[link],
            error_x={
                "type": "data",
                "symmetric": False,
                "array": [high - row["score"] for row, (_, high) in zip(behind, ends, strict=True)],
                "arrayminus": [
                    row["score"] - low for row, (low, _) in zip(behind, ends, strict=True)
                ],
            },
        )
    return figure
