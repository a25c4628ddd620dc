"""The gap between recorded robots and their twins, before and after fitting, as tables and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Episode, Floats, Recording
from acsar_gym.tools.evaluation.metrics import Interval, bootstrap_interval, replace_nonfinite
from acsar_gym.tools.evaluation.report import escape_text
from acsar_gym.tools.sysid.board_log import resend_twists
from acsar_gym.tools.sysid.tracks import (
    EpisodeTrack,
    check_same_robot,
    find_difference,
    interpolate,
    make_recorded_track,
    make_twin_track,
)

TIME_SHIFTS = np.arange(-0.2, 0.2001, 0.001)
"""Time shifts that are tried [s]."""
MOVING_SPEED = 0.2
"""Wheels that never differ by more than this from their mean don't show a time shift [rad/s]."""
TWIN_SIDES = ("before", "after")
"""The unfitted and the fitted twin."""
LEAST_GAP = 1e-3
"""A smaller figure of the unfitted twin, in SI units, leaves nothing to compare with."""
NOTED_PAUSE = 0.1
"""Longer pauses between commands are noted [s]."""
SHORTEST_EPISODE = 1.0
LONGEST_EPISODE = 4.0 * 3600.0
"""Shorter and longer episodes are left out [s]."""


class GapMetric(NamedTuple):
    """A figure of the gap: its name, and how it is shown."""

    label: str
    unit: str
    scale: float = 1.0
    """Factor from SI to the unit."""
    rms: bool = False
    """Whether it is pooled as a root mean square. Otherwise it is a mean of sizes."""


GAP_METRICS = {
    "wheel_speed_rms": GapMetric("wheel speeds, RMS", "rad/s", rms=True),
    "linear_rms": GapMetric("linear velocity, RMS", "m/s", rms=True),
    "angular_rms": GapMetric("angular velocity, RMS", "rad/s", rms=True),
    "yaw_rms": GapMetric("yaw, RMS", "deg", 180.0 / math.pi, rms=True),
    "end_pose": GapMetric("position at the end", "cm", 100.0),
    "end_yaw": GapMetric("yaw at the end", "deg", 180.0 / math.pi),
    "end_odometry": GapMetric("position at the end, odometry of both", "cm", 100.0),
    "time_shift": GapMetric("time shift of the wheel speeds", "ms", 1000.0),
}
"""The figures by name, in SI units."""
GapFigures = dict[str, float]
"""Values of GAP_METRICS in SI units. NaN for a figure that a log doesn't show."""


def measure_figures(recorded: EpisodeTrack, twin: EpisodeTrack) -> GapFigures:
    """Compute the gap between a recorded track and a twin's that got the same commands.

    Args:
        recorded: The recorded track. If its true poses are unknown, the odometry is compared.
        twin: The twin's, on the same clock.

    Returns:
        A value for every metric, in SI units. `time_shift` is positive if the recorded robot is
        later than the twin. All other figures are sizes.
    """
    # Both sides have odometry by the same geometry, and perhaps true poses.
    drift = recorded.odometry - twin.odometry
    off = recorded.truth - twin.truth if np.isfinite(recorded.truth).all() else drift
    twists = recorded.twists - interpolate(recorded.stamps, twin.stamps, twin.twists)
    speeds = recorded.speeds - interpolate(recorded.stamps, twin.stamps, twin.speeds)

    return {
        "wheel_speed_rms": _rms(speeds),
        "linear_rms": _rms(twists[:, 0]),
        "angular_rms": _rms(twists[:, 1]),
        "yaw_rms": _rms(off[:, 2]),
        "end_pose": math.hypot(*off[-1, :2]),
        "end_yaw": abs(float(off[-1, 2])),
        "end_odometry": math.hypot(*drift[-1, :2]),
        "time_shift": find_time_shift(recorded, twin),
    }


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def find_time_shift(recorded: EpisodeTrack, twin: EpisodeTrack) -> float:
    """Return by how much the twin's wheel speeds must be delayed to fit the recorded ones best [s].

    NaN if the wheels hardly move, or nothing within +-0.2 s fits best.
    """
    if np.ptp(recorded.speeds, axis=0).max() < MOVING_SPEED:
        return math.nan
    # Every shift is tried, as the cost has several minima for periodic drives.
    errors = [
        _rms(recorded.speeds - interpolate(recorded.stamps - shift, twin.stamps, twin.speeds))
        for shift in TIME_SHIFTS
    ]
    costs = np.square(errors)
    best = int(np.argmin(costs))
    if not 0 < best < len(TIME_SHIFTS) - 1:
        return math.nan

    # The minimum of a parabola through the best shift and its neighbours.
    curvature, slope, _ = np.polyfit([-1, 0, 1], costs[best - 1 : best + 2], 2)
    step = TIME_SHIFTS[1] - TIME_SHIFTS[0]
    return float(TIME_SHIFTS[best] - step * slope / (2.0 * curvature))


class EpisodeReplay(NamedTuple):
    """A recorded episode, and how far both twins are from it."""

    log: str
    episode: int
    fitted: bool
    """Whether the robot's parameters were measured on this log."""
    seconds: float
    truth: bool
    """Whether true poses are compared. Otherwise the odometry of both is compared."""
    figures: Mapping[str, GapFigures]
    """Figures of each of `TWIN_SIDES`."""


@dataclass(frozen=True, eq=False)
class TwinGap:
    """The gaps of all logs."""

    robot: str
    """Name of the fitted robot."""
    unfitted: str
    """Name of the unfitted robot."""
    body: str
    replays: tuple[EpisodeReplay, ...]
    notes: tuple[str, ...]

    @property
    def held_out(self) -> bool:
        """Whether there is any log that the robot wasn't fitted to."""
        return not all(replay.fitted for replay in self.replays)

    @property
    def judged(self) -> tuple[EpisodeReplay, ...]:
        """The held-out episodes, or all if none is held out."""
        return tuple(r for r in self.replays if not (self.held_out and r.fitted))

    def _values(self, side: str, name: str) -> list[float]:
        return [replay.figures[side][name] for replay in self.judged]

    def figures(self, side: str) -> GapFigures:
        """Return the figures of "before" or "after" over all judged episodes.

        Root mean squares are weighted by the episodes' durations. Other figures are means.
        """
        seconds = [replay.seconds for replay in self.judged]
        pooled = {}
        for name, metric in GAP_METRICS.items():
            # A log may lack a figure, such as the shift of wheels that hardly move.
            values = np.ma.masked_invalid(self._values(side, name))
            mean = values.mean()
            if metric.rms:
                mean = np.ma.sqrt(np.ma.average(values**2, weights=seconds))
            pooled[name] = float(np.ma.filled(mean, math.nan))
        return pooled

    def intervals(self, side: str) -> dict[str, Interval]:
        """Return bootstrap intervals of the means over the judged episodes."""
        return {name: bootstrap_interval(self._values(side, name)) for name in GAP_METRICS}


def measure_gap(
    logs: Sequence[tuple[str, Recording]],
    robot: tuple[str, RobotConfig],
    unfitted: tuple[str, RobotConfig],
    body: str = "planar",
) -> TwinGap:
    """Replay the commands of logs through two twins, and compare both with what was recorded.

    Args:
        logs: Names and recordings.
        robot: Name and config of the fitted twin.
        unfitted: Name and config of the unfitted twin.
        body: Physics of both, such as "planar".

    Raises:
        ConfigError: The logs are of different robots, or contain nothing that can be compared.
    """
    check_same_robot(logs, "compare logs of")
    config = robot[1]

    # Logs that the robot's file names can't show how good it is.
    fitted_logs = set(config.motor_fit_logs).union(
        *(interval.logs for interval in config.measured.values())
    )
    notes = [f"{name}: {side.misfit}" for name, side in (robot, unfitted) if side.misfit]
    for name, recording in logs:
        notes += _note_limits(name, recording, robot, has_logs=bool(fitted_logs))

    replays = []
    for log, recording in logs:
        for number, episode in enumerate(recording.episodes):
            if reason := _find_unusable(episode, config):
                notes.append(f"{log} #{number}: left out, {reason}")
                continue
            pause = float(np.diff(episode.wire.sent_stamps).max(initial=0.0))
            if pause > NOTED_PAUSE:
                notes.append(f"{log} #{number}: no command was sent for {pause:.2f} s")

            # A controller in ROS makes wheel speeds of twists, by the geometry of the robot's file.
            wire = resend_twists(episode.wire, recording.config, config)
            resent = replace(episode, wire=wire)
            recorded = make_recorded_track(resent, config)
            twins = [
                make_twin_track(resent, config, twin=twin, body=body)
                for twin in (unfitted[1], config)
            ]
            replay = EpisodeReplay(
                log=log,
                episode=number,
                fitted=not fitted_logs.isdisjoint(recording.sources),
                seconds=float(np.ptp(episode.stamps)),
                truth=bool(np.isfinite(recorded.truth).all()),
                figures={
                    side: measure_figures(recorded, twin)
                    for side, twin in zip(TWIN_SIDES, twins, strict=True)
                },
            )
            replays.append(replay)

    if not replays:
        raise ConfigError(notes[-1] if notes else f"{logs[0][0]}: holds no episode")
    if not all(replay.truth for replay in replays):
        notes.append(
            "positions without a recorded true pose are by odometry of both, computed from the "
            f"wheel speeds with the geometry of {robot[0]}"
        )
    gap = TwinGap(robot[0], unfitted[0], body, tuple(replays), tuple(notes))
    if gap.held_out:
        return gap
    alone = "the robot was fitted to all of these logs: none is held out"
    return replace(gap, notes=(*notes, alone))


def _note_limits(
    name: str, recording: Recording, robot: tuple[str, RobotConfig], *, has_logs: bool
) -> Iterator[str]:
    """Yield what limits a comparison. `has_logs`: Whether the robot's file names its logs."""
    if recording.cut:
        held_out = f", as held out, although {robot[0]} may be fitted to the whole of it"
        yield f"{name}: its end is missing; the rest was used{held_out if has_logs else ''}"
    if recording.dropped:
        yield f"{name}: {recording.dropped:,} ticks are missing"
    if recording.damages:
        yield f"{name}: {recording.describe_damage()}"
    if difference := find_difference(recording.config, robot[1]):
        field, recorded, fitted = difference
        yield f"{name}: recorded with {field} = {recorded}, {robot[0]}: {fitted}"


def _find_unusable(episode: Episode, config: RobotConfig) -> str:
    """Return why an episode can't be replayed. Empty if it can."""
    # What a damaged or foreign file may hold would spoil all figures.
    wire = episode.wire
    times = (episode.stamps, wire.sent_stamps, wire.got_stamps)
    if not all((np.diff(stamps) >= 0.0).all() for stamps in times):
        return "its times go backwards: the file is damaged"
    if not len(wire.sent_stamps) or len(wire.feedback(config)[0]) < 3:
        return "holds no commands, or no feedback"
    if not np.isfinite(episode.poses).all():
        return "its odometry isn't finite"
    if not len(episode.stamps) or np.ptp(episode.stamps) < SHORTEST_EPISODE - 2.0 * config.period:
        return f"holds less than {SHORTEST_EPISODE:g} s"
    if np.ptp([stamps[place] for stamps in times for place in (0, -1)]) > LONGEST_EPISODE:
        return f"is longer than {LONGEST_EPISODE / 3600.0:g} h"
    return ""


def conclude_gap(gap: TwinGap) -> str:
    """State in a line how far the twin is from the robot."""
    judged = gap.judged
    seconds = sum(replay.seconds for replay in judged)
    kind = "held-out" if gap.held_out else "fitted"
    episodes = f"{len(judged)} {kind} episode{'s' * (len(judged) != 1)}, {seconds:.0f} s"
    unfitted, fitted = map(gap.figures, TWIN_SIDES)
    wheels = f"{unfitted['wheel_speed_rms']:.2f} to {fitted['wheel_speed_rms']:.2f} rad/s RMS"
    ends = f"{100.0 * unfitted['end_pose']:.2f} to {100.0 * fitted['end_pose']:.2f} cm"
    return f"{episodes}: wheel speeds from {wheels}, position at the end from {ends}"


def _format_cell(value: float, scale: float = 1.0) -> str:
    """Format a number with three digits. "-" for NaN."""
    if math.isnan(value):
        return "-"
    return "0" if abs(value * scale) < 1e-6 else f"{value * scale:.3g}"


def gap_tables(gap: TwinGap) -> list[Table]:
    """Make the tables of a gap: figures, and the logs."""
    kind = "held-out logs" if gap.held_out else "logs that the robot was fitted to"
    title = f"Gap of {gap.robot} (before: {gap.unfitted}) on {kind}, twin: {gap.body}"

    # The figures of both twins.
    figures = Table("figure", "unit", title=escape_text(title), title_justify="left")
    for column in ("before", "after", "95 % interval", "after / before"):
        figures.add_column(column, justify="right")
    unfitted, fitted = map(gap.figures, TWIN_SIDES)
    for name, interval in gap.intervals("after").items():
        metric = GAP_METRICS[name]
        ratio = "-"  # if there was nothing to lose
        if math.isfinite(fitted[name]) and abs(unfitted[name]) >= LEAST_GAP:
            ratio = f"{abs(fitted[name] / unfitted[name]):.1%}"
        numbers = (unfitted[name], fitted[name], *interval)
        cells = [_format_cell(number, metric.scale) for number in numbers]
        ends = "" if math.isnan(interval[0]) else " to ".join(cells[2:])
        figures.add_row(metric.label, metric.unit, *cells[:2], ends, ratio)

    # Both twins for each episode.
    logs = Table("log", "use", title="Each episode, before -> after", title_justify="left")
    logs.add_column("duration", justify="right")
    for column in ("wheel speeds", "end position", "against"):
        logs.add_column(column)
    for replay in gap.replays:
        cells = [escape_text(f"{replay.log} #{replay.episode}")]
        cells += ["fitted" if replay.fitted else "held out", f"{replay.seconds:.1f} s"]
        for name in ("wheel_speed_rms", "end_pose"):
            metric = GAP_METRICS[name]
            sizes = [_format_cell(replay.figures[side][name], metric.scale) for side in TWIN_SIDES]
            cells.append(f"{' -> '.join(sizes)} {metric.unit}")
        logs.add_row(*cells, "truth" if replay.truth else "odometry")
    return [figures, logs]


def format_gap(gap: TwinGap) -> dict[str, Any]:
    """Return the gap for JSON, in SI units. An unknown figure is null."""
    logs = []
    for replay in gap.replays:
        fields = replay._asdict()
        figures = fields.pop("figures")
        logs.append(fields | figures)

    document: dict[str, Any] = {
        "robot": gap.robot,
        "unfitted": gap.unfitted,
        "body": gap.body,
        "held_out": gap.held_out,
        "logs": logs,
        "notes": list(gap.notes),
        "conclusion": conclude_gap(gap),
    }
    for side in TWIN_SIDES:
        document[side] = {"figures": gap.figures(side), "intervals": gap.intervals(side)}
    formatted: dict[str, Any] = replace_nonfinite(document)
    return formatted
