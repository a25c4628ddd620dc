"""The report of `acsar-gym gap`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import acsar_gym
from acsar_gym.gap.figures import METRICS
from acsar_gym.gap.measure import Gap, Replay, conclusion
from acsar_gym.gap.page.html import Grid, Page, Plot, Section, Tile
from acsar_gym.gap.page.traces import axis, layout, line, shares, stairs
from acsar_gym.gap.tables import between, cell, rows
from acsar_gym.gap.tracks import Track

KEY = (
    ("--robot", "robot, as recorded"),
    ("--first", "twin before fitting"),
    ("--second", "twin after fitting"),
)
COLORS = {"before": "--first", "after": "--second"}
CORNERS = ((1, "front left (b)"), (0, "front right (a)"), (2, "rear left (c)"), (3, "rear right (d)"))
"""Wheels in the order of the four plots, as seen from above."""
MOST_EPISODES = 12
"""Most episodes whose curves are in the report; the file would become too large."""


def page(gap: Gap) -> Page:
    """Make the report of a gap."""
    drawn = gap.judged[:MOST_EPISODES]
    return Page(
        title=f"Gap of {gap.robot}",
        subtitle=(
            f"The recorded commands, through the twin ({gap.body}) before ({gap.before}) and after "
            "fitting"
        ),
        said=conclusion(gap),
        tiles=_tiles(gap),
        sections=[
            Section("Figures", _scope(gap), [_figures(gap)]),
            Section("Delays", _about_delays(gap), [_delays(gap)], KEY),
            Section("Episodes", "", [_speeds(drawn), _ways(drawn), _errors(drawn)], KEY, picks=True),
            Section("All episodes", "", [_logs(gap)]),
        ],
        choices=[replay.name for replay in drawn],
        notes=[*gap.notes, *_left_out(gap, drawn)],
        footer=f"acsar_gym {acsar_gym.__version__}",
    )


def _scope(gap: Gap) -> str:
    """Say which logs the figures are of."""
    known = {replay.recorded.known for replay in gap.judged}
    against = {True: "the true pose", False: "odometry"}
    kind = "held out: the robot wasn't fitted to them" if gap.held_out else "those it was fitted to"
    return (
        f"Over {len(gap.judged)} episodes, {kind}. Positions and yaw of the twin are compared with "
        f"{' or '.join(against[one] for one in sorted(known))} of the recorded robot."
    )


def _tiles(gap: Gap) -> list[Tile]:
    """Make the tiles with the most important figures."""
    before, after = gap.figures("before"), gap.figures("after")
    tiles = []
    for name in ("wheel_speed_rms", "end_pose", "end_yaw", "time_shift"):
        metric = METRICS[name]
        old, new = (cell(side[name], metric.scale) for side in (before, after))
        tiles.append(Tile(metric.label, f"{new} {metric.unit}", old))
    return tiles


def _figures(gap: Gap) -> Grid:
    columns = ("figure", "unit", "before", "after", "95 % interval", "left")
    return Grid(columns, rows(gap), words=2)


def _logs(gap: Gap) -> Grid:
    """Make the table of all episodes."""
    names = ("wheel_speed_rms", "end_pose", "end_yaw")
    told = [
        (
            replay.name,
            "fitted" if replay.fitted else "held out",
            "truth" if replay.recorded.known else "odometry",
            f"{replay.seconds:.1f}",
            *(
                " → ".join(cell(side[name], METRICS[name].scale) for side in _sides(replay))
                for name in names
            ),
        )
        for replay in gap.replays
    ]
    headings = [f"{METRICS[name].label} [{METRICS[name].unit}]" for name in names]
    return Grid(("episode", "use", "against", "duration [s]", *headings), told, words=3)


def _sides(replay: Replay) -> list[dict[str, float]]:
    return [replay.figures["before"], replay.figures["after"]]


def _about_delays(gap: Gap) -> str:
    """Say what the test of the delays found, before and after."""
    lines = []
    for side in ("before", "after"):
        test = gap.delays(side)
        around = between(test.interval, 1000.0)
        lines.append(
            f"{side} fitting, the robot answers {cell(test.difference, 1000.0)} ms later than the "
            f"twin ({'95 % interval ' + around + ', ' if around else ''}"
            f"Kolmogorov-Smirnov p = {cell(test.p_value)}, {test.counts[0]} steps)"
        )
    text = "; ".join(lines)
    return f"{text[0].upper()}{text[1:]}."


def _delays(gap: Gap) -> Plot:
    """Plot the distribution of delays of the robot and of both twins."""
    pairs = {side: [replay.delays(side) for replay in gap.judged] for side in COLORS}
    robot = np.concatenate([pair[1] for pair in pairs["after"]])
    traces = [shares("robot", robot, "--robot", 1000.0)]
    traces += [
        shares(f"twin {side} fitting", np.concatenate([twin for twin, _ in pairs[side]]), color, 1e3)
        for side, color in COLORS.items()
    ]
    return Plot(
        "Time from a step of the command to the first line that shows it: share of steps that were "
        "answered within it",
        [traces],
        layout("delay [ms]", "share of steps", hovermode="x unified"),
        340,
    )


def _tracks(replay: Replay) -> list[tuple[str, str, Track]]:
    """Return name, colour and track of the robot and both twins; the robot is drawn last."""
    twins = [(f"twin {side}", color, replay.twins[side]) for side, color in COLORS.items()]
    return [*twins, ("robot", "--robot", replay.recorded)]


def _speeds(replays: Sequence[Replay]) -> Plot:
    """Plot the speeds of the four wheels, in the places where the wheels are."""
    layout: dict[str, Any] = {"hovermode": "x unified", "grid": {"rows": 2, "columns": 2}}
    layout["annotations"] = []
    for number, (_, name) in enumerate(CORNERS):
        mark = "" if number == 0 else str(number + 1)
        column, low = number % 2, number < 2
        shown = {} if number == 0 else {"matches": "x"}
        x = axis("" if low else "time [s]", anchor=f"y{mark}", **shown)
        domain = [0.0, 0.485] if column == 0 else [0.515, 1.0]
        layout[f"xaxis{mark}"] = x | {"domain": domain, "showticklabels": not low}
        y = axis("" if column else "speed [rad/s]", anchor=f"x{mark}")
        y |= {"domain": [0.55, 1.0] if low else [0.0, 0.45]} | ({"matches": "y"} if number else {})
        layout[f"yaxis{mark}"] = y | {"showticklabels": not column}
        place = {"x": domain[0], "y": 1.0 if low else 0.45, "xref": "paper", "yref": "paper"}
        layout["annotations"].append(
            {"text": name, "showarrow": False, "xanchor": "left", "yanchor": "bottom", **place}
        )
    layout.pop("grid")
    return Plot(
        "Wheel speeds as the feedback lines say; thin: what was commanded",
        [_wheels(replay) for replay in replays],
        layout,
        560,
    )


def _wheels(replay: Replay) -> list[dict[str, Any]]:
    """Make the traces of four wheels."""
    traces = []
    start = float(replay.recorded.stamps[0])
    for number, (wheel, _) in enumerate(CORNERS):
        mark = "" if number == 0 else str(number + 1)
        axes = {"xaxis": f"x{mark}", "yaxis": f"y{mark}"}
        sent = replay.recorded
        commands = sent.commands[:, wheel]
        traces.append(
            stairs("command", sent.command_stamps - start, commands, "--command", **axes)
        )
        for name, color, track in _tracks(replay):
            stamps, values = track.feedback_stamps - start, track.feedback[:, wheel]
            traces.append(line(name, stamps, values, color, **axes))
    return traces


def _ways(replays: Sequence[Replay]) -> Plot:
    """Plot the ways driven, from above."""
    choices = []
    for replay in replays:
        traces = [
            line(name, track.poses[:, 0], track.poses[:, 1], color)
            for name, color, track in _tracks(replay)
        ]
        if replay.recorded.known:
            way = replay.recorded.odometry
            traces.append(line("robot's odometry", way[:, 0], way[:, 1], "--robot", dash="dot"))
        choices.append(traces)
    equal = axis("y [m]", scaleanchor="x", scaleratio=1)
    return Plot(
        "The way driven, from above; dotted: the robot's odometry where the true way is known",
        choices,
        {"xaxis": axis("x [m]"), "yaxis": equal},
        480,
    )


def _errors(replays: Sequence[Replay]) -> Plot:
    """Plot the distance between twin and robot over time."""
    choices = []
    for replay in replays:
        robot, start = replay.recorded, float(replay.recorded.stamps[0])
        traces = []
        for side, color in COLORS.items():
            apart = np.hypot(*(replay.twins[side].truth - robot.poses)[:, :2].T)
            traces.append(line(f"twin {side}", robot.stamps - start, apart * 100.0, color))
        choices.append(traces)
    return Plot(
        "Distance between the twin and the robot",
        choices,
        layout("time [s]", "distance [cm]", hovermode="x unified"),
        320,
    )


def _left_out(gap: Gap, drawn: Sequence[Replay]) -> list[str]:
    """Say which episodes have no curves."""
    missing = len(gap.judged) - len(drawn)
    return [f"the curves of {missing} more episodes aren't in this file"] if missing else []
