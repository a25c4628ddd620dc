"""Tracks: commands and wheel speeds of an episode with their times, as board or host saw them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.odometry import Odometry
from acsar_gym.recording.twin_replay import remove_jitter, replay_commands
from acsar_gym.recording.types import Episode, Recording, WireLog
from acsar_gym.tools.evaluation.episode import read_true_poses
from acsar_gym.tools.sysid.delays import Floats, measure_delays
from acsar_gym.worlds.world import to_odometry

PAUSE_GAP = 0.15
"""Time without a command that counts as a pause [s]."""
HELD_OUT_BLOCK = 1.0
"""Length of the blocks of which some are held out [s]."""
HELD_OUT_EVERY = 5
"""One block of so many is held out."""
LATE_LINE = 0.006
"""Lines that this computer saw later than this after their time don't count [s]."""
LONGEST_GAP = 0.05
"""See `BoardTrack.stalls` [s]."""
REST_LEAD = 0.5
"""Time at rest before the first command and reading; longer than encoders average [s]."""
PAUSE_MARGIN = 0.3
"""Held-out blocks are this far from a pause [s]."""


@dataclass(frozen=True, eq=False)
class BoardTrack:
    """One episode of a log as the board saw it, on the host's clock.

    Attributes:
        arrivals: when each command had arrived at the board and was processed, (n,) [s].
        commands: of the four wheels, (n, 4) [rad/s].
        stamps: when the board made each line, (m,) [s].
        speeds: of the four wheels, (m, 4) [rad/s].
        held_out: which lines a fit may not see, (m,).
        numbers: of these lines among all that came, (m,); late ones are left out.
        stalls: when lines came again after none did for longer than `LONGEST_GAP` and two periods,
            (k,) [s]: the computer, or an emulated board, stood still.
    """

    arrivals: Floats
    commands: Floats
    stamps: Floats
    speeds: Floats
    held_out: NDArray[np.bool_]
    numbers: NDArray[np.intp]
    stalls: Floats = field(default_factory=lambda: np.empty(0))

    @property
    def duration(self) -> float:
        """Time that both commands and readings cover [s]."""
        if len(self.stamps) < 2 or len(self.arrivals) < 2:
            return 0.0
        end = min(self.stamps[-1], self.arrivals[-1])
        return max(0.0, float(end - max(self.stamps[0], self.arrivals[0])))

    @property
    def pauses(self) -> NDArray[np.intp]:
        """Indices of the last command before each pause."""
        return np.flatnonzero(np.diff(self.arrivals) > PAUSE_GAP)

    def loop_edges(self, dt: float) -> Floats:
        """Begin of each firmware loop [s], for loops of `dt` [s]."""
        begin = min(self.arrivals[0], self.stamps[0]) - REST_LEAD
        return np.asarray(begin + dt * np.arange(int((self.stamps[-1] - begin) / dt) + 2))

    def apply_timeout(self, timeout: float) -> tuple[Floats, Floats]:
        """Commands and their times, with zeros where the board's time-out [s] acts."""
        pauses = self.pauses
        pauses = pauses[np.diff(self.arrivals)[pauses] > timeout]
        if not len(pauses):
            return self.arrivals, self.commands
        arrivals = np.insert(self.arrivals, pauses + 1, self.arrivals[pauses] + timeout)
        return arrivals, np.insert(self.commands, pauses + 1, 0.0, axis=0)


def decode_track(log: WireLog, config: RobotConfig) -> BoardTrack | None:
    """Decode one episode of the wire; None where it holds no commands or no readings."""
    line = config.line_time
    took = line + config.firmware.processing_time
    sent, commands = log.commands(config)
    got, speeds = log.feedback(config)
    if len(sent) < 2 or len(got) < 2:
        return None
    last = np.append(np.diff(got) > 0.0, True)  # of lines that came at once, the newest
    last &= got - remove_jitter(got, float(np.median(np.diff(got)))) < LATE_LINE
    stamps, speeds, numbers = got[last] - took, speeds[last], np.flatnonzero(last)
    arrivals = np.maximum.accumulate(sent) + took
    seen = (stamps >= arrivals[0]) & (stamps <= arrivals[-1] + PAUSE_GAP)
    if not seen.any():
        return None
    stamps, speeds = stamps[seen], speeds[seen]
    block = ((stamps - stamps[0]) / HELD_OUT_BLOCK).astype(int)
    held_out = block % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    for k in np.flatnonzero(np.diff(arrivals) > PAUSE_GAP):
        begin, end = arrivals[k] - PAUSE_MARGIN, arrivals[k + 1] + PAUSE_MARGIN
        held_out &= (stamps < begin) | (stamps > end)
    stalls = got[1:][np.diff(got) > LONGEST_GAP + 2.0 * float(np.median(np.diff(got)))]
    return BoardTrack(arrivals, commands, stamps, speeds, held_out, numbers[seen], stalls)


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
        if "part" not in episode.info:  # which begins elsewhere
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
