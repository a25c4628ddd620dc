"""Plots of a benchmark's rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from acsar_gym.tools.benchmark.table import LINK_NAMES
from acsar_gym.tools.evaluation.page import Plot, dots_trace, line_trace, make_axis

Told = Mapping[str, Any]
PALETTE = (
    *("#1f77d0", "#e0730d", "#2a9d5c", "#d1495b", "#8e63ce", "#8c6d4f", "#d965b0", "#7f8c8d"),
    *("#a0a52a", "#17a2b8", "#5b6ee1", "#c0392b"),
)
"""Colours of agents, legible on a light and on a dark page."""
DASHES = {"planar": "dot", "bullet": "solid", "port": "dash"}
SYMBOLS = {"planar": "circle-open", "bullet": "circle", "port": "square"}
ROW = 26
"""Height of a row of dots [px]."""
LEGEND: Mapping[str, Any] = {
    "showlegend": True,
    "legend": {"orientation": "h", "y": -0.18, "x": 0, "font": {"size": 12}},
}


def colors(rows: Sequence[Told]) -> dict[str, str]:
    """Choose a colour for each agent, in the order of their rows."""
    names = dict.fromkeys(row["agent"] for row in rows)
    return {name: PALETTE[number % len(PALETTE)] for number, name in enumerate(names)}


def scores(rows: Sequence[Told], chosen: Mapping[str, str]) -> Plot:
    """Plot the interquartile mean of the score with its interval, an agent a row."""
    names = list(dict.fromkeys(row["agent"] for row in rows))
    traces = []
    for link in dict.fromkeys(row["link"] for row in rows):
        own = [row for row in rows if row["link"] == link]
        ends = [row["intervals"]["score_iqm"] for row in own]
        values = [row["score_iqm"] for row in own]
        marker = {"color": [chosen[row["agent"]] for row in own], "symbol": SYMBOLS[link]}
        traces.append(
            _bars(LINK_NAMES[link], values, ends, [row["agent"] for row in own])
            | {"marker": marker | {"size": 10, "line": {"width": 2}}}
        )
    return Plot(
        "Interquartile mean of the score, 95 % intervals",
        [traces],
        {
            "xaxis": make_axis("score", range=[-0.02, 1.02]),
            "yaxis": make_axis("", categoryorder="array", categoryarray=names[::-1]),
            "scattermode": "group",
            "scattergap": 0.5,
            **(LEGEND if len(traces) > 1 else {}),
            "margin": {"l": 56, "r": 16, "t": 8, "b": 48},
        },
        110 + ROW * len(names),
    )


def _bars(
    name: str, values: Sequence[float], ends: Sequence[Sequence[float]], labels: Sequence[str]
) -> dict[str, Any]:
    """Make dots with intervals, each in the row of its label."""
    return {
        "type": "scatter",
        "mode": "markers",
        "name": name,
        "orientation": "h",
        "offsetgroup": name,
        "x": list(values),
        "y": list(labels),
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


def profiles(rows: Sequence[Told], results: Told, chosen: Mapping[str, str]) -> Plot:
    """Plot the share of runs whose score is above each threshold, for the last link."""
    link = rows[-1]["link"]
    own = [row for row in rows if row["link"] == link]
    traces = [
        line_trace(
            row["agent"], results["taus"], row["profile"], chosen[row["agent"]], width=_width(row)
        )
        for row in own
    ]
    return Plot(
        f"Performance profiles, {LINK_NAMES[link]}: share of runs whose score is above a threshold",
        [traces],
        {
            "xaxis": make_axis("score", range=[0.0, 1.0]),
            "yaxis": make_axis("share of runs", range=[-0.02, 1.02]),
            "hovermode": "x unified",
            **LEGEND,
        },
        440,
    )


def _width(row: Told) -> float:
    """Draw learned agents thicker than baselines."""
    return 3.2 if row["kind"] == "learned" else 1.5


def improvements(some: Sequence[Told]) -> list[Plot]:
    """Plot the probability of improvement with its interval; a plot for each id and link."""
    places = dict.fromkeys((each["id"], each["scenes"], each["link"]) for each in some)
    return [
        _improvements(
            [each for each in some if (each["id"], each["scenes"], each["link"]) == place]
        )
        for place in places
    ]


def _improvements(own: Sequence[Told]) -> Plot:
    """Plot the comparisons of one id and link."""
    labels = [f"{each['agent']} over {each['over']}" for each in own]
    values = [each["probability"] for each in own]
    marker = {"color": ["--accent" if v >= 0.5 else "--first" for v in values], "size": 9}
    trace = _bars("", values, [each["interval"] for each in own], labels) | {"marker": marker}
    half = {"type": "line", "x0": 0.5, "x1": 0.5, "y0": 0, "y1": 1, "yref": "paper"}
    first = own[0]
    scenes = "" if first["scenes"] == "test" else f", {first['scenes']} scenes"
    return Plot(
        f"{first['id']}{scenes}, {LINK_NAMES[first['link']]}",
        [[trace]],
        {
            "xaxis": make_axis("probability of improvement", range=[-0.02, 1.02]),
            "yaxis": make_axis("", categoryorder="array", categoryarray=labels[::-1]),
            "shapes": [half | {"line": {"color": "--muted", "dash": "dot", "width": 1.5}}],
            "margin": {"l": 56, "r": 16, "t": 8, "b": 48},
        },
        90 + ROW * len(own),
    )


def robustness(rows: Sequence[Told], conditions: Told, chosen: Mapping[str, str]) -> Plot:
    """Plot success by condition, a line for each agent; what a condition is shows beside it."""
    order = [name for name in conditions if _any(rows, name)]
    traces = []
    for name in dict.fromkeys(row["agent"] for row in rows):
        own = {row["condition"]: row for row in rows if row["agent"] == name}
        found = [each for each in order if each in own]
        color, rates = chosen[name], [100.0 * own[each]["success_rate"] for each in found]
        places = [order.index(each) for each in found]
        traces.append(
            dots_trace(name, places, rates, color, mode="lines+markers")
            | {"line": {"color": color, "width": _width(own[found[0]])}}
            | {"text": [conditions[each]["words"] for each in found]}
            | {"hovertemplate": "%{y:.1f} %, %{text}"}
        )
    return Plot(
        f"{rows[0]['id']}, {LINK_NAMES[rows[0]['link']]}",
        [traces],
        {
            "xaxis": make_axis("", tickvals=list(range(len(order))), ticktext=order, tickangle=-30),
            "yaxis": make_axis("success [%]", range=[-2.0, 102.0]),
            "showlegend": True,
            "legend": {"orientation": "h", "y": 1.12, "x": 0, "font": {"size": 12}},
        },
        440,
    )


def _any(rows: Sequence[Told], condition: str) -> bool:
    return any(row["condition"] == condition for row in rows)
