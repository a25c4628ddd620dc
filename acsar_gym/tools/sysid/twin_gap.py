"""The gap between recorded robots and their twins, before and after fitting; tables and page."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, show_value, suggest_name
from acsar_gym.protocol import MOTORS, WHEELS
from acsar_gym.recording.pairs import check_same_robot, find_difference
from acsar_gym.recording.twin_replay import remove_jitter
from acsar_gym.recording.types import Episode, Recording
from acsar_gym.tools import page
from acsar_gym.tools.evaluation.metrics import Interval, bootstrap_interval, replace_nonfinite
from acsar_gym.tools.evaluation.report import escape_text
from acsar_gym.tools.sysid.board_log import Floats
from acsar_gym.tools.sysid.tracks import (
    DelayComparison,
    EpisodeTrack,
    compare_delays,
    explain_few_steps,
    format_lag,
    make_recorded_track,
    make_twin_track,
)
from acsar_gym.tools.sysid.twist_controller import resend_twists

TIME_SHIFTS = np.arange(-0.2, 0.2001, 0.001)
"""Time shifts that are tried [s]."""
MOVING_SPEED = 0.2
"""Wheels that never differ by more than this from their mean don't tell a time shift [rad/s]."""
TWIN_SIDES = ("before", "after")
GAP_COLUMNS = ("figure", "unit", "before", "after", "95 % interval", "after / before")
LOG_COLUMNS = ("log", "use", "duration", "wheel speeds", "end position", "against")
NOTED_PAUSE = 0.1
"""Longer pauses between commands are noted [s]."""
SHORTEST_EPISODE, LONGEST_EPISODE = 1.0, 4.0 * 3600.0
"""Shorter and longer episodes are left out [s]."""
WHEEL_PLACES = (1, 0, 2, 3)
"""Wheels in the order of the four plots, as seen from above."""
SIDE_COLORS = {"robot": "#333333", "before": "#c2410c", "after": "#1d6fb8"}
MAX_DRAWN = 12
"""Most episodes whose curves are in a page; the file would become too large."""


class GapMetric(NamedTuple):
    """One figure of the gap: what it is called, and how it is shown."""

    label: str
    unit: str
    scale: float
    """Factor from SI to the unit."""
    resolution: float
    """Smaller values are nothing that a log shows, in SI units."""
    rms: bool = False
    """Whether it is a root mean square, and pooled as one; otherwise a mean of sizes."""


GAP_METRICS = {
    "wheel_speed_rms": GapMetric("wheel speeds, RMS", "rad/s", 1.0, 1e-3, rms=True),
    "linear_rms": GapMetric("linear velocity, RMS", "m/s", 1.0, 1e-4, rms=True),
    "angular_rms": GapMetric("angular velocity, RMS", "rad/s", 1.0, 1e-3, rms=True),
    "yaw_rms": GapMetric("yaw, RMS", "deg", 180.0 / math.pi, 1e-3, rms=True),
    "end_pose": GapMetric("position at the end", "cm", 100.0, 1e-3),
    "end_yaw": GapMetric("yaw at the end", "deg", 180.0 / math.pi, 1e-3),
    "end_odometry": GapMetric("position at the end, odometry of both", "cm", 100.0, 1e-3),
    "time_shift": GapMetric("time shift of the wheel speeds", "ms", 1000.0, 1e-3),
}
"""The figures by name, in SI units; `--fail-over` takes these names."""
LIMIT_NAMES = (*GAP_METRICS, "delay")
"""What `--fail-over` takes; the delay is the difference of the means [s]."""
GapFigures = dict[str, float]
"""Values of GAP_METRICS in SI units; NaN for what a log can't tell."""


def measure_figures(recorded: EpisodeTrack, twin: EpisodeTrack, period: float) -> GapFigures:
    """Compute the gap between a recorded track and a twin's that got the same commands.

    Args:
        recorded: the recorded track.
        twin: the twin's, on the same clock.
        period: nominal period of the recorded feedback [s].

    Returns:
        A value for every metric, in SI units. `time_shift` is positive where the recorded robot
        is later than the twin; the others are sizes.
    """
    stamps = remove_jitter(recorded.feedback_stamps, period)
    own = remove_jitter(twin.feedback_stamps, period)
    twists = recorded.twists - _interpolate(stamps, own, twin.twists)
    yaw = recorded.poses[:, 2] - twin.poses[:, 2]
    return {
        "wheel_speed_rms": _rms(recorded.feedback - _interpolate(stamps, own, twin.feedback)),
        "linear_rms": _rms(twists[:, 0]),
        "angular_rms": _rms(twists[:, 1]),
        "yaw_rms": _rms(yaw),
        "end_pose": _end_distance(recorded.poses, twin.poses),
        "end_yaw": abs(float(yaw[-1])) if len(yaw) else math.nan,
        "end_odometry": _end_distance(recorded.odometry, twin.odometry),
        "time_shift": find_time_shift(stamps, recorded.feedback, own, twin.feedback),
    }


def _rms(values: Floats) -> float:
    """The root mean square; NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


def _interpolate(wanted: Floats, stamps: Floats, values: Floats) -> Floats:
    """Interpolate rows linearly; NaN if there are none."""
    if not len(stamps):
        return np.full((len(wanted), values.shape[1]), np.nan)
    return np.column_stack([np.interp(wanted, stamps, column) for column in values.T])


def _end_distance(one: Floats, other: Floats) -> float:
    """The distance of the last positions [m]; NaN if there are none."""
    if not len(one) or not len(other):
        return math.nan
    return float(np.hypot(*(one[-1, :2] - other[-1, :2])))


def find_time_shift(
    stamps: Floats, speeds: Floats, twin_stamps: Floats, twin_speeds: Floats
) -> float:
    """Return by how much the twin's wheel speeds must be delayed to fit the recorded ones best [s].

    NaN if the wheels hardly move, or nothing within +-0.2 s fits best.
    """
    if len(stamps) < 3 or len(twin_stamps) < 3 or np.ptp(speeds, axis=0).max() < MOVING_SPEED:
        return math.nan
    costs = np.array(
        [_rms(speeds - _interpolate(stamps - s, twin_stamps, twin_speeds)) for s in TIME_SHIFTS]
    )
    best = int(np.argmin(costs))
    if not 0 < best < len(TIME_SHIFTS) - 1:
        return math.nan
    left, middle, right = np.square(costs[best - 1 : best + 2])
    bend = left - 2.0 * middle + right
    part = 0.5 * (left - right) / bend if bend > 0.0 else 0.0
    return float(TIME_SHIFTS[best] + part * (TIME_SHIFTS[1] - TIME_SHIFTS[0]))


def pool_figures(rows: Sequence[GapFigures], weights: Sequence[float]) -> GapFigures:
    """Combine figures of several episodes.

    Args:
        rows: figures of each episode.
        weights: their durations [s], for root mean squares; the others are means over episodes.
    """
    found = {}
    for name, metric in GAP_METRICS.items():
        pairs = zip(rows, weights, strict=True)
        known = [(row[name], w) for row, w in pairs if math.isfinite(row[name])]
        if not known:
            found[name] = math.nan
        elif metric.rms:
            total = sum(weight for _, weight in known)
            found[name] = math.sqrt(sum(value * value * weight for value, weight in known) / total)
        else:
            found[name] = sum(value for value, _ in known) / len(known)
    return found


@dataclass(frozen=True, eq=False)
class EpisodeReplay:
    """One recorded episode, and both twins that got the same commands."""

    log: str
    episode: int
    fitted: bool
    """Whether the robot's parameters were measured on this log."""
    seconds: float
    recorded: EpisodeTrack
    twins: Mapping[str, EpisodeTrack]
    """By side: "before" and "after"."""
    figures: Mapping[str, GapFigures]

    @property
    def name(self) -> str:
        """Log and number of the episode."""
        return f"{self.log} #{self.episode}"

    def delays(self, side: str) -> tuple[Floats, Floats]:
        """Return the delays of the twin and of the robot [s], for steps that both show."""
        twin, robot = self.twins[side].delays, self.recorded.delays
        both = np.isfinite(twin) & np.isfinite(robot)
        return twin[both], robot[both]


@dataclass(frozen=True, eq=False)
class TwinGap:
    """The gaps of all logs."""

    robot: str
    """What the fitted twin was made of."""
    before: str
    """What the unfitted twin was made of."""
    body: str
    replays: tuple[EpisodeReplay, ...]
    notes: tuple[str, ...]

    @property
    def held_out(self) -> bool:
        """Whether there is any log that the robot wasn't fitted to."""
        return any(not replay.fitted for replay in self.replays)

    @property
    def judged(self) -> tuple[EpisodeReplay, ...]:
        """The held-out episodes, or all where none is held out."""
        return tuple(r for r in self.replays if not (self.held_out and r.fitted))

    def figures(self, side: str) -> GapFigures:
        """Return the figures of "before" or "after" over all judged episodes."""
        judged = self.judged
        return pool_figures([r.figures[side] for r in judged], [r.seconds for r in judged])

    def intervals(self, side: str) -> dict[str, Interval]:
        """Return bootstrap intervals of the means over the judged episodes; NaN for one."""
        rows = [replay.figures[side] for replay in self.judged]
        return {name: bootstrap_interval([row[name] for row in rows]) for name in GAP_METRICS}

    def delays(self, side: str) -> DelayComparison:
        """Test whether the robot's delays differ from the twin's, over the judged episodes."""
        pairs = [replay.delays(side) for replay in self.judged]
        return compare_delays(*(np.concatenate(samples) for samples in zip(*pairs, strict=True)))


def measure_gap(
    logs: Sequence[tuple[str, Recording]],
    robot: tuple[str, RobotConfig],
    before: tuple[str, RobotConfig],
    body: str = "planar",
) -> TwinGap:
    """Replay the commands of logs through two twins, and compare both with what was recorded.

    Args:
        logs: names and recordings.
        robot: name and config of the fitted twin.
        before: name and config of the unfitted one.
        body: physics of both, such as "planar".

    Raises:
        ConfigError: the logs are of different robots, or hold nothing that can be compared.
    """
    check_same_robot(logs, "compare logs of")
    config = robot[1]
    fitted_on = {*config.motor_fit_logs, *(s for one in config.measured.values() for s in one.logs)}
    replays, notes = [], _note_limits(logs, robot, before, known=bool(fitted_on))
    twins = {"before": before[1], "after": config}
    for log, recording in logs:
        for number, episode in enumerate(recording.episodes):
            if why := _find_unusable(episode, config):
                notes.append(f"{log} #{number}: left out, {why}")
                continue
            wire = resend_twists(episode.wire, recording.config, config)
            episode = replace(episode, wire=wire)  # noqa: PLW2901 - as its controller took it
            pause = float(np.diff(episode.wire.sent_stamps).max(initial=0.0))
            if pause > NOTED_PAUSE:
                notes.append(f"{log} #{number}: no command was sent for {pause:.2f} s")
            recorded, tracks, figures = make_recorded_track(episode, config), {}, {}
            for side in TWIN_SIDES:
                track = make_twin_track(episode, config, twins[side], body)
                if not recorded.known:  # like with like
                    track = replace(track, truth=np.full_like(track.truth, np.nan))
                tracks[side] = track
                figures[side] = measure_figures(recorded, track, 1.0 / config.feedback_rate)
            fitted = not fitted_on.isdisjoint(recording.sources)
            seconds = float(episode.stamps[-1] - episode.stamps[0])
            replay = EpisodeReplay(log, number, fitted, seconds, recorded, tracks, figures)
            replays.append(replay)
    if not replays:
        raise ConfigError(notes[-1] if notes else f"{logs[0][0]}: holds no episode")
    if all(replay.fitted for replay in replays):
        notes.append("the robot was fitted to all of these logs: none is held out")
    return TwinGap(robot[0], before[0], body, tuple(replays), tuple(notes))


def _note_limits(
    logs: Sequence[tuple[str, Recording]],
    robot: tuple[str, RobotConfig],
    before: tuple[str, RobotConfig],
    *,
    known: bool,
) -> list[str]:
    """Say what limits the comparison; `known`: whether the robot's file names logs."""
    notes = [f"{name}: {side.misfit}" for name, side in (robot, before) if side.misfit]
    for name, recording in logs:
        if recording.cut:
            note = f"{name}: its end is missing; the rest was used"
            if known:
                note += f", as held out: it can't be told whether {robot[0]} was fitted to the "
                note += "whole of it"
            notes.append(note)
        if recording.dropped:
            notes.append(f"{name}: {recording.dropped:,} ticks are missing")
        if recording.damages:
            notes.append(f"{name}: {recording.describe_damage()}")
        found = find_difference(recording.config, robot[1], wire=True)
        if found is not None:
            field, own, other = found
            notes.append(f"{name}: recorded with {field} = {own}, {robot[0]}: {other}")
    episodes = [episode for _, recording in logs for episode in recording.episodes]
    if not all(np.isfinite(episode.truth).all() for episode in episodes):
        notes.append(
            f"where no true pose was recorded, positions are by odometry of both, computed anew "
            f"from the wheel speeds with the geometry of {robot[0]}"
        )
    return notes


def _find_unusable(episode: Episode, config: RobotConfig) -> str:
    """Say why an episode can't be replayed; empty if it can."""
    wire = episode.wire
    times = [t for t in (episode.stamps, wire.sent_stamps, wire.got_stamps) if len(t)]
    lasts = float(np.ptp(episode.stamps)) if len(episode.stamps) else 0.0
    ascending = all(
        np.isfinite(stamps).all() and (np.diff(stamps) >= 0.0).all() for stamps in times
    )
    if not (ascending and np.isfinite(episode.poses).all()):
        return "its times go backwards, or its odometry isn't finite: the file is damaged"
    if lasts < SHORTEST_EPISODE - 2.0 * config.period:
        return f"holds less than {SHORTEST_EPISODE:g} s"
    if max(stamps[-1] for stamps in times) - min(stamps[0] for stamps in times) > LONGEST_EPISODE:
        return f"is longer than {LONGEST_EPISODE / 3600.0:g} h"
    if not len(wire.sent_stamps) or len(wire.feedback(config)[0]) < 3:
        return "holds no commands, or no feedback"
    return ""


def conclude_gap(gap: TwinGap) -> list[str]:
    """Say in a few lines how far the twin is from the robot."""
    judged, test = gap.judged, gap.delays("after")
    seconds = sum(replay.seconds for replay in judged)
    kind = "held-out" if gap.held_out else "fitted"
    before, after = gap.figures("before"), gap.figures("after")
    wheels, ends = (
        f"from {before[name] * scale:.2f} to {after[name] * scale:.2f}"
        for name, scale in (("wheel_speed_rms", 1.0), ("end_pose", 100.0))
    )
    by = format_lag(test.difference)
    if math.isnan(test.p_value):
        delays = explain_few_steps(test)
    elif test.differs:
        delays = f"delays differ: the robot answers {by} than its twin (p = {test.p_value:.2g})"
    else:
        delays = f"delays don't differ measurably: {by} than the twin on average "
        delays += f"(p = {test.p_value:.2g})"
    episodes = f"{len(judged)} {kind} episode{'s' * (len(judged) != 1)}, {seconds:.0f} s"
    figures = f"wheel speeds {wheels} rad/s RMS, position at the end {ends} cm"
    return [f"{episodes}: {figures}", delays]


def _format_cell(value: float, scale: float = 1.0) -> str:
    """Format a number with three digits; "-" for NaN."""
    if math.isnan(value):
        return "-"
    return "0" if abs(value * scale) < 1e-6 else f"{value * scale:.3g}"


def _gap_rows(gap: TwinGap) -> list[tuple[str, ...]]:
    """The cells of `GAP_COLUMNS` for each metric; no ratio where there was nothing to lose."""
    before, after, around = gap.figures("before"), gap.figures("after"), gap.intervals("after")
    rows = []
    for name, metric in GAP_METRICS.items():
        values, ratio = (before[name], after[name]), "-"
        if all(map(math.isfinite, values)) and abs(before[name]) >= metric.resolution:
            ratio = f"{abs(after[name] / before[name]):.1%}"
        ends = [_format_cell(end, metric.scale) for end in around[name]]
        interval = "" if math.isnan(around[name][0]) else " to ".join(ends)
        cells = [_format_cell(value, metric.scale) for value in values]
        rows.append((metric.label, metric.unit, *cells, interval, ratio))
    return rows


def _log_rows(gap: TwinGap) -> list[tuple[str, ...]]:
    """The cells of `LOG_COLUMNS` for each episode."""
    rows: list[tuple[str, ...]] = []
    for replay in gap.replays:
        speeds, ends = (
            " -> ".join(_format_cell(replay.figures[side][name], scale) for side in TWIN_SIDES)
            for name, scale in (("wheel_speed_rms", 1.0), ("end_pose", 100.0))
        )
        use = "fitted" if replay.fitted else "held out"
        against = "truth" if replay.recorded.known else "odometry"
        cells = (f"{replay.seconds:.1f} s", f"{speeds} rad/s", f"{ends} cm", against)
        rows.append((replay.name, use, *cells))
    return rows


def gap_tables(gap: TwinGap) -> list[Table]:
    """Make the tables of a gap: figures, and the logs."""
    kind = "held-out logs" if gap.held_out else "logs that the robot was fitted to"
    title = f"Gap of {gap.robot} (before: {gap.before}) on {kind}, twin: {gap.body}"
    figures = Table(title=escape_text(title), title_justify="left")
    for name in GAP_COLUMNS:
        figures.add_column(name, justify="left" if name in ("figure", "unit") else "right")
    for row in _gap_rows(gap):
        figures.add_row(*row)
    logs = Table(title="Each episode, before -> after", title_justify="left")
    for name in LOG_COLUMNS:
        logs.add_column(name, justify="right" if name == "duration" else "left")
    for cells in _log_rows(gap):
        logs.add_row(*map(escape_text, cells))
    return [figures, logs]


def format_gap(gap: TwinGap) -> dict[str, Any]:
    """Return the gap for JSON, in SI units; what isn't known is null."""
    sides = {
        side: {
            "figures": gap.figures(side),
            "intervals": gap.intervals(side),
            "delays": gap.delays(side)._asdict(),
        }
        for side in TWIN_SIDES
    }
    logs = [
        {
            "log": replay.log,
            "episode": replay.episode,
            "fitted": replay.fitted,
            "seconds": replay.seconds,
            "truth": replay.recorded.known,
            **{side: replay.figures[side] for side in TWIN_SIDES},
        }
        for replay in gap.replays
    ]
    told: dict[str, Any] = replace_nonfinite(
        {
            "robot": gap.robot,
            "unfitted": gap.before,
            "body": gap.body,
            "held_out": gap.held_out,
            **sides,
            "logs": logs,
            "notes": list(gap.notes),
            "conclusion": conclude_gap(gap),
        }
    )
    return told


def parse_limits(given: Sequence[str]) -> dict[str, float]:
    """Parse limits of `--fail-over` for continuous integration, such as "wheel_speed_rms=0.5".

    Returns:
        Metrics of LIMIT_NAMES and their limits, in SI units.

    Raises:
        ConfigError: an unknown metric, or a value that isn't a number from 0 up.
    """
    limits = {}
    for text in given:
        name, equals, value = text.partition("=")
        if name not in LIMIT_NAMES:
            unknown = f"{show_value(name)}{suggest_name(name, LIMIT_NAMES)}"
            raise ConfigError(f"--fail-over: unknown metric {unknown}")
        try:
            limit = float(value) if equals else math.nan
        except ValueError:
            limit = math.nan
        if not 0.0 <= limit < math.inf:
            raise ConfigError(
                f"--fail-over {show_value(text)}: must be METRIC=VALUE with a value of at least 0, "
                "such as wheel_speed_rms=0.5"
            )
        limits[name] = limit
    return limits


def find_exceeded(limits: Mapping[str, float], figures: Mapping[str, float]) -> list[str]:
    """Return a line for each limit that isn't kept; what couldn't be measured isn't, either."""
    lines = []
    for name, limit in limits.items():
        size = abs(figures[name])
        if math.isnan(size):
            lines.append(f"{name}: couldn't be measured, the limit is {limit:g}")
        elif size > limit:
            lines.append(f"{name} = {size:.4g}: over the limit of {limit:g}")
    return lines


def write_gap_page(path: Path, gap: TwinGap) -> None:
    """Write a gap as a page. Errors as for `write_page`."""
    judged = gap.judged
    sections = [
        page.Section(
            "Figures",
            "\n".join([*conclude_gap(gap), *gap.notes]),
            page.Table(GAP_COLUMNS, _gap_rows(gap)),
        ),
        _describe_delays(gap),
        page.Section("Episodes", "", page.Table(LOG_COLUMNS, _log_rows(gap))),
        *(
            page.Section(replay.name, "", None, [_plot_speeds(replay), _plot_ways(replay)])
            for replay in judged[:MAX_DRAWN]
        ),
    ]
    if len(judged) > MAX_DRAWN:
        missing = f"the curves of {len(judged) - MAX_DRAWN} more episodes aren't in this file"
        sections.append(page.Section("Not drawn", missing))
    page.write_page(path, f"Gap of {gap.robot}", sections)


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


def _describe_delays(gap: TwinGap) -> page.Section:
    """Say what the test of the delays found, before and after, and plot their distribution."""
    from plotly import graph_objects  # noqa: PLC0415 - optional

    if math.isnan(gap.delays("after").p_value):
        return page.Section("Delays", explain_few_steps(gap.delays("after")))
    lines, traces = [], []
    samples = {side: [replay.delays(side) for replay in gap.judged] for side in TWIN_SIDES}
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
                f"(Kolmogorov-Smirnov p = {_format_cell(test.p_value)}, {test.counts[0]} steps)"
            )
    layout = {
        "title": "From a step of the command to the first line that shows it",
        "xaxis": {"title": "delay [ms]"},
        "yaxis": {"title": "share of steps"},
    }
    return page.Section("Delays", "; ".join(lines), None, [graph_objects.Figure(traces, layout)])


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
