"""Tracks: both sides of an episode, robot and twin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.odometry import Odometry
from acsar_gym.recording.types import Episode, Floats, Recording, WireLog
from acsar_gym.tools.evaluation.episode import read_true_poses
from acsar_gym.tools.sysid.twin_replay import replay_commands
from acsar_gym.worlds.world import to_odometry


@dataclass(frozen=True, eq=False)
class EpisodeTrack:
    """A side of an episode, on the clock of its recording: k feedback lines, n ticks."""

    feedback_stamps: Floats
    """(k,) times at which feedback lines arrived [s]."""
    feedback: Floats
    """(k, 4) measured wheel speeds [rad/s]."""
    twists: Floats
    """(k, 2) twist by odometry at each line: linear [m/s], angular [rad/s]."""
    odometry: Floats
    """(n, 3) x [m], y [m], theta [rad, unwrapped] by odometry, from the origin on."""
    truth: Floats
    """(n, 3) true pose, likewise from the origin on. NaN on hardware."""

    @property
    def known(self) -> bool:
        """Whether the true pose is known."""
        return bool(len(self.truth)) and bool(np.isfinite(self.truth).all())

    @property
    def poses(self) -> Floats:
        """(n, 3) the true poses, or odometry if they are unknown."""
        return self.truth if self.known else self.odometry


def make_recorded_track(episode: Episode, config: RobotConfig) -> EpisodeTrack:
    """Make the track of a recorded episode, with odometry by `config`."""
    truth = episode.truth
    if len(truth) and np.isfinite(truth).all():
        # From the origin of the episode's odometry on, as twins start there.
        start = episode.info.get("start", tuple(truth[0].tolist()))
        truth = np.array([to_odometry(start, tuple(pose)) for pose in truth.tolist()])
        truth[:, 2] = np.unwrap(truth[:, 2])
    return _make_track(episode.wire, episode.stamps, truth, config)


def make_twin_track(
    episode: Episode, config: RobotConfig, *, twin: RobotConfig, body: str
) -> EpisodeTrack:
    """Make the track of a twin that gets the recorded commands, with odometry by `config`."""
    done = replay_commands(twin, episode.wire, episode.stamps, body=body)
    return _make_track(done.wire, episode.stamps, done.poses, config)


def _make_track(wire: WireLog, stamps: Floats, truth: Floats, config: RobotConfig) -> EpisodeTrack:
    """Decode the wire, and integrate its feedback lines by the driver's odometry."""
    lines, speeds = wire.feedback(config)

    # The same odometry for both sides, so that only the wheels' speeds differ.
    odometry = Odometry.of(config)
    newest = float(stamps[0]) - config.period if len(stamps) else 0.0
    twists = np.zeros((len(lines), 2))
    poses = np.zeros((len(lines), 3))
    for number, (stamp, row) in enumerate(zip(lines.tolist(), speeds.tolist(), strict=True)):
        odometry.update(row, max(0.0, stamp - newest))  # lines before the first tick don't count
        newest = max(newest, stamp)
        twists[number] = odometry.twist
        poses[number] = odometry.pose

    poses[:, 2] = np.unwrap(poses[:, 2])
    ticks = np.zeros((len(stamps), 3))
    if len(lines):
        ticks = interpolate(stamps, lines, poses)
    return EpisodeTrack(lines, speeds, twists, odometry=ticks, truth=truth)


def interpolate(wanted: Floats, stamps: Floats, values: Floats) -> Floats:
    """Interpolate rows linearly. NaN if there are none."""
    if not len(stamps):
        return np.full((len(wanted), values.shape[1]), np.nan)
    return np.column_stack([np.interp(wanted, stamps, column) for column in values.T])


def add_truth(recording: Recording, log: Path) -> Recording:
    """Add true poses to a recording that was made over a pseudo-terminal.

    The link and the emulator both use the machine's monotonic clock.

    Raises:
        ConfigError: the log holds no true poses, or is of another time.
    """
    stamps, poses = (np.array(column, np.float64) for column in read_true_poses(log))
    poses[:, 2] = np.unwrap(poses[:, 2])
    episodes = list(recording.episodes)
    for place, episode in enumerate(episodes):
        if not len(episode.stamps) or np.isfinite(episode.truth).any():
            continue

        # The reset counts as well, since the truth starts there.
        when = np.append(episode.stamps[0] - recording.config.period, episode.stamps)
        if stamps[0] <= when[0] and when[-1] <= stamps[-1]:
            truth = interpolate(when, stamps, poses)
            info = {**episode.info, "start": truth[0].tolist()}
            episodes[place] = replace(episode, truth=truth[1:], info=info)
    if not any(np.isfinite(episode.truth).any() for episode in episodes):
        raise ConfigError(f"{log}: is of another time than the recording")
    return replace(recording, episodes=tuple(episodes))
