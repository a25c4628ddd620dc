"""The page of `acsar-gym gap --html`: figures, delays, and each episode as it was driven."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym.protocol import MOTORS, WHEELS
from acsar_gym.tools.page import Section, Table, write_page
from acsar_gym.tools.sysid.delays import Floats, explain_few_steps, format_lag
from acsar_gym.tools.sysid.twin_gap import (
    GAP_COLUMNS,
    LOG_COLUMNS,
    EpisodeReplay,
    TwinGap,
    conclude_gap,
    format_cell,
    format_interval,
    gap_rows,
    log_rows,
)

WHEEL_PLACES = (1, 0, 2, 3)
"""Wheels in the order of the four plots, as seen from above."""
SIDE_COLORS = {"robot": "#333333", "before": "#c2410c", "after": "#1d6fb8"}
MAX_DRAWN = 12
"""Most episodes whose curves are in a page; the file would become too large."""


def write_gap_page(path: Path, gap: TwinGap) -> None:
    """Write a gap as a page. Errors as for `write_page`."""
    judged = gap.judged
    sections = [
        Section(
            "Figures",
            "\n".join([*conclude_gap(gap), *gap.notes]),
            Table(GAP_COLUMNS, gap_rows(gap)),
        ),
        _describe_delays(gap),
        Section("Episodes", "", Table(LOG_COLUMNS, log_rows(gap))),
        *(
            Section(replay.name, "", None, [_plot_speeds(replay), _plot_ways(replay)])
            for replay in judged[:MAX_DRAWN]
        ),
    ]
    if len(judged) > MAX_DRAWN:
        missing = f"the curves of {len(judged) - MAX_DRAWN} more episodes aren't in this file"
        sections.append(Section("Not drawn", missing))
    write_page(path, f"Gap of {gap.robot}", sections)


def _line(name: str, x: Floats, y: Floats, color: str, **style: Any) -> dict[str, Any]:
    """A curve for plotly."""
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x": x.tolist(),
        "y": y.tolist(),
        "line": {"color": color, **style},
    }


def _describe_delays(gap: TwinGap) -> Section:
    """Say what the test of the delays found, before and after, and plot their distribution."""
    from plotly import graph_objects  # noqa: PLC0415 - optional

    if math.isnan(gap.delays("after").p_value):
        return Section("Delays", explain_few_steps(gap.delays("after")))
    lines, traces = [], []
    samples = {side: [replay.delays(side) for replay in gap.judged] for side in ("before", "after")}
    curves = {"robot": [robot for _, robot in samples["after"]]}
    curves |= {side: [twin for twin, _ in pairs] for side, pairs in samples.items()}
    for name, parts in curves.items():
        delays = np.sort(1000.0 * np.concatenate(parts))
        shares = np.arange(1, len(delays) + 1) / max(1, len(delays))
        label = name if name == "robot" else f"twin {name} fitting"
        traces.append(_line(label, delays, shares, SIDE_COLORS[name], shape="hv"))
    for side in samples:
        test = gap.delays(side)
        if not math.isnan(test.p_value):
            lines.append(
                f"{side} fitting, the robot answers {format_lag(test.difference)} than the twin "
                f"(95 % interval {format_interval(test.interval, 1000.0)}, Kolmogorov-Smirnov p = "
                f"{format_cell(test.p_value)}, {test.counts[0]} steps)"
            )
    layout = {
        "title": "From a step of the command to the first line that shows it",
        "xaxis": {"title": "delay [ms]"},
        "yaxis": {"title": "share of steps"},
    }
    return Section("Delays", "; ".join(lines), None, [graph_objects.Figure(traces, layout)])


def _tracks(replay: EpisodeReplay) -> Sequence[tuple[str, Any, str]]:
    """Name, track and colour of the robot, below, and of both twins."""
    twins = [(f"twin {side}", replay.twins[side], SIDE_COLORS[side]) for side in replay.twins]
    return [("robot", replay.recorded, SIDE_COLORS["robot"]), *twins]


def _plot_speeds(replay: EpisodeReplay) -> Any:
    """Plot the speeds of four wheels, in the places where the wheels are."""
    from plotly.subplots import make_subplots  # noqa: PLC0415 - optional

    recorded = replay.recorded
    start = float(recorded.stamps[0])
    titles = [f"{WHEELS[wheel]} ({MOTORS[wheel]})" for wheel in WHEEL_PLACES]
    figure = make_subplots(2, 2, shared_xaxes="all", shared_yaxes="all", subplot_titles=titles)
    for place, wheel in enumerate(WHEEL_PLACES):
        row, column = divmod(place, 2)
        commands = recorded.commands[:, wheel]
        stamps = recorded.command_stamps - start
        curves = [_line("command", stamps, commands, "#999999", width=1, shape="hv")]
        for name, track, color in _tracks(replay):
            curves.append(
                _line(name, track.feedback_stamps - start, track.feedback[:, wheel], color)
            )
        for curve in curves:
            curve["showlegend"] = place == 0
            curve["legendgroup"] = curve["name"]
            figure.add_trace(curve, row + 1, column + 1)
    figure.update_xaxes(title="time [s]", row=2)
    figure.update_yaxes(title="speed [rad/s]", col=1)
    return figure.update_layout(title="Wheel speeds as the feedback lines say", height=560)


def _plot_ways(replay: EpisodeReplay) -> Any:
    """Plot the way driven, from above; the robot's odometry, too, where the true way is known."""
    from plotly import graph_objects  # noqa: PLC0415 - optional

    traces = [
        _line(name, track.poses[:, 0], track.poses[:, 1], color)
        for name, track, color in _tracks(replay)
    ]
    if replay.recorded.known:
        x, y = replay.recorded.odometry[:, :2].T
        traces.append(_line("robot's odometry", x, y, SIDE_COLORS["robot"], dash="dot"))
    layout = {
        "title": "The way driven, from above",
        "xaxis": {"title": "x [m]"},
        "yaxis": {"title": "y [m]", "scaleanchor": "x"},
        "height": 480,
    }
    return graph_objects.Figure(traces, layout)
