"""The gap between recorded robots and their twins, before and after fitting, as tables and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from rich.table import Column, Table

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording.types import Episode, Floats, Recording
from acsar_gym.tools.evaluation.metrics import bootstrap_interval, replace_nonfinite
from acsar_gym.tools.evaluation.report import escape_text, title_line
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

    def format(self, value: float) -> str:
        """Format a value in SI units with three digits. "-" for NaN."""
        if math.isnan(value):
            return "-"
        scaled = value * self.scale
        return "0" if abs(scaled) < 1e-6 else f"{scaled:.3g}"


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
    off = recorded.truth - twin.truth if recorded.has_truth else drift
    twists = recorded.twists - interpolate(recorded.stamps, twin.stamps, twin.twists)
    return {
        "wheel_speed_rms": _measure_speed_gap(recorded, twin),
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


def _measure_speed_gap(recorded: EpisodeTrack, twin: EpisodeTrack, shift: float = 0.0) -> float:
    """Return the RMS difference of the wheel speeds if the twin's are later by `shift` [s]."""
    shifted = interpolate(recorded.stamps - shift, twin.stamps, twin.speeds)
    return _rms(recorded.speeds - shifted)


def find_time_shift(recorded: EpisodeTrack, twin: EpisodeTrack) -> float:
    """Return by how much the twin's wheel speeds must be delayed to fit the recorded ones best [s].

    NaN if the wheels hardly move, or nothing within +-0.2 s fits best.
    """
    if np.ptp(recorded.speeds, axis=0).max() < MOVING_SPEED:
        return math.nan
    # Every shift is tried, as the cost has several minima for periodic drives.
    costs = np.square([_measure_speed_gap(recorded, twin, shift) for shift in TIME_SHIFTS])
    best = int(np.argmin(costs))
    if not 0 < best < len(TIME_SHIFTS) - 1:
        return math.nan

    # The minimum of a parabola through the best shift and its neighbours.
    curvature, slope, _ = np.polyfit([-1, 0, 1], costs[best - 1 : best + 2], 2)
    step = TIME_SHIFTS[1] - TIME_SHIFTS[0]
    return float(TIME_SHIFTS[best] - step * slope / (2.0 * curvature))


@dataclass(frozen=True)
class EpisodeReplay:
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
    """The gaps of all logs, as `format_gap` writes them."""

    robot: str
    """Name of the fitted robot."""
    unfitted: str
    """Name of the unfitted robot."""
    body: str
    held_out: bool
    """Whether there is any log that the robot wasn't fitted to."""
    logs: Sequence[EpisodeReplay]
    notes: Sequence[str]

    @property
    def judged(self) -> list[EpisodeReplay]:
        """The held-out episodes, or all if none is held out."""
        return [replay for replay in self.logs if replay.fitted != self.held_out]

    def values(self, side: str, name: str) -> list[float]:
        """Return a figure of the twin "before" or "after" for each judged episode."""
        return [replay.figures[side][name] for replay in self.judged]

    def figures(self, side: str) -> GapFigures:
        """Return the figures of "before" or "after" over all judged episodes.

        Root mean squares are weighted by the episodes' durations. Other figures are means.
        """
        seconds = [replay.seconds for replay in self.judged]
        pooled = {}
        for name, metric in GAP_METRICS.items():
            # A log may lack a figure, such as the shift of wheels that hardly move.
            values = np.ma.masked_invalid(self.values(side, name))
            mean = values.mean()
            if metric.rms:
                mean = np.ma.sqrt(np.ma.average(values**2, weights=seconds))
            pooled[name] = float(np.ma.filled(mean, math.nan))
        return pooled


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
    name, config = robot
    twins = dict(zip(TWIN_SIDES, (unfitted[1], config), strict=True))

    # Logs that the robot's file names can't show how good it is.
    intervals = config.measured.values()
    fitted_logs = set(config.motor_fit_logs).union(*(interval.logs for interval in intervals))
    notes = [f"{side}: {twin.misfit}" for side, twin in (robot, unfitted) if twin.misfit]
    for log, recording in logs:
        notes += _note_limits(log, recording, robot, has_logs=bool(fitted_logs))

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
            figures = {
                side: measure_figures(recorded, make_twin_track(resent, config, twin, body))
                for side, twin in twins.items()
            }
            replay = EpisodeReplay(
                log=log,
                episode=number,
                fitted=not fitted_logs.isdisjoint(recording.sources),
                seconds=float(np.ptp(episode.stamps)),
                truth=recorded.has_truth,
                figures=figures,
            )
            replays.append(replay)

    if not replays:
        raise ConfigError(notes[-1] if notes else f"{logs[0][0]}: holds no episode")
    if not all(replay.truth for replay in replays):
        notes.append(
            "positions without a recorded true pose are by odometry of both, computed from the "
            f"wheel speeds with the geometry of {name}"
        )
    held_out = not all(replay.fitted for replay in replays)
    if not held_out:
        notes.append("the robot was fitted to all of these logs: none is held out")
    return TwinGap(name, unfitted[0], body, held_out, logs=replays, notes=notes)


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
    if np.ptp(np.concatenate(times)) > LONGEST_EPISODE:
        return f"is longer than {LONGEST_EPISODE / 3600.0:g} h"
    return ""


def conclude_gap(gap: TwinGap) -> str:
    """State in a line how far the twin is from the robot."""
    count = len(gap.judged)
    seconds = sum(replay.seconds for replay in gap.judged)
    kind = "held-out" if gap.held_out else "fitted"
    unfitted, fitted = map(gap.figures, TWIN_SIDES)
    return (
        f"{count} {kind} episode{'s' * (count != 1)}, {seconds:.0f} s: wheel speeds from "
        f"{unfitted['wheel_speed_rms']:.2f} to {fitted['wheel_speed_rms']:.2f} rad/s RMS, position "
        f"at the end from {100.0 * unfitted['end_pose']:.2f} to {100.0 * fitted['end_pose']:.2f} cm"
    )


def gap_tables(gap: TwinGap) -> list[Table]:
    """Make the tables of a gap: figures, and the logs."""
    kind = "held-out logs" if gap.held_out else "logs that the robot was fitted to"
    title = f"Gap of {gap.robot} (before: {gap.unfitted}) on {kind}, twin: {gap.body}"

    # The figures of both twins.
    columns = ("before", "after", "95 % interval", "after / before")
    numbers = (Column(column, justify="right") for column in columns)
    figures = Table("figure", "unit", *numbers, title=title_line(title), title_justify="left")
    unfitted, fitted = map(gap.figures, TWIN_SIDES)
    for name, metric in GAP_METRICS.items():
        low, high = map(metric.format, bootstrap_interval(gap.values("after", name)))
        ends = "" if low == "-" else f"{low} to {high}"
        ratio = "-"  # if there was nothing to lose
        if math.isfinite(fitted[name]) and abs(unfitted[name]) >= LEAST_GAP:
            ratio = f"{abs(fitted[name] / unfitted[name]):.1%}"
        sizes = (metric.format(side[name]) for side in (unfitted, fitted))
        figures.add_row(metric.label, metric.unit, *sizes, ends, ratio)

    # Both twins for each episode.
    duration = Column("duration", justify="right")
    texts = ("wheel speeds", "end position", "against")
    title = "Each episode, before -> after"
    logs = Table("log", "use", duration, *texts, title=title, title_justify="left")
    for replay in gap.logs:
        cells = [escape_text(f"{replay.log} #{replay.episode}")]
        cells += ["fitted" if replay.fitted else "held out", f"{replay.seconds:.1f} s"]
        for name in ("wheel_speed_rms", "end_pose"):
            metric = GAP_METRICS[name]
            sizes = (metric.format(replay.figures[side][name]) for side in TWIN_SIDES)
            cells.append(f"{' -> '.join(sizes)} {metric.unit}")
        logs.add_row(*cells, "truth" if replay.truth else "odometry")
    return [figures, logs]


def format_gap(gap: TwinGap) -> dict[str, Any]:
    """Return the gap for JSON, in SI units. An unknown figure is null."""
    document = asdict(gap)
    # Figures of both twins are keys of their log, next to its name.
    document["logs"] = [log | log.pop("figures") for log in document["logs"]]
    document["conclusion"] = [conclude_gap(gap)]
    for side in TWIN_SIDES:
        intervals = {name: bootstrap_interval(gap.values(side, name)) for name in GAP_METRICS}
        document[side] = {"figures": gap.figures(side), "intervals": intervals}
    formatted: dict[str, Any] = replace_nonfinite(document)
    return formatted
