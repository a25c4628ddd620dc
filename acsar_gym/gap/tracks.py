"""One side of an episode: what was commanded, what the wheels did, and where the robot was."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.gap.delays import Floats, delays
from acsar_gym.odometry import Odometry
from acsar_gym.recording.open_loop import Replayed, replayed
from acsar_gym.recording.types import Episode
from acsar_gym.recording.wire_log import WireLog
from acsar_gym.worlds.scene import Pose, to_odometry

LONGEST = 4.0 * 3600.0
"""Longest episode that is replayed [s]."""


@dataclass(frozen=True, eq=False)
class Track:
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

    def by_odometry(self) -> Track:
        """Return the track without its true pose, to be compared with one whose isn't known."""
        return replace(self, truth=np.full_like(self.truth, np.nan))

    @property
    def delays(self) -> Floats:
        """Delays from steps of the command to the feedback [s]."""
        return delays(self.command_stamps, self.commands, self.feedback_stamps, self.feedback)


def damage(episode: Episode) -> str:
    """Say what is wrong with the times of an episode; empty if nothing is."""
    wire = episode.wire
    times = (episode.stamps, wire.sent_stamps, wire.got_stamps)
    if len(episode.stamps) < 2:
        return "holds no ticks"
    if not all(np.isfinite(stamps).all() and (np.diff(stamps) >= 0.0).all() for stamps in times):
        return "its times go backwards: the file is damaged"
    ends = [end for stamps in times if len(stamps) for end in (stamps[0], stamps[-1])]
    if max(ends) - min(ends) > LONGEST:
        return f"is longer than {LONGEST / 3600.0:g} h"
    if not np.isfinite(episode.poses).all():
        return "its odometry isn't finite: the file is damaged"
    return ""


def recorded(episode: Episode, config: RobotConfig) -> Track:
    """Make the track of a recorded episode; odometry is computed anew, with `config`."""
    truth = episode.truth
    if len(truth) and np.isfinite(truth).all():
        truth = _from(episode.info.get("start", tuple(truth[0].tolist())), truth)
    return _track(episode.wire, episode.stamps, truth, config)


def twin(episode: Episode, config: RobotConfig, of: RobotConfig, body: str) -> Track:
    """Make the track of a twin that gets the recorded commands.

    Args:
        episode: whose commands are replayed.
        config: of the robot, for decoding and odometry.
        of: config of the twin.
        body: physics of the twin, "planar" or "bullet".
    """
    done: Replayed = replayed(of, episode.wire, episode.stamps, body=body)
    return _track(done.wire, episode.stamps, done.poses, config)


def _track(wire: WireLog, stamps: Floats, truth: Floats, config: RobotConfig) -> Track:
    command_stamps, commands = wire.commands(config)
    feedback_stamps, feedback = wire.feedback(config)
    start = float(stamps[0]) - config.period if len(stamps) else 0.0
    twists, poses = travelled(config, start, feedback_stamps, feedback)
    return Track(
        command_stamps=command_stamps,
        commands=commands,
        feedback_stamps=feedback_stamps,
        feedback=feedback,
        twists=twists,
        stamps=stamps,
        odometry=_at(stamps, feedback_stamps, poses),
        truth=truth,
    )


def travelled(
    config: RobotConfig, start: float, stamps: Floats, speeds: Floats
) -> tuple[Floats, Floats]:
    """Integrate feedback lines by the driver's odometry.

    Args:
        config: of the robot.
        start: time at which odometry begins [s]; lines before it don't count.
        stamps: (k,) times of the lines [s].
        speeds: (k, 4) wheel speeds [rad/s].

    Returns:
        Twists (k, 2) and poses (k, 3), with theta unwrapped.
    """
    odometry = Odometry.of(config)
    twists, poses, before = np.zeros((len(stamps), 2)), np.zeros((len(stamps), 3)), start
    for number, (stamp, row) in enumerate(zip(stamps.tolist(), speeds.tolist(), strict=True)):
        odometry.update(row, max(0.0, stamp - before))
        before = max(before, stamp)
        twists[number], poses[number] = odometry.twist, odometry.pose
    poses[:, 2] = np.unwrap(poses[:, 2])
    return twists, poses


def _at(wanted: Floats, stamps: Floats, values: Floats) -> Floats:
    """Interpolate rows of values linearly; before the first one, they are those of the first."""
    if not len(stamps):
        return np.zeros((len(wanted), values.shape[1]))
    return np.column_stack([np.interp(wanted, stamps, column) for column in values.T])


def _from(start: Pose, poses: Floats) -> Floats:
    """Move true poses into the frame that begins at `start`, with theta unwrapped."""
    moved = np.array([to_odometry(start, (x, y, theta)) for x, y, theta in poses.tolist()])
    moved[:, 2] = np.unwrap(moved[:, 2])
    return moved
