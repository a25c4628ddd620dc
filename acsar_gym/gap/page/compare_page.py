"""The report of `acsar-gym compare`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import acsar_gym
from acsar_gym.evaluation.page.document import Grid, Page, Plot, Section, Tile
from acsar_gym.evaluation.page.traces import MAP, axis, dots, layout, line, shares
from acsar_gym.gap.compare_tables import columns, rows
from acsar_gym.gap.delays import Floats, lag
from acsar_gym.gap.page.wheels import Wheels, wheel_layout, wheel_traces
from acsar_gym.gap.sides import VALUES, Outcome, Sides, conclusion, distances
from acsar_gym.gap.tables import between, cell

COLORS = ("--second", "--first")
"""Of the first and the second side."""
SOFT = ("--second-soft", "--first-soft")
MOST_PAIRS = 20
"""Most pairs whose curves are in the report; the file would become too large."""
MOST_COLUMNS = 12
"""Most numbers of an observation that are drawn; those that differ most."""
BINS = 40
ABREAST = 4
"""Small plots in a row."""
Pair = tuple[Outcome, Outcome]


@dataclass(frozen=True, eq=False)
class Column:
    """One number of the observations or actions: its distance, and its values on both sides."""

    name: str
    apart: float
    first: Floats
    second: Floats


def page(sides: Sides) -> Page:
    """Make the report of a comparison."""
    drawn, first, second = sides.pairs[:MOST_PAIRS], *sides.names
    key = tuple(zip(COLORS, sides.names, strict=True))
    return Page(
        title=f"{first} and {second}" + (f": {sides.task}" if sides.task else ""),
        subtitle="Recordings of the same task, episodes paired by seed",
        said=conclusion(sides),
        tiles=_tiles(sides),
        sections=[
            Section("Metrics", _about(sides), [Grid(columns(sides), rows(sides), 2)]),
            Section("Each pair", "", [_pairs(sides)]),
            Section("Episodes", "", _curves(drawn, sides.names), key, picks=True),
            _delays_section(sides, key),
            *_distributions(sides, key),
        ],
        choices=[pair[0].name for pair in drawn],
        notes=[*sides.notes, *_left_out(sides)],
        footer=f"acsar_gym {acsar_gym.__version__}",
    )


def _tiles(sides: Sides) -> list[Tile]:
    """Make the tiles of the most important metrics."""
    found = sides.comparisons()
    tiles = []
    for name in ("success_rate", "time_to_goal", "path", "odometry_error"):
        if name in found:
            value, (first, second) = VALUES[name], found[name].values
            now = f"{cell(second, value.scale)} {value.unit}"
            tiles.append(Tile(value.label, now, cell(first, value.scale)))
    return tiles


def _about(sides: Sides) -> str:
    first, second = sides.names
    return (
        "Wilson's intervals for rates, bootstrapped ones for means. The difference is "
        f"{second} minus {first} of the {len(sides.pairs)} pairs; * where its interval leaves out "
        "zero. Paired rates: Newcombe's interval."
    )


def _pairs(sides: Sides) -> Plot:
    """Plot the time of each pair's episodes."""
    traces: list[dict[str, Any]] = []
    numbers = np.arange(len(sides.pairs))
    for side, (name, color) in enumerate(zip(sides.names, COLORS, strict=True)):
        seconds = np.array([pair[side].seconds for pair in sides.pairs])
        won = [pair[side].success != 0.0 for pair in sides.pairs]
        symbols = ["circle" if one else "x" for one in won]
        marker = {"color": color, "size": 9, "symbol": symbols}
        traces.append(dots(name, numbers, seconds, color, marker=marker))
    names = [pair[0].name for pair in sides.pairs]
    ticks: dict[str, Any] = {"tickvals": numbers.tolist(), "ticktext": names}
    shown = ticks if len(names) <= MOST_PAIRS else {}
    return Plot(
        "Duration of the episodes of each pair; a cross where the goal wasn't reached",
        [traces],
        {"xaxis": axis("", **shown), "yaxis": axis("duration [s]", rangemode="tozero")},
        320,
    )


def _curves(pairs: Sequence[Pair], names: tuple[str, str]) -> list[Plot]:
    """Plot the ways and wheel speeds of pairs."""
    ways, wheels = [], []
    for pair in pairs:
        both = list(zip(pair, names, COLORS, strict=True))
        ways.append([trace for one, name, color in both for trace in _way(one, name, color)])
        sides = [
            Wheels(n, one.track.feedback_stamps - _start(one), one.track.feedback, color, 1.6)
            for one, n, color in both
        ]
        wheels.append(wheel_traces(None, sides))
    return [
        Plot("The way driven by odometry, from above; dots: the ends", ways, MAP, 460),
        Plot("Wheel speeds as the feedback lines say", wheels, wheel_layout(), 560),
    ]


def _way(outcome: Outcome, name: str, color: str) -> list[dict[str, Any]]:
    poses = outcome.episode.poses
    return [
        line(name, poses[:, 0], poses[:, 1], color),
        dots(f"{name}, end", poses[-1:, 0], poses[-1:, 1], color),
    ]


def _start(outcome: Outcome) -> float:
    return float(outcome.track.stamps[0])


def _delays_section(sides: Sides, key: tuple[tuple[str, str], ...]) -> Section:
    """Make the section of the delays, without a plot where there are too few steps."""
    known = not math.isnan(sides.delays().p_value)
    return Section("Delays", _about_delays(sides), *([_delays(sides)], key) if known else ())


def _about_delays(sides: Sides) -> str:
    """Say what the test of the delays found."""
    test, (first, second) = sides.delays(), sides.names
    counts = f"{test.counts[0]} and {test.counts[1]} steps of the command"
    if math.isnan(test.p_value):
        return f"{counts}: too few to compare."
    return (
        f"{second} answers {lag(test.difference)} than {first} (95 % interval "
        f"{between(test.interval, 1000.0)}); Kolmogorov-Smirnov p = {cell(test.p_value)}, {counts}."
    )


def _delays(sides: Sides) -> Plot:
    """Plot the distributions of delays."""
    traces = [
        shares(name, np.concatenate([o.track.delays for o in side]), color, 1000.0)
        for name, side, color in zip(sides.names, sides.outcomes, COLORS, strict=True)
    ]
    return Plot(
        "Time from a step of the command to the first line that shows it: share of steps that were "
        "answered within it",
        [traces],
        layout("delay [ms]", "share of steps", hovermode="x unified"),
        320,
    )


def _distributions(sides: Sides, key: tuple[tuple[str, str], ...]) -> list[Section]:
    """Make the section of what the policy saw and did; empty if it isn't recorded."""
    columns = _columns(sides)
    if not columns:
        return []
    text = "All steps of all episodes. D is the Kolmogorov-Smirnov distance, 0 (equal) to 1."
    return [Section("What the policy saw and did", text, [_histograms(columns)], key)]


def _columns(sides: Sides) -> list[Column]:
    """Return the numbers of observations and actions, those that differ most if there are many."""
    columns = []
    for first, second, names in (
        (*sides.observations(), sides.labels),
        (*sides.actions(), ("action: linear", "action: angular")),
    ):
        for number, apart in enumerate(distances(first, second)):
            name = names[number] if number < len(names) else f"number {number + 1}"
            columns.append(Column(name, apart, first[:, number], second[:, number]))
    kept = sorted(columns, key=lambda column: -column.apart)[:MOST_COLUMNS]
    return [column for column in columns if column in kept]


def _histograms(columns: Sequence[Column]) -> Plot:
    """Plot a small histogram of each column."""
    traces: list[dict[str, Any]] = []
    shape: dict[str, Any] = {"barmode": "overlay", "annotations": [], "bargap": 0}
    shape["margin"] = {"l": 8, "r": 8, "t": 36, "b": 4}
    deep = -(-len(columns) // ABREAST)
    for place, column in enumerate(columns):
        mark = "" if place == 0 else str(place + 1)
        edges = np.histogram_bin_edges(np.r_[column.first, column.second], BINS)
        middles, widths = (edges[1:] + edges[:-1]) / 2.0, np.diff(edges)
        for values, color in ((column.first, SOFT[0]), (column.second, SOFT[1])):
            share = np.histogram(values, edges)[0] / len(values)
            numbers = {"x": middles.tolist(), "y": share.tolist(), "width": widths.tolist()}
            bars = {"type": "bar", "marker": {"color": color, "line": {"width": 0}}}
            traces.append(bars | numbers | {"xaxis": f"x{mark}", "yaxis": f"y{mark}"})
        _place(shape, place, deep, f"{column.name}, D = {column.apart:.2f}")
    return Plot("Share of steps by value", [traces], shape, 40 + 180 * deep)


def _place(shape: dict[str, Any], place: int, deep: int, title: str) -> None:
    """Add the axes and the title of a small plot."""
    mark, (row, column) = "" if place == 0 else str(place + 1), divmod(place, ABREAST)
    left, top = column / ABREAST + 0.012, 1.0 - row / deep
    right, bottom = (column + 1) / ABREAST - 0.012, 1.0 - (row + 1) / deep + 0.36 / deep
    small = {"automargin": False, "tickfont": {"size": 11}}
    shape[f"xaxis{mark}"] = axis("", domain=[left, right], anchor=f"y{mark}", nticks=5, **small)
    y = axis("", domain=[bottom, top], anchor=f"x{mark}", showticklabels=False, **small)
    shape[f"yaxis{mark}"] = y
    where = {"x": left, "y": top, "xref": "paper", "yref": "paper", "xanchor": "left"}
    text = {"text": title, "showarrow": False, "yanchor": "bottom", "font": {"size": 12}}
    shape["annotations"].append(text | where)


def _left_out(sides: Sides) -> list[str]:
    """Say which pairs have no curves."""
    missing = len(sides.pairs) - MOST_PAIRS
    return [f"the curves of {missing} more pairs aren't in this file"] if missing > 0 else []
