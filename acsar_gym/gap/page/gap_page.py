"""The report of `acsar-gym gap`."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

import acsar_gym
from acsar_gym.evaluation.page.document import Grid, Page, Plot, Section, Tile
from acsar_gym.evaluation.page.traces import MAP, dotted, layout, line, shares
from acsar_gym.gap.delays import lag, too_few_steps
from acsar_gym.gap.figures import METRICS
from acsar_gym.gap.measure import Gap, Replay, conclusion
from acsar_gym.gap.page.wheels import Wheels, wheel_layout, wheel_traces
from acsar_gym.gap.tables import between, cell, rows
from acsar_gym.gap.tracks import Track

KEY = (
    ("--robot", "robot, as recorded"),
    ("--first", "twin before fitting"),
    ("--second", "twin after fitting"),
)
COLORS = {"before": "--first", "after": "--second"}
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
            Section(
                "Delays", _about_delays(gap), *([_delays(gap)], KEY) if _has_delays(gap) else ()
            ),
            Section("Episodes", "", _curves(drawn), KEY, picks=True),
            Section("All episodes", "", [_logs(gap)]),
        ],
        choices=[replay.name for replay in drawn],
        notes=[*gap.notes, *_left_out(gap, drawn)],
        footer=f"acsar_gym {acsar_gym.__version__}",
    )


def _curves(drawn: Sequence[Replay]) -> list[Plot]:
    return [_speeds(drawn), _ways(drawn), _errors(drawn)]


def _scope(gap: Gap) -> str:
    """Say which logs the figures are of."""
    known = {replay.recorded.known for replay in gap.judged}
    against = {True: "the true pose", False: "odometry (then of both)"}
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
    columns = ("figure", "unit", "before", "after", "95 % interval", "after / before")
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
    if not _has_delays(gap):
        return f"{too_few_steps(gap.delays('after'))}."
    lines = []
    for side in ("before", "after"):
        test = gap.delays(side)
        if math.isnan(test.p_value):
            lines.append(f"{side} fitting, {too_few_steps(test)}")
            continue
        around = between(test.interval, 1000.0)
        lines.append(
            f"{side} fitting, the robot answers {lag(test.difference)} than the "
            f"twin ({'95 % interval ' + around + ', ' if around else ''}"
            f"Kolmogorov-Smirnov p = {cell(test.p_value)}, {test.counts[0]} steps)"
        )
    text = "; ".join(lines)
    return f"{text[0].upper()}{text[1:]}."


def _has_delays(gap: Gap) -> bool:
    """Whether there are enough steps to compare the delays of the fitted twin."""
    return not math.isnan(gap.delays("after").p_value)


def _delays(gap: Gap) -> Plot:
    """Plot the distribution of delays of the robot and of both twins."""
    pairs = {side: [replay.delays(side) for replay in gap.judged] for side in COLORS}
    robot = np.concatenate([pair[1] for pair in pairs["after"]])
    traces = [shares("robot", robot, "--robot", 1000.0, width=3.2)]
    for side, color in COLORS.items():
        own = np.concatenate([twin for twin, _ in pairs[side]])
        traces.append(shares(f"twin {side} fitting", own, color, 1000.0))
    return Plot(
        "Time from a step of the command to the first line that shows it: share of steps that were "
        "answered within it",
        [traces],
        layout("delay [ms]", "share of steps", hovermode="x unified"),
        340,
    )


def _tracks(replay: Replay) -> list[tuple[str, str, float, Track]]:
    """Return name, colour, line width and track of the robot, below, and of both twins."""
    twins = [(f"twin {side}", color, 1.6, replay.twins[side]) for side, color in COLORS.items()]
    return [("robot", "--robot", 3.2, replay.recorded), *twins]


def _speeds(replays: Sequence[Replay]) -> Plot:
    """Plot the speeds of the four wheels."""
    choices = []
    for replay in replays:
        start = float(replay.recorded.stamps[0])
        sent = replay.recorded.command_stamps - start, replay.recorded.commands
        tracks = [
            Wheels(name, track.feedback_stamps - start, track.feedback, color, width)
            for name, color, width, track in _tracks(replay)
        ]
        choices.append(wheel_traces(sent, tracks))
    caption = "Wheel speeds as the feedback lines say; thin: what was commanded"
    return Plot(caption, choices, wheel_layout(), 560)


def _ways(replays: Sequence[Replay]) -> Plot:
    """Plot the ways driven, from above."""
    choices = []
    for replay in replays:
        traces = [
            line(name, track.poses[:, 0], track.poses[:, 1], color, width=width)
            for name, color, width, track in _tracks(replay)
        ]
        if replay.recorded.known:
            way = replay.recorded.odometry
            traces.append(dotted("robot's odometry", way[:, 0], way[:, 1], "--robot"))
        choices.append(traces)
    return Plot(
        "The way driven, from above; dotted: the robot's odometry where the true way is known",
        choices,
        MAP,
        480,
    )


def _errors(replays: Sequence[Replay]) -> Plot:
    """Plot the distance between twin and robot over time."""
    choices = []
    for replay in replays:
        robot, start = replay.recorded, float(replay.recorded.stamps[0])
        traces = []
        for side, color in COLORS.items():
            apart = np.hypot(*(replay.twins[side].poses - robot.poses)[:, :2].T)
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
