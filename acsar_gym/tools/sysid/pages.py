"""The reports of `acsar-gym gap` and `acsar-gym compare`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

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

WHEEL_CORNERS = {1: "front left (b)", 0: "front right (a)", 2: "rear left (c)", 3: "rear right (d)"}
"""Wheels in the order of the four plots, as seen from above."""
TWIN_COLORS = {"before": "--first", "after": "--second"}
SIDE_COLORS = ("--second", "--first")
"""Of the first and the second side; with "-soft" those of bars that overlap."""
MAX_DRAWN = 20
"""Most pairs or episodes whose curves are in a report; the file would become too large."""
MAX_DRAWN_COLUMNS = 12
"""Most numbers of an observation that are drawn; those that differ most."""
HISTOGRAM_BINS = 40
HISTOGRAMS_PER_ROW = 4

Key = Sequence[tuple[str, str]]


def gap_page(gap: TwinGap) -> ReportPage:
    """Make the report of a gap."""
    drawn, sides = gap.judged[:MAX_DRAWN], tuple(TWIN_COLORS)
    key = (
        ("--robot", "robot, as recorded"),
        ("--first", "twin before fitting"),
        ("--second", "twin after fitting"),
    )
    tiles = []
    for name in ("wheel_speed_rms", "end_pose", "end_yaw", "time_shift"):
        metric = GAP_METRICS[name]
        old, new = (format_cell(gap.figures(side)[name], metric.scale) for side in sides)
        tiles.append(Tile(metric.label, f"{new} {metric.unit}", old))
    known = {replay.recorded.known for replay in gap.judged}
    against = {True: "the true pose", False: "odometry (then of both)"}
    kind = "held out: the robot wasn't fitted to them" if gap.held_out else "those it was fitted to"
    scope = (
        f"Over {len(gap.judged)} episodes, {kind}. Positions and yaw of the twin are compared with "
        f"{' or '.join(against[one] for one in sorted(known))} of the recorded robot."
    )
    columns = ("figure", "unit", "before", "after", "95 % interval", "after / before")
    return ReportPage(
        title=f"Gap of {gap.robot}",
        subtitle=(
            f"The recorded commands, through the twin ({gap.body}) before ({gap.before}) and after "
            "fitting"
        ),
        said=conclude_gap(gap),
        tiles=tiles,
        sections=[
            PageSection("Figures", scope, [Grid(columns, gap_rows(gap), words=2)]),
            _gap_delays(gap, key),
            PageSection(
                "Episodes",
                "",
                [_gap_speeds(drawn), _gap_ways(drawn), _errors(drawn)],
                key,
                picks=True,
            ),
            PageSection("All episodes", "", [_episode_table(gap)]),
        ],
        choices=[replay.name for replay in drawn],
        notes=[*gap.notes, *_left_out("episodes", len(gap.judged))],
    )


def compare_page(sides: SideComparison) -> ReportPage:
    """Make the report of a comparison."""
    drawn, first, second = sides.pairs[:MAX_DRAWN], *sides.names
    key = tuple(zip(SIDE_COLORS, sides.names, strict=True))
    found, tiles = sides.comparisons(), []
    for name in ("success_rate", "time_to_goal", "path", "odometry_error"):
        if name in found:
            metric = EPISODE_METRICS[name]
            old, new = (format_cell(value, metric.scale) for value in found[name].values)
            tiles.append(Tile(metric.label, f"{new} {metric.unit}", old))
    about = (
        "Wilson's intervals for rates, bootstrapped ones for means. The difference is "
        f"{second} minus {first} of the {len(sides.pairs)} pairs; * where its interval leaves out "
        "zero. Paired rates: Newcombe's interval."
    )
    metrics = Grid(comparison_columns(sides), comparison_rows(sides), words=2)
    return ReportPage(
        title=f"{first} and {second}" + (f": {sides.task}" if sides.task else ""),
        subtitle="Recordings of the same task, episodes paired by seed",
        said=conclude_comparison(sides),
        tiles=tiles,
        sections=[
            PageSection("Metrics", about, [metrics]),
            PageSection("Each pair", "", [_durations(sides)]),
            PageSection("Episodes", "", _pair_curves(drawn, sides.names), key, picks=True),
            _side_delays(sides, key),
            *_histograms(sides, key),
        ],
        choices=[pair[0].name for pair in drawn],
        notes=[*sides.notes, *_left_out("pairs", len(sides.pairs))],
    )


def _left_out(what: str, count: int) -> list[str]:
    missing = count - MAX_DRAWN
    return [f"the curves of {missing} more {what} aren't in this file"] if missing > 0 else []


def _plot_wheels(
    caption: str,
    choices: Iterable[tuple[tuple[Floats, Floats] | None, Sequence[PlotTrace]]],
) -> Plot:
    """Plot the speeds of four wheels, in the places where the wheels are.

    Args:
        caption: of the plot.
        choices: of each, the times [s] and speeds (k, 4) [rad/s] that were commanded, and traces
            whose y are speeds of four wheels.
    """
    found = []
    for commands, curves in choices:
        traces = []
        for place, wheel in enumerate(WHEEL_CORNERS, start=1):
            axes = {"xaxis": f"x{place}", "yaxis": f"y{place}"}
            if commands is not None:
                stamps, speeds = commands
                traces.append(stairs_trace("command", stamps, speeds[:, wheel], "--command"))
                traces[-1] |= axes
            traces += [line_trace(**curve | {"y": curve["y"][:, wheel]}) | axes for curve in curves]
        found.append(traces)
    layout = _small_plots(2, 2, list(WHEEL_CORNERS.values()), shared=True)
    for axis in ("xaxis3", "xaxis4"):
        layout[axis] |= make_axis("time [s]")
    for axis in ("yaxis", "yaxis3"):
        layout[axis] |= make_axis("speed [rad/s]")
    return Plot(caption, found, layout | {"hovermode": "x unified"}, 560)


def _small_plots(rows: int, columns: int, titles: Sequence[str], *, shared: bool) -> dict[str, Any]:
    """Make the layout of plots side by side, with a title each; shared axes zoom together."""
    from plotly.subplots import make_subplots  # noqa: PLC0415 - optional

    axes = "all" if shared else False
    figure = make_subplots(
        rows,
        columns,
        specs=[
            [{} if row * columns + column < len(titles) else None for column in range(columns)]
            for row in range(rows)
        ],
        subplot_titles=titles,
        shared_xaxes=axes,
        shared_yaxes=axes,
        horizontal_spacing=0.03,
        vertical_spacing=0.1 if shared else 0.36 / rows,
    )
    layout: dict[str, Any] = figure.to_plotly_json()["layout"]
    layout.pop("template", None)
    for title in layout["annotations"]:
        title["font"] = {"size": 12}
    return layout


def _plot_delays(traces: Sequence[PlotTrace]) -> Plot:
    return Plot(
        "Time from a step of the command to the first line that shows it: share of steps that were "
        "answered within it",
        [traces],
        make_layout("delay [ms]", "share of steps", hovermode="x unified"),
        320,
    )


def _gap_delays(gap: TwinGap, key: Key) -> PageSection:
    """Say what the test of the delays found, before and after, and plot their distribution."""
    if math.isnan(gap.delays("after").p_value):
        return PageSection("Delays", f"{explain_few_steps(gap.delays('after'))}.")
    lines = []
    robot = np.concatenate([replay.delays("after")[1] for replay in gap.judged])
    traces = [distribution_trace("robot", robot, "--robot", 1000.0, width=3.2)]
    for side, color in TWIN_COLORS.items():
        own = np.concatenate([replay.delays(side)[0] for replay in gap.judged])
        traces.append(distribution_trace(f"twin {side} fitting", own, color, 1000.0))
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
    return PageSection("Delays", f"{text[0].upper()}{text[1:]}.", [_plot_delays(traces)], key)


def _tracks(replay: EpisodeReplay) -> list[tuple[EpisodeTrack, Mapping[str, Any]]]:
    """Return the tracks of the robot, below, and of both twins, and how they are drawn."""
    twins = [
        (replay.twins[side], {"name": f"twin {side}", "color": color})
        for side, color in TWIN_COLORS.items()
    ]
    return [(replay.recorded, {"name": "robot", "color": "--robot", "width": 3.2}), *twins]


def _gap_speeds(replays: Sequence[EpisodeReplay]) -> Plot:
    choices = []
    for replay in replays:
        start = float(replay.recorded.stamps[0])
        sent = replay.recorded.command_stamps - start, replay.recorded.commands
        curves = [
            {"x": track.feedback_stamps - start, "y": track.feedback, **style}
            for track, style in _tracks(replay)
        ]
        choices.append((sent, curves))
    return _plot_wheels("Wheel speeds as the feedback lines say; thin: what was commanded", choices)


def _gap_ways(replays: Sequence[EpisodeReplay]) -> Plot:
    choices = []
    for replay in replays:
        traces = [
            line_trace(x=track.poses[:, 0], y=track.poses[:, 1], **style)
            for track, style in _tracks(replay)
        ]
        if replay.recorded.known:
            x, y = replay.recorded.odometry[:, :2].T
            dotted = {"color": "--robot", "width": 1.4, "dash": "dot"}
            traces.append(line_trace("robot's odometry", x, y, "--robot", line=dotted))
        choices.append(traces)
    return Plot(
        "The way driven, from above; dotted: the robot's odometry where the true way is known",
        choices,
        MAP_LAYOUT,
        480,
    )


def _errors(replays: Sequence[EpisodeReplay]) -> Plot:
    choices = []
    for replay in replays:
        robot, traces = replay.recorded, []
        for side, color in TWIN_COLORS.items():
            apart = np.hypot(*(replay.twins[side].poses - robot.poses)[:, :2].T) * 100.0
            traces.append(line_trace(f"twin {side}", robot.stamps - robot.stamps[0], apart, color))
        choices.append(traces)
    layout = make_layout("time [s]", "distance [cm]", hovermode="x unified")
    return Plot("Distance between the twin and the robot", choices, layout, 320)


def _episode_table(gap: TwinGap) -> Grid:
    metrics = {name: GAP_METRICS[name] for name in ("wheel_speed_rms", "end_pose", "end_yaw")}
    rows = [
        (
            replay.name,
            "fitted" if replay.fitted else "held out",
            "truth" if replay.recorded.known else "odometry",
            f"{replay.seconds:.1f}",
            *(
                " → ".join(
                    format_cell(replay.figures[side][name], metric.scale) for side in TWIN_COLORS
                )
                for name, metric in metrics.items()
            ),
        )
        for replay in gap.replays
    ]
    headings = [f"{metric.label} [{metric.unit}]" for metric in metrics.values()]
    return Grid(("episode", "use", "against", "duration [s]", *headings), rows, words=3)


def _durations(sides: SideComparison) -> Plot:
    """Plot the time of each pair's episodes."""
    numbers, names = np.arange(len(sides.pairs)), [pair[0].name for pair in sides.pairs]
    traces = []
    for side, (name, color) in enumerate(zip(sides.names, SIDE_COLORS, strict=True)):
        seconds = [pair[side].seconds for pair in sides.pairs]
        symbols = ["circle" if pair[side].success != 0.0 else "x" for pair in sides.pairs]
        traces.append(dots_trace(name, numbers, seconds, color, symbol=symbols))
    ticks: dict[str, Any] = {"tickvals": numbers.tolist(), "ticktext": names}
    return Plot(
        "Duration of the episodes of each pair; a cross where the goal wasn't reached",
        [traces],
        {
            "xaxis": make_axis("", **ticks if len(names) <= MAX_DRAWN else {}),
            "yaxis": make_axis("duration [s]", rangemode="tozero"),
        },
        320,
    )


def _pair_curves(
    pairs: Sequence[tuple[EpisodeOutcome, EpisodeOutcome]], names: tuple[str, str]
) -> list[Plot]:
    """Plot the ways and wheel speeds of pairs."""
    ways, wheels = [], []
    for pair in pairs:
        traces, curves = [], []
        for one, name, color in zip(pair, names, SIDE_COLORS, strict=True):
            x, y = one.episode.poses[:, :2].T
            traces.append(line_trace(name, x, y, color))
            traces.append(dots_trace(f"{name}, end", x[-1:], y[-1:], color))
            stamps = one.track.feedback_stamps - one.track.stamps[0]
            curves.append({"name": name, "color": color, "x": stamps, "y": one.track.feedback})
        ways.append(traces)
        wheels.append((None, curves))
    return [
        Plot("The way driven by odometry, from above; dots: the ends", ways, MAP_LAYOUT, 460),
        _plot_wheels("Wheel speeds as the feedback lines say", wheels),
    ]


def _side_delays(sides: SideComparison, key: Key) -> PageSection:
    """Say what the test of the delays found, with a plot where there are enough steps."""
    test, (first, second) = sides.delays(), sides.names
    counts = f"{test.counts[0]} and {test.counts[1]} steps of the command"
    if math.isnan(test.p_value):
        return PageSection("Delays", f"{counts}: too few to compare.")
    text = (
        f"{second} answers {format_lag(test.difference)} than {first} (95 % interval "
        f"{format_interval(test.interval, 1000.0)}); Kolmogorov-Smirnov p = "
        f"{format_cell(test.p_value)}, {counts}."
    )
    traces = [
        distribution_trace(name, np.concatenate([o.track.delays for o in side]), color, 1000.0)
        for name, side, color in zip(sides.names, sides.outcomes, SIDE_COLORS, strict=True)
    ]
    return PageSection("Delays", text, [_plot_delays(traces)], key)


def _histograms(sides: SideComparison, key: Key) -> list[PageSection]:
    """Make the section of what the policy saw and did; empty if it isn't recorded.

    Of many numbers, those that differ most are drawn.
    """
    columns: list[tuple[float, int, str, Floats, Floats]] = []
    for first, second, names in (
        (*sides.observations(), sides.labels),
        (*sides.actions(), ("action: linear", "action: angular")),
    ):
        for number, apart in enumerate(distribution_distances(first, second)):
            name = names[number] if number < len(names) else f"number {number + 1}"
            columns.append((apart, len(columns), name, first[:, number], second[:, number]))
    kept = sorted(columns, key=lambda column: -column[0])[:MAX_DRAWN_COLUMNS]
    kept.sort(key=lambda column: column[1])
    if not kept:
        return []
    traces: list[PlotTrace] = []
    for place, (_, _, _, *both) in enumerate(kept, start=1):
        edges = np.histogram_bin_edges(np.concatenate(both), HISTOGRAM_BINS)
        for values, color in zip(both, SIDE_COLORS, strict=True):
            traces.append(
                {
                    "type": "bar",
                    "marker": {"color": f"{color}-soft", "line": {"width": 0}},
                    "x": ((edges[1:] + edges[:-1]) / 2.0).tolist(),
                    "y": (np.histogram(values, edges)[0] / len(values)).tolist(),
                    "width": np.diff(edges).tolist(),
                    "xaxis": f"x{place}",
                    "yaxis": f"y{place}",
                }
            )
    deep = -(-len(kept) // HISTOGRAMS_PER_ROW)
    titles = [f"{name}, D = {apart:.2f}" for apart, _, name, _, _ in kept]
    layout = _small_plots(deep, HISTOGRAMS_PER_ROW, titles, shared=False)
    for name, axis in layout.items():
        if name[1:5] == "axis":
            axis |= {"automargin": False, "tickfont": {"size": 11}, "nticks": 5}
            axis["showticklabels"] = name[0] == "x"
    layout |= {"barmode": "overlay", "bargap": 0, "margin": {"l": 8, "r": 8, "t": 36, "b": 24}}
    text = "All steps of all episodes. D is the Kolmogorov-Smirnov distance, 0 (equal) to 1."
    plot = Plot("Share of steps by value", [traces], layout, 40 + 180 * deep)
    return [PageSection("What the policy saw and did", text, [plot], key)]
