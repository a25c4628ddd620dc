"""The HTML report of a benchmark, from the content of `benchmark.json`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from acsar_gym.tools.benchmark.plan import NOMINAL
from acsar_gym.tools.benchmark.table import (
    LINK_NAMES,
    PLACE,
    Told,
    agent_columns,
    best_pairs,
    describe_scenes,
    improvements_of_best,
)
from acsar_gym.tools.evaluation.page import (
    Grid,
    PageSection,
    Plot,
    PlotTrace,
    ReportPage,
    Tile,
    line_trace,
    make_axis,
)

INTRODUCTION = (
    "Every agent drives the same scenes with the same seeds. Intervals have 95 %: Wilson's for "
    "success, the stratified bootstrap over training seeds and scenes for scores, as Agarwal et "
    "al. 2021 define it. The mean score counts every failure, the interquartile mean (IQM) leaves "
    "out the worst and the best quarter. Differences are those to the best baseline, in pairs of "
    "episodes: intervals by the paired bootstrap, p of success by McNemar's exact test."
)
SCORE_TEXT = (
    "A failure scores 0. A success scores, as a set of scenes says: completion_time, the time of "
    "the shortest path at the robot's top speed over the time that it took; cross_track, 1 - mean "
    "cross-track error / 10 cm; barn_score, that of BARN's contest, at most 0.5; barn_score_own, "
    "the same with the robot's own top speed; or what the task tells under another name. "
    "Clearance, jerk and drift are means over episodes, time and energy over successful ones."
)
AGENT_COLORS = (
    *("#1f77d0", "#e0730d", "#2a9d5c", "#d1495b", "#8e63ce", "#8c6d4f", "#d965b0", "#7f8c8d"),
    *("#a0a52a", "#17a2b8", "#5b6ee1", "#c0392b"),
)
"""Legible on a light and on a dark page."""
LINK_SYMBOLS = {"planar": "circle-open", "bullet": "circle", "mujoco": "diamond", "port": "square"}
DOT_MARGIN = {"l": 56, "r": 16, "t": 8, "b": 48}
SHARE_AXIS: Mapping[str, Any] = {"range": [-0.02, 1.02]}


def benchmark_page(results: Told) -> ReportPage:
    """Make the report of `benchmark.json`."""
    rows = [row for row in results["rows"] if not row["refused"]]
    names = list(dict.fromkeys(row["agent"] for row in rows))
    colors = {name: AGENT_COLORS[n % len(AGENT_COLORS)] for n, name in enumerate(names)}
    tiles = {}  # of the best learned agent in each set, behind the last of the links
    for best in best_pairs(results):
        if best["figure"] == "score":
            label = f"{best['scenes']}, score, {best['agent']} : {best['over']}"
            value = " : ".join(f"{one:.3f}" for one in best["values"])
            tiles[best["id"], best["scenes"]] = Tile(label, value)
    refused = dict.fromkeys(
        f"{row['agent']} doesn't drive {row['id']} ({row['scenes']})"
        for row in results["rows"]
        if row["refused"]
    )
    sections = [*_places(results, rows, colors)]
    if some := improvements_of_best(results):
        text = (
            "Probability that a run of the first agent scores more than one of the second in the "
            "same scene; equal scores count half. Right of the line the first agent is better."
        )
        sections.append(PageSection("Probability of improvement", text, _improvements(some)))
    if plots := [*_robustness(rows, results["header"]["conditions"], colors)]:
        text = "Success of each agent under conditions that differ from the nominal ones."
        sections.append(PageSection("Robustness", text, plots))
    return ReportPage(
        title="Benchmark",
        subtitle=f"{len(colors)} agents, {sum(row['episodes'] for row in rows):,} episodes",
        said=[INTRODUCTION, SCORE_TEXT, *([f"{'; '.join(refused)}."] if refused else [])],
        tiles=list(tiles.values()),
        sections=[*sections, PageSection("Provenance", "", _provenance(results["header"]))],
    )


def _places(
    results: Told, rows: Sequence[Told], colors: Mapping[str, str]
) -> Iterator[PageSection]:
    """Make a section for each id and set of scenes: table, scores and performance profile."""
    nominal = [row for row in rows if row["condition"] == NOMINAL]
    for env_id, scenes in dict.fromkeys((row["id"], row["scenes"]) for row in nominal):
        own = [row for row in nominal if (row["id"], row["scenes"]) == (env_id, scenes)]
        own.sort(key=lambda row: (list(LINK_NAMES).index(row["link"]), -row["score"]))
        columns = {}
        for name, cells in agent_columns(own, results["paired"]).items():
            cut = [cell.partition(", worst seed ") for cell in cells]
            columns[name] = [cell for cell, _, _ in cut]
            if any(seed for _, _, seed in cut):
                columns["worst seed"] = [seed or "-" for _, _, seed in cut]
        last = [row for row in own if row["link"] == own[-1]["link"]]
        profiles = [
            line_trace(
                row["agent"],
                results["taus"],
                row["profile"],
                colors[row["agent"]],
                width=_line_width(row),
            )
            for row in last
        ]
        layout = {
            "xaxis": make_axis("score", range=[0.0, 1.0]),
            "yaxis": make_axis("share of runs", **SHARE_AXIS),
            "hovermode": "x unified",
            **_legend(-0.18),
        }
        caption = (
            f"Performance profiles, {LINK_NAMES[last[0]['link']]}: share of runs whose score is "
            "above a threshold"
        )
        parts: list[Grid | Plot] = [
            Grid(list(columns), [*zip(*columns.values(), strict=True)], 2),
            _scores(own, colors),
            Plot(caption, [profiles], layout, 440),
        ]
        about = describe_scenes(results["header"]["scenes"][env_id][scenes])
        yield PageSection(f"{env_id}, {scenes}", f"{about}.", parts)


def _legend(y: float) -> dict[str, Any]:
    legend = {"orientation": "h", "y": y, "x": 0, "font": {"size": 12}}
    return {"showlegend": True, "legend": legend}


def _line_width(row: Told) -> float:
    """Draw learned agents thicker than baselines."""
    return 3.2 if row["kind"] == "learned" else 1.5


def _scores(rows: Sequence[Told], colors: Mapping[str, str]) -> Plot:
    """Plot the mean score with its interval, an agent a row."""
    names = list(dict.fromkeys(row["agent"] for row in rows))
    traces = []
    for link in dict.fromkeys(row["link"] for row in rows):
        own = [row for row in rows if row["link"] == link]
        marker = {
            "color": [colors[row["agent"]] for row in own],
            "symbol": LINK_SYMBOLS[link],
            "size": 10,
            "line": {"width": 2},
        }
        ends = [row["intervals"]["score"] for row in own]
        values, labels = [row["score"] for row in own], [row["agent"] for row in own]
        traces.append(_interval_dots(LINK_NAMES[link], values, ends, labels, marker))
    layout = {
        "xaxis": make_axis("score", **SHARE_AXIS),
        "yaxis": make_axis("", categoryorder="array", categoryarray=names[::-1]),
        "scattermode": "group",
        "scattergap": 0.5,
        **(_legend(-0.18) if len(traces) > 1 else {}),
        "margin": DOT_MARGIN,
    }
    caption = "Mean score, 95 % intervals"
    return Plot(caption, [traces], layout, 110 + 26 * len(names))


def _interval_dots(
    name: str,
    values: Sequence[float],
    ends: Sequence[Sequence[float]],
    labels: Sequence[str],
    marker: Mapping[str, Any],
) -> PlotTrace:
    """Make dots with intervals, each in the row of its label."""
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "orientation": "h",
        "offsetgroup": name,
        "x": list(values),
        "y": list(labels),
        "marker": marker,
        "error_x": {
            "type": "data",
            "symmetric": False,
            "array": [high - value for value, (_, high) in zip(values, ends, strict=True)],
            "arrayminus": [value - low for value, (low, _) in zip(values, ends, strict=True)],
            "color": "--muted",
            "thickness": 1.4,
            "width": 4,
        },
    }


def _improvements(some: Sequence[Told]) -> list[Plot]:
    """Plot the probability of improvement with its interval; a plot for each id and link."""
    plots = []
    for place in dict.fromkeys((each["id"], each["scenes"], each["link"]) for each in some):
        own = [each for each in some if (each["id"], each["scenes"], each["link"]) == place]
        labels = [f"{each['agent']} over {each['over']}" for each in own]
        values = [each["probability"] for each in own]
        marker = {"color": ["--accent" if v >= 0.5 else "--first" for v in values], "size": 9}
        half = {"type": "line", "x0": 0.5, "x1": 0.5, "y0": 0, "y1": 1, "yref": "paper"}
        layout = {
            "xaxis": make_axis("probability of improvement", **SHARE_AXIS),
            "yaxis": make_axis("", categoryorder="array", categoryarray=labels[::-1]),
            "shapes": [half | {"line": {"color": "--muted", "dash": "dot", "width": 1.5}}],
            "margin": DOT_MARGIN,
        }
        trace = _interval_dots("", values, [each["interval"] for each in own], labels, marker)
        caption = f"{place[0]}, {place[1]}, {LINK_NAMES[place[2]]}"
        plots.append(Plot(caption, [[trace]], layout, 90 + 26 * len(own)))
    return plots


def _robustness(
    rows: Sequence[Told], conditions: Told, colors: Mapping[str, str]
) -> Iterator[Plot]:
    """Plot success by condition, a line for each agent; what a condition is shows beside it."""
    for place in dict.fromkeys(
        tuple(row[name] for name in PLACE) for row in rows if row["condition"] != NOMINAL
    ):
        some = [row for row in rows if tuple(row[name] for name in PLACE) == place]
        order = [name for name in conditions if any(row["condition"] == name for row in some)]
        traces = []
        for name in dict.fromkeys(row["agent"] for row in some):
            own = {row["condition"]: row for row in some if row["agent"] == name}
            found = [condition for condition in order if condition in own]
            places = [order.index(condition) for condition in found]
            rates = [100.0 * own[condition]["success_rate"] for condition in found]
            traces.append(
                line_trace(
                    name,
                    places,
                    rates,
                    colors[name],
                    width=_line_width(own[found[0]]),
                    mode="lines+markers",
                    marker={"size": 9},
                    text=[conditions[condition]["words"] for condition in found],
                    hovertemplate="%{y:.1f} %, %{text}",
                )
            )
        ticks = {"tickvals": list(range(len(order))), "ticktext": order, "tickangle": -30}
        layout = {
            "xaxis": make_axis("", **ticks),
            "yaxis": make_axis("success [%]", range=[-2.0, 102.0]),
            **_legend(1.12),
        }
        caption = f"{place[0]}, {place[1]}, {LINK_NAMES[place[2]]}"
        yield Plot(caption, [traces], layout, 440)


def _provenance(header: Told) -> list[Grid]:
    """Make the tables of versions and scenes, and of the learned policies' files."""
    versions = [[name, version] for name, version in header["versions"].items()]
    for env_id, sets in header["scenes"].items():
        versions += [
            [f"{env_id} {name}", f"sha256 {about['sha256']}"] for name, about in sets.items()
        ]
    policies = [
        [
            *(name, each["id"]),
            "-" if each["training_seed"] is None else str(each["training_seed"]),
            *(each["file"], each["sha256"] or "-"),
        ]
        for name, agent in header["agents"].items()
        for each in agent["policies"]
        if agent["kind"] == "learned"
    ]
    columns = ["agent", "id", "training seed", "file", "sha256"]
    return [Grid(["what", "version"], versions, 2), Grid(columns, policies, 5)]
