"""The gap between recorded robots and their twins, before and after fitting."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.evaluation.metrics import Interval
from acsar_gym.gap import tracks
from acsar_gym.gap.delays import Floats, TwoSample, lag, too_few_steps, two_sample
from acsar_gym.gap.figures import Figures, figures, intervals, pooled
from acsar_gym.gap.tracks import Track
from acsar_gym.recording.alike import check_same, differing
from acsar_gym.recording.types import Episode, Recording

SIDES = ("before", "after")
PAUSE = 0.1
"""Longer pauses between commands are noted [s]."""
SHORTEST = 1.0
"""Shorter episodes are left out [s]."""


@dataclass(frozen=True, eq=False)
class Replay:
    """One recorded episode, and both twins that got the same commands."""

    log: str
    episode: int
    fitted: bool
    """Whether the robot's parameters were measured on this log."""
    seconds: float
    recorded: Track
    twins: Mapping[str, Track]
    """By side: "before" and "after"."""
    figures: Mapping[str, Figures]

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
class Gap:
    """The gaps of all logs."""

    robot: str
    """What the fitted twin was made of."""
    before: str
    """What the unfitted twin was made of."""
    body: str
    replays: tuple[Replay, ...]
    notes: tuple[str, ...]

    @property
    def held_out(self) -> bool:
        """Whether there is any log that the robot wasn't fitted to."""
        return any(not replay.fitted for replay in self.replays)

    @property
    def judged(self) -> tuple[Replay, ...]:
        """The held-out episodes, or all where none is held out."""
        return tuple(r for r in self.replays if not (self.held_out and r.fitted))

    def figures(self, side: str) -> Figures:
        """Return the figures of "before" or "after" over all judged episodes."""
        judged = self.judged
        return pooled([r.figures[side] for r in judged], [r.seconds for r in judged])

    def intervals(self, side: str) -> dict[str, Interval]:
        """Return bootstrap intervals of the figures' means over the judged episodes."""
        return intervals([replay.figures[side] for replay in self.judged])

    def delays(self, side: str) -> TwoSample:
        """Test whether the robot's delays differ from the twin's, over the judged episodes."""
        pairs = [replay.delays(side) for replay in self.judged]
        return two_sample(*(np.concatenate(samples) for samples in zip(*pairs, strict=True)))


def measure(
    logs: Sequence[tuple[str, Recording]],
    robot: tuple[str, RobotConfig],
    before: tuple[str, RobotConfig | None],
    body: str = "planar",
) -> Gap:
    """Replay the commands of logs through two twins, and compare both with what was recorded.

    Args:
        logs: names and recordings.
        robot: name and config of the fitted twin.
        before: name and config of the unfitted one; None for the config in each recording.
        body: physics of both, "planar" or "bullet".

    Raises:
        ConfigError: the logs are of different robots, or hold nothing that can be compared.
    """
    check_same(logs, "compare logs of")
    fitted_on = {sha256 for one in robot[1].measured.values() for sha256 in one.logs}
    replays, notes = [], _notes(logs, robot)
    for name, recording in logs:
        twins = {"before": before[1] or recording.config, "after": robot[1]}
        for number, episode in enumerate(recording.episodes):
            if why := _unusable(episode, robot[1]):
                notes.append(f"{name} #{number}: left out, {why}")
                continue
            notes += _paused(f"{name} #{number}", episode)
            fitted = recording.sha256 in fitted_on
            replays.append(_replay(name, number, fitted, episode, twins, body))
    if not replays:
        raise ConfigError(notes[-1] if notes else f"{logs[0][0]}: holds no episode")
    if all(replay.fitted for replay in replays):
        notes.append("the robot was fitted to all of these logs: none is held out")
    return Gap(robot[0], before[0], body, tuple(replays), tuple(notes))


def _cut(name: str, robot: tuple[str, RobotConfig]) -> str:
    """Say that a recording was cut, and that it isn't recognized as one that was fitted."""
    told = f"{name}: its end is missing; the rest was used"
    if not any(one.logs for one in robot[1].measured.values()):
        return told
    return f"{told}, as held out: it can't be told whether {robot[0]} was fitted to the whole of it"


def _is_true(episode: Episode) -> bool:
    """Whether the true poses of an episode are known."""
    return bool(np.isfinite(episode.truth).all())


def _notes(logs: Sequence[tuple[str, Recording]], robot: tuple[str, RobotConfig]) -> list[str]:
    """Say what limits the comparison."""
    notes = []
    for name, recording in logs:
        if recording.cut:
            notes.append(_cut(name, robot))
        if recording.dropped:
            notes.append(f"{name}: {recording.dropped:,} ticks are missing")
        found = differing(recording.config, robot[1], wire=True)
        if found is not None:
            field, own, other = found
            notes.append(f"{name}: recorded with {field} = {own}, {robot[0]}: {other}")
    if not all(_is_true(episode) for _, recording in logs for episode in recording.episodes):
        notes.append(
            f"where no true pose was recorded, positions are by odometry of both, computed anew "
            f"from the wheel speeds with the geometry of {robot[0]}"
        )
    return notes


def _paused(name: str, episode: Episode) -> list[str]:
    """Say where commands stopped for long, as on a computer that was busy."""
    longest = float(np.diff(episode.wire.sent_stamps).max(initial=0.0))
    return [f"{name}: no command was sent for {longest:.2f} s"] if longest > PAUSE else []


def _unusable(episode: Episode, config: RobotConfig) -> str:
    """Say why an episode can't be replayed; empty if it can."""
    if why := tracks.damage(episode):
        return why
    lasts = float(episode.stamps[-1] - episode.stamps[0])
    if lasts < SHORTEST - 2.0 * config.period:
        return f"holds less than {SHORTEST:g} s"
    if not len(episode.wire.sent_stamps) or len(episode.wire.feedback(config)[0]) < 3:
        return "holds no commands, or no feedback"
    return ""


def _replay(
    log: str,
    number: int,
    fitted: bool,
    episode: Episode,
    twins: Mapping[str, RobotConfig],
    body: str,
) -> Replay:
    """Replay one episode through both twins."""
    robot = twins["after"]
    recorded = tracks.recorded(episode, robot)
    own = {side: tracks.twin(episode, robot, twins[side], body) for side in SIDES}
    if not recorded.known:  # like with like
        own = {side: track.by_odometry() for side, track in own.items()}
    period = 1.0 / robot.feedback_rate
    found = {side: figures(recorded, track, period) for side, track in own.items()}
    seconds = float(episode.stamps[-1] - episode.stamps[0])
    return Replay(log, number, fitted, seconds, recorded, own, found)


def conclusion(gap: Gap) -> list[str]:
    """Say in a few lines how far the twin is from the robot."""
    judged = gap.judged
    seconds = sum(replay.seconds for replay in judged)
    kind = "held-out" if gap.held_out else "fitted"
    before, after = gap.figures("before"), gap.figures("after")
    episodes = f"{len(judged)} {kind} episode{'s' * (len(judged) != 1)}, {seconds:.0f} s"
    wheels = _fall(before, after, "wheel_speed_rms", "rad/s", 1.0)
    ends = _fall(before, after, "end_pose", "cm", 100.0)
    return [
        f"{episodes}: wheel speeds {wheels} RMS, position at the end {ends}",
        _about_delays(gap.delays("after")),
    ]


def _fall(before: Figures, after: Figures, name: str, unit: str, scale: float) -> str:
    """Format the change of a figure."""
    return f"from {before[name] * scale:.2f} to {after[name] * scale:.2f} {unit}"


def _about_delays(test: TwoSample) -> str:
    """Say whether the fitted twin's delays are those of the robot."""
    if math.isnan(test.p_value):
        return too_few_steps(test)
    by = lag(test.difference)
    if test.differs:
        return f"delays differ: the robot answers {by} than its twin (p = {test.p_value:.2g})"
    return f"delays don't differ measurably: {by} than the twin on average (p = {test.p_value:.2g})"
