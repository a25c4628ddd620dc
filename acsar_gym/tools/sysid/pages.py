"""The reports of `acsar-gym gap` and `acsar-gym compare`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import acsar_gym
from acsar_gym.tools.evaluation.page import (
    MAP_LAYOUT,
    Grid,
    PageSection,
    Plot,
    PlotTrace,
    ReportPage,
    Tile,
    distribution_trace,
    dots_trace,
    dotted_trace,
    line_trace,
    make_axis,
    make_layout,
    stairs_trace,
)
from acsar_gym.tools.sysid.delays import Floats, explain_few_steps, format_lag
from acsar_gym.tools.sysid.sim_real import (
    EPISODE_METRICS,
    EpisodeOutcome,
    SideComparison,
    comparison_columns,
    comparison_rows,
    conclude_comparison,
    distribution_distances,
)
from acsar_gym.tools.sysid.tracks import EpisodeTrack
from acsar_gym.tools.sysid.twin_gap import (
    GAP_METRICS,
    EpisodeReplay,
    TwinGap,
    conclude_gap,
    format_cell,
    format_interval,
    gap_rows,
)

WHEEL_CORNERS = (
    (1, "front left (b)"),
    (0, "front right (a)"),
    (2, "rear left (c)"),
    (3, "rear right (d)"),
)
"""Wheels in the order of the four plots, as seen from above."""
CORNER_COLUMNS = ((0.0, 0.485), (0.515, 1.0))
CORNER_ROWS = ((0.55, 1.0), (0.0, 0.45))


@dataclass(frozen=True, eq=False)
class WheelCurves:
    """Speeds of four wheels, (k, 4) [rad/s], at times (k,) [s], and how they are drawn."""

    name: str
    stamps: Floats
    speeds: Floats
    color: str
    width: float


def wheel_traces(
    commands: tuple[Floats, Floats] | None, tracks: Sequence[WheelCurves]
) -> list[PlotTrace]:
    """Make the traces of four wheels; `commands` are times [s] and speeds [rad/s]."""
    traces = []
    for place, (wheel, _) in enumerate(WHEEL_CORNERS):
        axes: dict[str, Any] = {"xaxis": f"x{_mark(place)}", "yaxis": f"y{_mark(place)}"}
        if commands is not None:
            stamps, speeds = commands
            traces.append(stairs_trace("command", stamps, speeds[:, wheel], "--command", **axes))
        traces += [
            line_trace(t.name, t.stamps, t.speeds[:, wheel], t.color, width=t.width, **axes)
            for t in tracks
        ]
    return traces


def wheel_layout() -> Mapping[str, Any]:
    """Make the layout of four plots that are zoomed together."""
    layout: dict[str, Any] = {"hovermode": "x unified", "annotations": []}
    for place, (_, name) in enumerate(WHEEL_CORNERS):
        mark, column, row = _mark(place), CORNER_COLUMNS[place % 2], CORNER_ROWS[place // 2]
        left, low = place % 2 == 0, place >= 2
        first = place == 0
        layout[f"xaxis{mark}"] = make_axis(
            "time [s]" if low else "",
            anchor=f"y{mark}",
            domain=column,
            showticklabels=low,
            **({} if first else {"matches": "x"}),
        )
        layout[f"yaxis{mark}"] = make_axis(
            "speed [rad/s]" if left else "",
            anchor=f"x{mark}",
            domain=row,
            showticklabels=left,
            **({} if first else {"matches": "y"}),
        )
        where = {"x": column[0], "y": row[1], "xref": "paper", "yref": "paper"}
        where |= {"xanchor": "left", "yanchor": "bottom"}
        layout["annotations"].append({"text": name, "showarrow": False, **where})
    return layout


def _mark(place: int) -> str:
    """Return the number of an axis, as plotly writes it."""
    return "" if place == 0 else str(place + 1)


SIDE_COLORS = ("--second", "--first")
"""Of the first and the second side."""
SIDE_SOFT_COLORS = ("--second-soft", "--first-soft")
MAX_DRAWN_PAIRS = 20
"""Most pairs whose curves are in the report; the file would become too large."""
MAX_DRAWN_COLUMNS = 12
"""Most numbers of an observation that are drawn; those that differ most."""
HISTOGRAM_BINS = 40
HISTOGRAMS_PER_ROW = 4
"""Small plots in a row."""
OutcomePair = tuple[EpisodeOutcome, EpisodeOutcome]


@dataclass(frozen=True, eq=False)
class ComparedColumn:
    """One number of the observations or actions: its distance, and its values on both sides."""

    name: str
    apart: float
    first: Floats
    second: Floats


def compare_page(sides: SideComparison) -> ReportPage:
    """Make the report of a comparison."""
    drawn, first, second = sides.pairs[:MAX_DRAWN_PAIRS], *sides.names
    key = tuple(zip(SIDE_COLORS, sides.names, strict=True))
    return ReportPage(
        title=f"{first} and {second}" + (f": {sides.task}" if sides.task else ""),
        subtitle="Recordings of the same task, episodes paired by seed",
        said=conclude_comparison(sides),
        tiles=_tiles(sides),
        sections=[
            PageSection(
                "Metrics",
                _about(sides),
                [Grid(comparison_columns(sides), comparison_rows(sides), 2)],
            ),
            PageSection("Each pair", "", [_pairs(sides)]),
            PageSection("Episodes", "", _curves(drawn, sides.names), key, picks=True),
            _delays_section(sides, key),
            *_distributions(sides, key),
        ],
        choices=[pair[0].name for pair in drawn],
        notes=[*sides.notes, *_left_out(sides)],
        footer=f"acsar_gym {acsar_gym.__version__}",
    )


def _tiles(sides: SideComparison) -> list[Tile]:
    """Make the tiles of the most important metrics."""
    found = sides.comparisons()
    tiles = []
    for name in ("success_rate", "time_to_goal", "path", "odometry_error"):
        if name in found:
            value, (first, second) = EPISODE_METRICS[name], found[name].values
            now = f"{format_cell(second, value.scale)} {value.unit}"
            tiles.append(Tile(value.label, now, format_cell(first, value.scale)))
    return tiles


def _about(sides: SideComparison) -> str:
    first, second = sides.names
    return (
        "Wilson's intervals for rates, bootstrapped ones for means. The difference is "
        f"{second} minus {first} of the {len(sides.pairs)} pairs; * where its interval leaves out "
        "zero. Paired rates: Newcombe's interval."
    )


def _pairs(sides: SideComparison) -> Plot:
    """Plot the time of each pair's episodes."""
    traces: list[dict[str, Any]] = []
    numbers = np.arange(len(sides.pairs))
    for side, (name, color) in enumerate(zip(sides.names, SIDE_COLORS, strict=True)):
        seconds = np.array([pair[side].seconds for pair in sides.pairs])
        won = [pair[side].success != 0.0 for pair in sides.pairs]
        symbols = ["circle" if one else "x" for one in won]
        marker = {"color": color, "size": 9, "symbol": symbols}
        traces.append(dots_trace(name, numbers, seconds, color, marker=marker))
    names = [pair[0].name for pair in sides.pairs]
    ticks: dict[str, Any] = {"tickvals": numbers.tolist(), "ticktext": names}
    shown = ticks if len(names) <= MAX_DRAWN_PAIRS else {}
    return Plot(
        "Duration of the episodes of each pair; a cross where the goal wasn't reached",
        [traces],
        {"xaxis": make_axis("", **shown), "yaxis": make_axis("duration [s]", rangemode="tozero")},
        320,
    )


def _curves(pairs: Sequence[OutcomePair], names: tuple[str, str]) -> list[Plot]:
    """Plot the ways and wheel speeds of pairs."""
    ways, wheels = [], []
    for pair in pairs:
        both = list(zip(pair, names, SIDE_COLORS, strict=True))
        ways.append([trace for one, name, color in both for trace in _way(one, name, color)])
        sides = [
            WheelCurves(n, one.track.feedback_stamps - _start(one), one.track.feedback, color, 1.6)
            for one, n, color in both
        ]
        wheels.append(wheel_traces(None, sides))
    return [
        Plot("The way driven by odometry, from above; dots: the ends", ways, MAP_LAYOUT, 460),
        Plot("Wheel speeds as the feedback lines say", wheels, wheel_layout(), 560),
    ]


def _way(outcome: EpisodeOutcome, name: str, color: str) -> list[dict[str, Any]]:
    poses = outcome.episode.poses
    return [
        line_trace(name, poses[:, 0], poses[:, 1], color),
        dots_trace(f"{name}, end", poses[-1:, 0], poses[-1:, 1], color),
    ]


def _start(outcome: EpisodeOutcome) -> float:
    return float(outcome.track.stamps[0])


def _delays_section(sides: SideComparison, key: tuple[tuple[str, str], ...]) -> PageSection:
    """Make the section of the delays, without a plot where there are too few steps."""
    known = not math.isnan(sides.delays().p_value)
    return PageSection("Delays", _about_delays(sides), *([_delays(sides)], key) if known else ())


def _about_delays(sides: SideComparison) -> str:
    """Say what the test of the delays found."""
    test, (first, second) = sides.delays(), sides.names
    counts = f"{test.counts[0]} and {test.counts[1]} steps of the command"
    if math.isnan(test.p_value):
        return f"{counts}: too few to compare."
    return (
        f"{second} answers {format_lag(test.difference)} than {first} (95 % interval "
        f"{format_interval(test.interval, 1000.0)}); Kolmogorov-Smirnov p = "
        f"{format_cell(test.p_value)}, {counts}."
    )


def _delays(sides: SideComparison) -> Plot:
    """Plot the distributions of delays."""
    traces = [
        distribution_trace(name, np.concatenate([o.track.delays for o in side]), color, 1000.0)
        for name, side, color in zip(sides.names, sides.outcomes, SIDE_COLORS, strict=True)
    ]
    return Plot(
        "Time from a step of the command to the first line that shows it: share of steps that were "
        "answered within it",
        [traces],
        make_layout("delay [ms]", "share of steps", hovermode="x unified"),
        320,
    )


def _distributions(sides: SideComparison, key: tuple[tuple[str, str], ...]) -> list[PageSection]:
    """Make the section of what the policy saw and did; empty if it isn't recorded."""
    columns = _columns(sides)
    if not columns:
        return []
    text = "All steps of all episodes. D is the Kolmogorov-Smirnov distance, 0 (equal) to 1."
    return [PageSection("What the policy saw and did", text, [_histograms(columns)], key)]


def _columns(sides: SideComparison) -> list[ComparedColumn]:
    """Return the numbers of observations and actions, those that differ most if there are many."""
    columns = []
    for first, second, names in (
        (*sides.observations(), sides.labels),
        (*sides.actions(), ("action: linear", "action: angular")),
    ):
        for number, apart in enumerate(distribution_distances(first, second)):
            name = names[number] if number < len(names) else f"number {number + 1}"
            columns.append(ComparedColumn(name, apart, first[:, number], second[:, number]))
    kept = sorted(columns, key=lambda column: -column.apart)[:MAX_DRAWN_COLUMNS]
    return [column for column in columns if column in kept]


def _histograms(columns: Sequence[ComparedColumn]) -> Plot:
    """Plot a small histogram of each column."""
    traces: list[dict[str, Any]] = []
    shape: dict[str, Any] = {"barmode": "overlay", "annotations": [], "bargap": 0}
    shape["margin"] = {"l": 8, "r": 8, "t": 36, "b": 4}
    deep = -(-len(columns) // HISTOGRAMS_PER_ROW)
    for place, column in enumerate(columns):
        mark = "" if place == 0 else str(place + 1)
        edges = np.histogram_bin_edges(np.r_[column.first, column.second], HISTOGRAM_BINS)
        middles, widths = (edges[1:] + edges[:-1]) / 2.0, np.diff(edges)
        for values, color in (
            (column.first, SIDE_SOFT_COLORS[0]),
            (column.second, SIDE_SOFT_COLORS[1]),
        ):
            share = np.histogram(values, edges)[0] / len(values)
            numbers = {"x": middles.tolist(), "y": share.tolist(), "width": widths.tolist()}
            bars = {"type": "bar", "marker": {"color": color, "line": {"width": 0}}}
            traces.append(bars | numbers | {"xaxis": f"x{mark}", "yaxis": f"y{mark}"})
        _place(shape, place, deep, f"{column.name}, D = {column.apart:.2f}")
    return Plot("Share of steps by value", [traces], shape, 40 + 180 * deep)


def _place(shape: dict[str, Any], place: int, deep: int, title: str) -> None:
    """Add the axes and the title of a small plot."""
    mark, (row, column) = "" if place == 0 else str(place + 1), divmod(place, HISTOGRAMS_PER_ROW)
    left, top = column / HISTOGRAMS_PER_ROW + 0.012, 1.0 - row / deep
    right, bottom = (column + 1) / HISTOGRAMS_PER_ROW - 0.012, 1.0 - (row + 1) / deep + 0.36 / deep
    small = {"automargin": False, "tickfont": {"size": 11}}
    shape[f"xaxis{mark}"] = make_axis(
        "", domain=[left, right], anchor=f"y{mark}", nticks=5, **small
    )
    y = make_axis("", domain=[bottom, top], anchor=f"x{mark}", showticklabels=False, **small)
    shape[f"yaxis{mark}"] = y
    where = {"x": left, "y": top, "xref": "paper", "yref": "paper", "xanchor": "left"}
    text = {"text": title, "showarrow": False, "yanchor": "bottom", "font": {"size": 12}}
    shape["annotations"].append(text | where)


def _left_out(sides: SideComparison) -> list[str]:
    """Say which pairs have no curves."""
    missing = len(sides.pairs) - MAX_DRAWN_PAIRS
    return [f"the curves of {missing} more pairs aren't in this file"] if missing > 0 else []


GAP_KEY = (
    ("--robot", "robot, as recorded"),
    ("--first", "twin before fitting"),
    ("--second", "twin after fitting"),
)
TWIN_COLORS = {"before": "--first", "after": "--second"}
MAX_DRAWN_EPISODES = 12
"""Most episodes whose curves are in the report; the file would become too large."""


def gap_page(gap: TwinGap) -> ReportPage:
    """Make the report of a gap."""
    drawn = gap.judged[:MAX_DRAWN_EPISODES]
    return ReportPage(
        title=f"Gap of {gap.robot}",
        subtitle=(
            f"The recorded commands, through the twin ({gap.body}) before ({gap.before}) and after "
            "fitting"
        ),
        said=conclude_gap(gap),
        tiles=_gap_tiles(gap),
        sections=[
            PageSection("Figures", _scope(gap), [_figures(gap)]),
            PageSection(
                "Delays",
                _about_gap_delays(gap),
                *([_gap_delays(gap)], GAP_KEY) if _has_delays(gap) else (),
            ),
            PageSection("Episodes", "", _gap_curves(drawn), GAP_KEY, picks=True),
            PageSection("All episodes", "", [_logs(gap)]),
        ],
        choices=[replay.name for replay in drawn],
        notes=[*gap.notes, *_episodes_left_out(gap, drawn)],
        footer=f"acsar_gym {acsar_gym.__version__}",
    )


def _gap_curves(drawn: Sequence[EpisodeReplay]) -> list[Plot]:
    return [_speeds(drawn), _ways(drawn), _errors(drawn)]


def _scope(gap: TwinGap) -> str:
    """Say which logs the figures are of."""
    known = {replay.recorded.known for replay in gap.judged}
    against = {True: "the true pose", False: "odometry (then of both)"}
    kind = "held out: the robot wasn't fitted to them" if gap.held_out else "those it was fitted to"
    return (
        f"Over {len(gap.judged)} episodes, {kind}. Positions and yaw of the twin are compared with "
        f"{' or '.join(against[one] for one in sorted(known))} of the recorded robot."
    )


def _gap_tiles(gap: TwinGap) -> list[Tile]:
    """Make the tiles with the most important figures."""
    before, after = gap.figures("before"), gap.figures("after")
    tiles = []
    for name in ("wheel_speed_rms", "end_pose", "end_yaw", "time_shift"):
        metric = GAP_METRICS[name]
        old, new = (format_cell(side[name], metric.scale) for side in (before, after))
        tiles.append(Tile(metric.label, f"{new} {metric.unit}", old))
    return tiles


def _figures(gap: TwinGap) -> Grid:
    columns = ("figure", "unit", "before", "after", "95 % interval", "after / before")
    return Grid(columns, gap_rows(gap), words=2)


def _logs(gap: TwinGap) -> Grid:
    """Make the table of all episodes."""
    names = ("wheel_speed_rms", "end_pose", "end_yaw")
    told = [
        (
            replay.name,
            "fitted" if replay.fitted else "held out",
            "truth" if replay.recorded.known else "odometry",
            f"{replay.seconds:.1f}",
            *(
                " → ".join(
                    format_cell(side[name], GAP_METRICS[name].scale) for side in _gap_sides(replay)
                )
                for name in names
            ),
        )
        for replay in gap.replays
    ]
    headings = [f"{GAP_METRICS[name].label} [{GAP_METRICS[name].unit}]" for name in names]
    return Grid(("episode", "use", "against", "duration [s]", *headings), told, words=3)


def _gap_sides(replay: EpisodeReplay) -> list[dict[str, float]]:
    return [replay.figures["before"], replay.figures["after"]]


def _about_gap_delays(gap: TwinGap) -> str:
    """Say what the test of the delays found, before and after."""
    if not _has_delays(gap):
        return f"{explain_few_steps(gap.delays('after'))}."
    lines = []
    for side in ("before", "after"):
        test = gap.delays(side)
        if math.isnan(test.p_value):
            lines.append(f"{side} fitting, {explain_few_steps(test)}")
            continue
        around = format_interval(test.interval, 1000.0)
        lines.append(
            f"{side} fitting, the robot answers {format_lag(test.difference)} than the "
            f"twin ({'95 % interval ' + around + ', ' if around else ''}"
            f"Kolmogorov-Smirnov p = {format_cell(test.p_value)}, {test.counts[0]} steps)"
        )
    text = "; ".join(lines)
    return f"{text[0].upper()}{text[1:]}."


def _has_delays(gap: TwinGap) -> bool:
    """Whether there are enough steps to compare the delays of the fitted twin."""
    return not math.isnan(gap.delays("after").p_value)


def _gap_delays(gap: TwinGap) -> Plot:
    """Plot the distribution of delays of the robot and of both twins."""
    pairs = {side: [replay.delays(side) for replay in gap.judged] for side in TWIN_COLORS}
    robot = np.concatenate([pair[1] for pair in pairs["after"]])
    traces = [distribution_trace("robot", robot, "--robot", 1000.0, width=3.2)]
    for side, color in TWIN_COLORS.items():
        own = np.concatenate([twin for twin, _ in pairs[side]])
        traces.append(distribution_trace(f"twin {side} fitting", own, color, 1000.0))
    return Plot(
        "Time from a step of the command to the first line that shows it: share of steps that were "
        "answered within it",
        [traces],
        make_layout("delay [ms]", "share of steps", hovermode="x unified"),
        340,
    )


def _tracks(replay: EpisodeReplay) -> list[tuple[str, str, float, EpisodeTrack]]:
    """Return name, colour, line width and track of the robot, below, and of both twins."""
    twins = [
        (f"twin {side}", color, 1.6, replay.twins[side]) for side, color in TWIN_COLORS.items()
    ]
    return [("robot", "--robot", 3.2, replay.recorded), *twins]


def _speeds(replays: Sequence[EpisodeReplay]) -> Plot:
    """Plot the speeds of the four wheels."""
    choices = []
    for replay in replays:
        start = float(replay.recorded.stamps[0])
        sent = replay.recorded.command_stamps - start, replay.recorded.commands
        tracks = [
            WheelCurves(name, track.feedback_stamps - start, track.feedback, color, width)
            for name, color, width, track in _tracks(replay)
        ]
        choices.append(wheel_traces(sent, tracks))
    caption = "Wheel speeds as the feedback lines say; thin: what was commanded"
    return Plot(caption, choices, wheel_layout(), 560)


def _ways(replays: Sequence[EpisodeReplay]) -> Plot:
    """Plot the ways driven, from above."""
    choices = []
    for replay in replays:
        traces = [
            line_trace(name, track.poses[:, 0], track.poses[:, 1], color, width=width)
            for name, color, width, track in _tracks(replay)
        ]
        if replay.recorded.known:
            way = replay.recorded.odometry
            traces.append(dotted_trace("robot's odometry", way[:, 0], way[:, 1], "--robot"))
        choices.append(traces)
    return Plot(
        "The way driven, from above; dotted: the robot's odometry where the true way is known",
        choices,
        MAP_LAYOUT,
        480,
    )


def _errors(replays: Sequence[EpisodeReplay]) -> Plot:
    """Plot the distance between twin and robot over time."""
    choices = []
    for replay in replays:
        robot, start = replay.recorded, float(replay.recorded.stamps[0])
        traces = []
        for side, color in TWIN_COLORS.items():
            apart = np.hypot(*(replay.twins[side].poses - robot.poses)[:, :2].T)
            traces.append(line_trace(f"twin {side}", robot.stamps - start, apart * 100.0, color))
        choices.append(traces)
    return Plot(
        "Distance between the twin and the robot",
        choices,
        make_layout("time [s]", "distance [cm]", hovermode="x unified"),
        320,
    )


def _episodes_left_out(gap: TwinGap, drawn: Sequence[EpisodeReplay]) -> list[str]:
    """Say which episodes have no curves."""
    missing = len(gap.judged) - len(drawn)
    return [f"the curves of {missing} more episodes aren't in this file"] if missing else []
