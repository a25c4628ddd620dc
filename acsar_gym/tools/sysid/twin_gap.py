"""The gap between recorded robots and their twins, before and after fitting, as tables and JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Episode, Recording
from acsar_gym.tools.evaluation.metrics import Interval, bootstrap_interval, replace_nonfinite
from acsar_gym.tools.evaluation.report import escape_text
from acsar_gym.tools.sysid.board_log import Floats, resend_twists
from acsar_gym.tools.sysid.pairs import check_same_robot, find_difference
from acsar_gym.tools.sysid.tracks import (
    EpisodeTrack,
    interpolate,
    make_recorded_track,
    make_twin_track,
)
from acsar_gym.tools.sysid.twin_replay import remove_jitter

TIME_SHIFTS = np.arange(-0.2, 0.2001, 0.001)
"""Time shifts that are tried [s]."""
MOVING_SPEED = 0.2
"""Wheels that never differ by more than this from their mean don't show a time shift [rad/s]."""
TWIN_SIDES = ("before", "after")
GAP_COLUMNS = ("figure", "unit", "before", "after", "95 % interval", "after / before")
LOG_COLUMNS = ("log", "use", "duration", "wheel speeds", "end position", "against")
NOTED_PAUSE = 0.1
"""Longer pauses between commands are noted [s]."""
SHORTEST_EPISODE = 1.0
LONGEST_EPISODE = 4.0 * 3600.0
"""Shorter and longer episodes are left out [s]."""


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
"""The figures by name, in SI units."""
GapFigures = dict[str, float]
"""Values of GAP_METRICS in SI units; NaN for what a log doesn't show."""


def measure_figures(recorded: EpisodeTrack, twin: EpisodeTrack, period: float) -> GapFigures:
    """Compute the gap between a recorded track and a twin's that got the same commands.

    Args:
        recorded: The recorded track.
        twin: The twin's, on the same clock.
        period: Nominal period of the recorded feedback [s].

    Returns:
        A value for every metric, in SI units. `time_shift` is positive if the recorded robot is
        later than the twin; the others are sizes.
    """
    stamps = remove_jitter(recorded.feedback_stamps, period)
    twin_stamps = remove_jitter(twin.feedback_stamps, period)
    twists = recorded.twists - interpolate(stamps, twin_stamps, twin.twists)
    yaw = recorded.poses[:, 2] - twin.poses[:, 2]

    return {
        "wheel_speed_rms": _rms(
            recorded.feedback - interpolate(stamps, twin_stamps, twin.feedback)
        ),
        "linear_rms": _rms(twists[:, 0]),
        "angular_rms": _rms(twists[:, 1]),
        "yaw_rms": _rms(yaw),
        "end_pose": _end_distance(recorded.poses, twin.poses),
        "end_yaw": abs(float(yaw[-1])) if len(yaw) else math.nan,
        "end_odometry": _end_distance(recorded.odometry, twin.odometry),
        "time_shift": find_time_shift(stamps, recorded.feedback, twin_stamps, twin.feedback),
    }


def _rms(values: Floats) -> float:
    """The root mean square; NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


def _end_distance(poses: Floats, twin_poses: Floats) -> float:
    """The distance of the last positions [m]; NaN if there are none."""
    if not len(poses) or not len(twin_poses):
        return math.nan
    return float(np.hypot(*(poses[-1, :2] - twin_poses[-1, :2])))


def find_time_shift(
    stamps: Floats, speeds: Floats, twin_stamps: Floats, twin_speeds: Floats
) -> float:
    """Return by how much the twin's wheel speeds must be delayed to fit the recorded ones best [s].

    NaN if the wheels hardly move, or nothing within +-0.2 s fits best.
    """
    if len(stamps) < 3 or len(twin_stamps) < 3 or np.ptp(speeds, axis=0).max() < MOVING_SPEED:
        return math.nan
    costs = np.array(
        [_rms(speeds - interpolate(stamps - s, twin_stamps, twin_speeds)) for s in TIME_SHIFTS]
    )
    best = int(np.argmin(costs))
    if not 0 < best < len(TIME_SHIFTS) - 1:
        return math.nan

    # The minimum of a parabola through the best shift and its neighbours.
    earlier, middle, later = np.square(costs[best - 1 : best + 2])
    bend = earlier - 2.0 * middle + later
    offset = 0.5 * (earlier - later) / bend if bend > 0.0 else 0.0
    return float(TIME_SHIFTS[best] + offset * (TIME_SHIFTS[1] - TIME_SHIFTS[0]))


def pool_figures(rows: Sequence[GapFigures], weights: Sequence[float]) -> GapFigures:
    """Combine figures of several episodes.

    Args:
        rows: Figures of each episode.
        weights: Their durations [s], for root mean squares; the others are means over episodes.
    """
    pooled = {}
    for name, metric in GAP_METRICS.items():
        values = np.array([row[name] for row in rows])
        finite = np.isfinite(values)
        if not finite.any():
            pooled[name] = math.nan
        elif metric.rms:
            mean_square = np.average(values[finite] ** 2, weights=np.array(weights)[finite])
            pooled[name] = math.sqrt(mean_square)
        else:
            pooled[name] = float(values[finite].mean())
    return pooled


@dataclass(frozen=True, eq=False)
class EpisodeReplay:
    """One recorded episode, and how far both twins are from it."""

    log: str
    episode: int
    fitted: bool
    """Whether the robot's parameters were measured on this log."""
    seconds: float
    recorded: EpisodeTrack
    figures: Mapping[str, GapFigures]
    """By side: "before" and "after"."""


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
        """The held-out episodes, or all if none is held out."""
        return tuple(r for r in self.replays if not (self.held_out and r.fitted))

    def figures(self, side: str) -> GapFigures:
        """Return the figures of "before" or "after" over all judged episodes."""
        judged = self.judged
        return pool_figures([r.figures[side] for r in judged], [r.seconds for r in judged])

    def intervals(self, side: str) -> dict[str, Interval]:
        """Return bootstrap intervals of the means over the judged episodes; NaN for one."""
        rows = [replay.figures[side] for replay in self.judged]
        return {name: bootstrap_interval([row[name] for row in rows]) for name in GAP_METRICS}


def measure_gap(
    logs: Sequence[tuple[str, Recording]],
    robot: tuple[str, RobotConfig],
    before: tuple[str, RobotConfig],
    body: str = "planar",
) -> TwinGap:
    """Replay the commands of logs through two twins, and compare both with what was recorded.

    Args:
        logs: Names and recordings.
        robot: Name and config of the fitted twin.
        before: Name and config of the unfitted one.
        body: Physics of both, such as "planar".

    Raises:
        ConfigError: the logs are of different robots, or hold nothing that can be compared.
    """
    check_same_robot(logs, "compare logs of")
    config = robot[1]
    fitted_on = {
        *config.motor_fit_logs,
        *(log for measured in config.measured.values() for log in measured.logs),
    }
    notes = _note_limits(logs, robot, before, known=bool(fitted_on))

    replays = []
    for log, recording in logs:
        for number, episode in enumerate(recording.episodes):
            if why := _find_unusable(episode, config):
                notes.append(f"{log} #{number}: left out, {why}")
                continue
            pause = float(np.diff(episode.wire.sent_stamps).max(initial=0.0))
            if pause > NOTED_PAUSE:
                notes.append(f"{log} #{number}: no command was sent for {pause:.2f} s")
            wire = resend_twists(episode.wire, recording.config, config)
            recorded, figures = _replay(replace(episode, wire=wire), config, before[1], body)
            replay = EpisodeReplay(
                log=log,
                episode=number,
                fitted=not fitted_on.isdisjoint(recording.sources),
                seconds=float(episode.stamps[-1] - episode.stamps[0]),
                recorded=recorded,
                figures=figures,
            )
            replays.append(replay)

    if not replays:
        raise ConfigError(notes[-1] if notes else f"{logs[0][0]}: holds no episode")
    if all(replay.fitted for replay in replays):
        notes.append("the robot was fitted to all of these logs: none is held out")
    return TwinGap(robot[0], before[0], body, tuple(replays), tuple(notes))


def _replay(
    episode: Episode, config: RobotConfig, before: RobotConfig, body: str
) -> tuple[EpisodeTrack, dict[str, GapFigures]]:
    """Replay one episode through both twins."""
    recorded = make_recorded_track(episode, config)
    figures = {}
    for side, twin in zip(TWIN_SIDES, (before, config), strict=True):
        track = make_twin_track(episode, config, twin=twin, body=body)
        if not recorded.known:  # then the odometry of both is compared
            track = replace(track, truth=np.full_like(track.truth, np.nan))
        figures[side] = measure_figures(recorded, track, 1.0 / config.feedback_rate)
    return recorded, figures


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
                note += f", as held out, although {robot[0]} may be fitted to the whole of it"
            notes.append(note)
        if recording.dropped:
            notes.append(f"{name}: {recording.dropped:,} ticks are missing")
        if recording.damages:
            notes.append(f"{name}: {recording.describe_damage()}")
        difference = find_difference(recording.config, robot[1], wire=True)
        if difference is not None:
            field, recorded, fitted = difference
            notes.append(f"{name}: recorded with {field} = {recorded}, {robot[0]}: {fitted}")

    episodes = [episode for _, recording in logs for episode in recording.episodes]
    if not all(np.isfinite(episode.truth).all() for episode in episodes):
        notes.append(
            "positions without a recorded true pose are by odometry of both, computed from the "
            f"wheel speeds with the geometry of {robot[0]}"
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


def conclude_gap(gap: TwinGap) -> str:
    """Say in a line how far the twin is from the robot."""
    judged = gap.judged
    seconds = sum(replay.seconds for replay in judged)
    kind = "held-out" if gap.held_out else "fitted"
    unfitted, fitted = (gap.figures(side) for side in TWIN_SIDES)
    wheels, ends = (
        f"from {unfitted[name] * scale:.2f} to {fitted[name] * scale:.2f}"
        for name, scale in (("wheel_speed_rms", 1.0), ("end_pose", 100.0))
    )
    episodes = f"{len(judged)} {kind} episode{'s' * (len(judged) != 1)}, {seconds:.0f} s"
    return f"{episodes}: wheel speeds {wheels} rad/s RMS, position at the end {ends} cm"


def _format_cell(value: float, scale: float = 1.0) -> str:
    """Format a number with three digits; "-" for NaN."""
    if math.isnan(value):
        return "-"
    return "0" if abs(value * scale) < 1e-6 else f"{value * scale:.3g}"


def gap_tables(gap: TwinGap) -> list[Table]:
    """Make the tables of a gap: figures, and the logs."""
    kind = "held-out logs" if gap.held_out else "logs that the robot was fitted to"
    title = f"Gap of {gap.robot} (before: {gap.before}) on {kind}, twin: {gap.body}"
    figures = Table(title=escape_text(title), title_justify="left")
    for name in GAP_COLUMNS:
        figures.add_column(name, justify="left" if name in ("figure", "unit") else "right")
    unfitted, fitted = (gap.figures(side) for side in TWIN_SIDES)
    intervals = gap.intervals("after")
    for name, metric in GAP_METRICS.items():
        ratio = "-"  # if there was nothing to lose
        if math.isfinite(fitted[name]) and abs(unfitted[name]) >= metric.resolution:
            ratio = f"{abs(fitted[name] / unfitted[name]):.1%}"
        ends = [_format_cell(end, metric.scale) for end in intervals[name]]
        interval = "" if math.isnan(intervals[name][0]) else " to ".join(ends)
        cells = [_format_cell(side[name], metric.scale) for side in (unfitted, fitted)]
        figures.add_row(metric.label, metric.unit, *cells, interval, ratio)

    logs = Table(title="Each episode, before -> after", title_justify="left")
    for name in LOG_COLUMNS:
        logs.add_column(name, justify="right" if name == "duration" else "left")
    for replay in gap.replays:
        speeds, positions = (
            " -> ".join(_format_cell(replay.figures[side][name], scale) for side in TWIN_SIDES)
            for name, scale in (("wheel_speed_rms", 1.0), ("end_pose", 100.0))
        )
        use = "fitted" if replay.fitted else "held out"
        against = "truth" if replay.recorded.known else "odometry"
        cells = [f"{replay.seconds:.1f} s", f"{speeds} rad/s", f"{positions} cm", against]
        logs.add_row(escape_text(f"{replay.log} #{replay.episode}"), use, *cells)
    return [figures, logs]


def format_gap(gap: TwinGap) -> dict[str, Any]:
    """Return the gap for JSON, in SI units; what isn't known is null."""
    sides = {
        side: {"figures": gap.figures(side), "intervals": gap.intervals(side)}
        for side in TWIN_SIDES
    }
    logs = [
        {
            "log": replay.log,
            "episode": replay.episode,
            "fitted": replay.fitted,
            "seconds": replay.seconds,
            "truth": replay.recorded.known,
            **replay.figures,
        }
        for replay in gap.replays
    ]

    document: dict[str, Any] = {
        "robot": gap.robot,
        "unfitted": gap.before,
        "body": gap.body,
        "held_out": gap.held_out,
        **sides,
        "logs": logs,
        "notes": list(gap.notes),
        "conclusion": conclude_gap(gap),
    }
    formatted: dict[str, Any] = replace_nonfinite(document)
    return formatted
