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
"""The unfitted and the fitted twin."""
NOTED_PAUSE = 0.1
"""Longer pauses between commands are noted [s]."""
SHORTEST_EPISODE = 1.0
LONGEST_EPISODE = 4.0 * 3600.0
"""Shorter and longer episodes are left out [s]."""


class GapMetric(NamedTuple):
    """A figure of the gap: its name, and how it is shown."""

    label: str
    unit: str
    scale: float
    """Factor from SI to the unit."""
    resolution: float
    """Smaller values don't show in a log, in SI units."""
    rms: bool = False
    """Whether it is pooled as a root mean square. Otherwise it is a mean of sizes."""


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
"""Values of GAP_METRICS in SI units. NaN for a figure that a log doesn't show."""


def measure_figures(recorded: EpisodeTrack, twin: EpisodeTrack, period: float) -> GapFigures:
    """Compute the gap between a recorded track and a twin's that got the same commands.

    Args:
        recorded: The recorded track.
        twin: The twin's, on the same clock.
        period: Nominal period of the recorded feedback [s].

    Returns:
        A value for every metric, in SI units. `time_shift` is positive if the recorded robot is
        later than the twin. All other figures are sizes.
    """
    # Delays by this computer aren't part of the robot.
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
    """Return the root mean square. NaN without values."""
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else math.nan


def _end_distance(poses: Floats, twin_poses: Floats) -> float:
    """Return the distance of the last positions [m]. NaN if there are none."""
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
        weights: Their durations [s], for root mean squares. Other figures are means over episodes.
    """
    pooled = {}
    for name, metric in GAP_METRICS.items():
        # A log may lack a figure, such as the shift of wheels that hardly move.
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
    """A recorded episode, and how far both twins are from it."""

    log: str
    episode: int
    fitted: bool
    """Whether the robot's parameters were measured on this log."""
    seconds: float
    recorded: EpisodeTrack
    figures: Mapping[str, GapFigures]
    """Figures of each of `TWIN_SIDES`."""


@dataclass(frozen=True, eq=False)
class TwinGap:
    """The gaps of all logs."""

    robot: str
    """Name of the fitted robot."""
    before: str
    """Name of the unfitted robot."""
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
        """Return bootstrap intervals of the means over the judged episodes."""
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
        before: Name and config of the unfitted twin.
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
    notes = [f"{name}: {side.misfit}" for name, side in (robot, before) if side.misfit]
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
            replay = EpisodeReplay(
                log=log,
                episode=number,
                fitted=not fitted_logs.isdisjoint(recording.sources),
                seconds=float(episode.stamps[-1] - episode.stamps[0]),
                recorded=recorded,
                figures={
                    side: _measure_twin(resent, recorded, config, twin=twin, body=body)
                    for side, twin in zip(TWIN_SIDES, (before[1], config), strict=True)
                },
            )
            replays.append(replay)

    if not replays:
        raise ConfigError(notes[-1] if notes else f"{logs[0][0]}: holds no episode")
    if not all(replay.recorded.known for replay in replays):
        notes.append(
            "positions without a recorded true pose are by odometry of both, computed from the "
            f"wheel speeds with the geometry of {robot[0]}"
        )
    if all(replay.fitted for replay in replays):
        notes.append("the robot was fitted to all of these logs: none is held out")
    return TwinGap(robot[0], before[0], body, tuple(replays), tuple(notes))


def _measure_twin(
    episode: Episode, recorded: EpisodeTrack, config: RobotConfig, *, twin: RobotConfig, body: str
) -> GapFigures:
    """Replay an episode through a twin. Without a recorded truth, the odometry is compared."""
    track = make_twin_track(episode, config, twin=twin, body=body)
    if not recorded.known:
        track = replace(track, truth=np.full_like(track.truth, np.nan))
    return measure_figures(recorded, track, 1.0 / config.feedback_rate)


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
    wire = episode.wire
    times = (episode.stamps, wire.sent_stamps, wire.got_stamps)
    if not all((np.diff(stamps) >= 0.0).all() for stamps in times):
        return "its times go backwards: the file is damaged"
    if not len(wire.sent_stamps) or len(wire.feedback(config)[0]) < 3:
        return "holds no commands, or no feedback"
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
    unfitted, fitted = (gap.figures(side) for side in TWIN_SIDES)
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
    title = f"Gap of {gap.robot} (before: {gap.before}) on {kind}, twin: {gap.body}"

    # The figures of both twins.
    figures = Table("figure", "unit", title=escape_text(title), title_justify="left")
    for name in ("before", "after", "95 % interval", "after / before"):
        figures.add_column(name, justify="right")
    unfitted, fitted = (gap.figures(side) for side in TWIN_SIDES)
    intervals = gap.intervals("after")
    for name, metric in GAP_METRICS.items():
        ratio = "-"  # if there was nothing to lose
        if math.isfinite(fitted[name]) and abs(unfitted[name]) >= metric.resolution:
            ratio = f"{abs(fitted[name] / unfitted[name]):.1%}"
        numbers = (unfitted[name], fitted[name], *intervals[name])
        low_to_high = [_format_cell(number, metric.scale) for number in numbers]
        interval = "" if math.isnan(intervals[name][0]) else " to ".join(low_to_high[2:])
        figures.add_row(metric.label, metric.unit, *low_to_high[:2], interval, ratio)

    # Both twins for each episode.
    logs = Table("log", "use", title="Each episode, before -> after", title_justify="left")
    logs.add_column("duration", justify="right")
    for name in ("wheel speeds", "end position", "against"):
        logs.add_column(name)
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
    """Return the gap for JSON, in SI units. An unknown figure is null."""
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
        "logs": logs,
        "notes": list(gap.notes),
        "conclusion": conclude_gap(gap),
    }
    for side in TWIN_SIDES:
        document[side] = {"figures": gap.figures(side), "intervals": gap.intervals(side)}
    formatted: dict[str, Any] = replace_nonfinite(document)
    return formatted
