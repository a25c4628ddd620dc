"""Tracks: both sides of an episode, robot and twin, and the delays of its answers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.odometry import Odometry
from acsar_gym.recording.twin_replay import replay_commands
from acsar_gym.recording.types import Episode, Recording, WireLog
from acsar_gym.tools.evaluation.episode import read_true_poses
from acsar_gym.tools.sysid.board_log import Floats
from acsar_gym.worlds.world import to_odometry

STEP_HELD = 0.15
"""A command counts as a step if the one before was held at least this long [s]."""
HELD_CHANGE = 0.05
"""Smaller changes of a commanded wheel speed count as held [rad/s]."""
STEP_SHOWN = 0.4
"""Change of a wheel's speed whose time is taken, in the commands and in the lines [rad/s]."""
STEADY_SPREAD = 0.3
"""Steps are left out if the measured speeds varied by more than this before them [rad/s]."""
LONGEST_DELAY = 1.0
"""Steps that no line shows within this time are left out [s]."""
FEWEST_DELAYS = 5
"""Fewest delays on each side for a test."""
DELAY_CONFIDENCE = 0.95
DELAY_RESOLUTION = 0.001
"""Distributions that are nowhere further apart than this count as equal [s]: stamps have jitter."""


def measure_delays(
    command_stamps: Floats, commands: Floats, feedback_stamps: Floats, feedback: Floats
) -> Floats:
    """Measure how long after a step of the command the feedback shows it.

    A step begins after a wheel's speed was held for `STEP_HELD`, whatever the other wheels did, and
    may be a ramp; wheels that begin with the same command are one step. Its delay is the time from
    the command in which the first of its wheels has changed by `STEP_SHOWN` to the line in which it
    has, so it includes the wire, the board, the motor's start and the wait for the next line.

    Args:
        command_stamps: (n,) times at which command lines were written [s].
        commands: (n, 4) commanded wheel speeds [rad/s].
        feedback_stamps: (k,) times at which feedback lines arrived [s], on the same clock.
        feedback: (k, 4) measured wheel speeds [rad/s].

    Returns:
        (m,) delays [s], one for each row of `find_steps` with a step; NaN where its wheels weren't
        steady before it, their command changes by less, or no line shows it.
    """
    begun = find_steps(command_stamps, commands)
    begins = np.flatnonzero(begun.any(axis=1))
    found = np.full(len(begins), math.nan)
    for number, begin in enumerate(begins.tolist()):
        later = np.flatnonzero(begun[begin + 1 :, begun[begin]].any(axis=1))
        end = begin + 1 + int(later[0]) if len(later) else len(commands)
        changes = np.where(begun[begin], commands[begin:end] - commands[begin - 1], 0.0)
        passed = np.flatnonzero(np.abs(changes).max(axis=1) >= STEP_SHOWN)
        if not len(passed):
            continue
        change, time = changes[passed[0]], command_stamps[begin + passed[0]]
        wheels = np.abs(change) >= STEP_SHOWN
        first = int(np.searchsorted(feedback_stamps, command_stamps[begin], side="right"))
        steady = int(np.searchsorted(feedback_stamps, command_stamps[begin] - STEP_HELD))
        before = feedback[steady:first]
        if not len(before) or np.ptp(before[:, wheels], axis=0).max() > STEADY_SPREAD:
            continue
        last = int(np.searchsorted(feedback_stamps, time + LONGEST_DELAY, side="right"))
        moved = ((feedback[first:last] - before[-1]) * np.sign(change))[:, wheels]
        shown = np.flatnonzero(moved.max(axis=1, initial=0.0) >= STEP_SHOWN)
        if len(shown):
            found[number] = feedback_stamps[first + shown[0]] - time
    return found


def find_steps(stamps: Floats, commands: Floats) -> NDArray[np.bool_]:
    """Return in which commands each wheel's differs from one held for `STEP_HELD` before, (n, 4).

    A log that begins with zeros begins at rest, so these count as held.
    """
    begun = np.zeros(commands.shape, np.bool_)
    if len(stamps) < 2:
        return begun
    for wheel, speeds in enumerate(commands.T):
        changes = np.flatnonzero(np.abs(np.diff(speeds)) > HELD_CHANGE) + 1
        begin = stamps[0] if np.any(commands[0]) else -math.inf
        held = np.diff(stamps[changes], prepend=begin)
        begun[changes[held >= STEP_HELD - 1e-9], wheel] = True
    return begun


class DelayComparison(NamedTuple):
    """Two samples of delays, and a test of whether they differ by more than `DELAY_RESOLUTION`.

    Two one-sided Kolmogorov-Smirnov tests: whether the second sample is later than the first one
    moved by `DELAY_RESOLUTION`, or earlier than the first one moved the other way.
    """

    counts: tuple[int, int]
    means: tuple[float, float]
    """[s]; NaN for an empty sample."""
    difference: float
    """Mean of the second sample minus that of the first [s]."""
    p_value: float
    """Of both tests together (Bonferroni); NaN if a sample has under `FEWEST_DELAYS`."""

    @property
    def differs(self) -> bool:
        """Whether the test tells the samples apart at 5 %."""
        return self.p_value < 1.0 - DELAY_CONFIDENCE


def compare_delays(first: Floats, second: Floats) -> DelayComparison:
    """Compare two samples of delays [s]; NaN is left out."""
    first, second = first[np.isfinite(first)], second[np.isfinite(second)]
    counts = (len(first), len(second))
    before, after = (float(one.mean()) if len(one) else math.nan for one in (first, second))
    if min(counts) < FEWEST_DELAYS:
        return DelayComparison(counts, (before, after), after - before, math.nan)
    with require_extra("a gap report", "scipy"):
        from scipy.stats import ks_2samp  # noqa: PLC0415 - slow to import

    later = ks_2samp(first + DELAY_RESOLUTION, second, alternative="greater")
    earlier = ks_2samp(first - DELAY_RESOLUTION, second, alternative="less")
    p_value = min(1.0, 2.0 * min(float(later.pvalue), float(earlier.pvalue)))
    return DelayComparison(counts, (before, after), after - before, p_value)


def format_lag(difference: float) -> str:
    """Format by how much the second side is later or earlier than the first [s]."""
    return f"{abs(difference) * 1000.0:.1f} ms {'later' if difference > 0.0 else 'earlier'}"


def explain_few_steps(test: DelayComparison) -> str:
    """Say that a test wasn't possible, and what to drive for one."""
    return (
        f"delays: only {min(test.counts)} steps of the command, too few to compare: record speeds "
        "that are held for 0.5 s, then jump by 2 rad/s or more"
    )


@dataclass(frozen=True, eq=False)
class EpisodeTrack:
    """One side of an episode, on the clock of its recording; k feedback lines, n ticks."""

    command_stamps: Floats
    """(c,) times of the command lines [s]."""
    commands: Floats
    """(c, 4) commanded wheel speeds [rad/s]."""
    feedback_stamps: Floats
    """(k,) times at which feedback lines arrived [s]."""
    feedback: Floats
    """(k, 4) measured wheel speeds [rad/s]."""
    twists: Floats
    """(k, 2) twist by odometry at each line: linear [m/s], angular [rad/s]."""
    stamps: Floats
    """(n,) ends of the ticks [s]."""
    odometry: Floats
    """(n, 3) x [m], y [m], theta [rad, unwrapped] by odometry, from the origin on."""
    truth: Floats
    """(n, 3) true pose, likewise from the origin on; NaN on hardware."""

    @property
    def known(self) -> bool:
        """Whether the true pose is known."""
        return bool(len(self.truth)) and bool(np.isfinite(self.truth).all())

    @property
    def poses(self) -> Floats:
        """(n, 3) the best that is known of where the robot was: the truth, or odometry."""
        return self.truth if self.known else self.odometry

    @property
    def delays(self) -> Floats:
        """Delays from steps of the command to the feedback [s]."""
        return measure_delays(
            self.command_stamps, self.commands, self.feedback_stamps, self.feedback
        )


def make_recorded_track(episode: Episode, config: RobotConfig) -> EpisodeTrack:
    """Make the track of a recorded episode; odometry is computed anew, with `config`."""
    truth = episode.truth
    if len(truth) and np.isfinite(truth).all():
        start = tuple(truth[0].tolist())
        start = episode.info.get("start", start)
        truth = np.array([to_odometry(start, (x, y, theta)) for x, y, theta in truth.tolist()])
        truth[:, 2] = np.unwrap(truth[:, 2])
    return _make_track(episode.wire, episode.stamps, truth, config)


def make_twin_track(
    episode: Episode, config: RobotConfig, of: RobotConfig, body: str
) -> EpisodeTrack:
    """Make the track of a twin that gets the recorded commands."""
    done = replay_commands(of, episode.wire, episode.stamps, body=body)
    return _make_track(done.wire, episode.stamps, done.poses, config)


def _make_track(wire: WireLog, stamps: Floats, truth: Floats, config: RobotConfig) -> EpisodeTrack:
    """Decode the wire, and integrate its feedback lines by the driver's odometry."""
    lines, speeds = wire.feedback(config)
    odometry, before = Odometry.of(config), float(stamps[0]) - config.period if len(stamps) else 0.0
    twists, poses = np.zeros((len(lines), 2)), np.zeros((len(lines), 3))
    for number, (stamp, row) in enumerate(zip(lines.tolist(), speeds.tolist(), strict=True)):
        odometry.update(row, max(0.0, stamp - before))  # lines before the first tick don't count
        before = max(before, stamp)
        twists[number], poses[number] = odometry.twist, odometry.pose
    poses[:, 2] = np.unwrap(poses[:, 2])
    ticks = np.zeros((len(stamps), 3))
    if len(lines):
        ticks = np.column_stack([np.interp(stamps, lines, column) for column in poses.T])
    return EpisodeTrack(*wire.commands(config), lines, speeds, twists, stamps, ticks, truth)


def add_truth(recording: Recording, log: Path) -> Recording:
    """Add true poses to a recording that was made over a pseudo-terminal.

    The link and the emulator both use the machine's monotonic clock.

    Raises:
        ConfigError: the log holds no true poses, or is of another time.
    """
    stamps, poses = (np.array(column, np.float64) for column in read_true_poses(log))
    poses[:, 2] = np.unwrap(poses[:, 2])
    episodes = list(recording.episodes)
    for i, episode in enumerate(episodes):
        if len(episode.stamps) and not np.isfinite(episode.truth).any():
            when = np.r_[episode.stamps[0] - recording.config.period, episode.stamps]
            if stamps[0] <= when[0] and when[-1] <= stamps[-1]:
                found = np.column_stack([np.interp(when, stamps, column) for column in poses.T])
                info = {**episode.info, "start": found[0].tolist()}
                episodes[i] = replace(episode, truth=found[1:], info=info)
    if not any(np.isfinite(episode.truth).any() for episode in episodes):
        raise ConfigError(f"{log}: is of another time than the recording")
    return replace(recording, episodes=tuple(episodes))
