"""Both sides of a recorded episode on one clock: the robot, and a twin that gets its commands."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.config.sections import WIRE_LETTERS
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.kinematics import compute_twist
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.firmware import Firmware
from acsar_gym.recording.types import Episode, Floats, Recording, WireLog
from acsar_gym.tools.evaluation.episode import read_true_poses
from acsar_gym.worlds.world import to_odometry

LENGTHS = ("wheel_radius", "wheel_separation", "wheelbase")
SETTINGS = ("name", "baud_rate", *(f"wheels.{letter}" for letter in WIRE_LETTERS))
LENGTH_TOLERANCE = 0.1
"""Lengths of a robot differ by less than this share, also after a calibration."""
PHASE_TOLERANCE = 0.0005
"""Phases that differ by less are the same [s]."""
JITTER_WINDOW = 50
"""Number of lines over which the board's clock is followed."""
JITTER_RANK = 2
"""How many earlier lines of a window may be late by more than half a period."""
PERIODIC_SHARE = 0.25
"""Lines are periodic if half of them are late by less than this share of a period."""


class EpisodeTrack(NamedTuple):
    """A side of an episode, on the clock of its recording: k feedback lines, n ticks."""

    stamps: Floats
    """(k,) times of the feedback lines, without the host's delays [s]."""
    speeds: Floats
    """(k, 4) measured wheel speeds [rad/s]."""
    twists: Floats
    """(k, 2) twist by odometry at each line: linear [m/s], angular [rad/s]."""
    odometry: Floats
    """(n, 3) x [m], y [m], theta [rad, unwrapped] by odometry, from the origin on."""
    truth: Floats
    """(n, 3) true pose, also from the origin on. NaN on hardware."""

    @property
    def has_truth(self) -> bool:
        """Whether all true poses are known."""
        return bool(np.isfinite(self.truth).all())


def find_difference(config: RobotConfig, reference: RobotConfig) -> tuple[str, str, str] | None:
    """Return the first field in which two robots differ, and both values. None if they don't."""
    for field in LENGTHS + SETTINGS:
        value, expected = map(attrgetter(field), (config, reference))
        if field in SETTINGS and value != expected:
            return field, str(value), str(expected)
        if field in LENGTHS and not math.isclose(value, expected, rel_tol=LENGTH_TOLERANCE):
            return field, f"{value:g} m", f"{expected:g} m"
    return None


def check_same_robot(logs: Sequence[tuple[str, Recording]], doing: str) -> None:
    """Raise ConfigError, with file and field, if recordings are of several robots."""
    # Calibrated lengths differ a little, and are of the same robot.
    first_name, first = logs[0]
    for name, recording in logs[1:]:
        difference = find_difference(recording.config, first.config)
        if difference is not None:
            field, value, expected = difference
            raise ConfigError(
                f"{name}: is of another robot: {field} is {value}, but {expected} in "
                f"{first_name}; {doing} one robot at a time"
            )


def make_recorded_track(episode: Episode, config: RobotConfig) -> EpisodeTrack:
    """Make the track of a recorded episode, with odometry by `config`."""
    truth = episode.truth
    if np.isfinite(truth).all():
        # From the origin of the episode's odometry on, as twins start there.
        start = episode.info.get("start", tuple(truth[0].tolist()))
        truth = np.array([to_odometry(start, tuple(pose)) for pose in truth.tolist()])
        truth[:, 2] = np.unwrap(truth[:, 2])
    return _make_track(episode.wire, episode.stamps, truth, config)


def make_twin_track(
    episode: Episode, config: RobotConfig, twin: RobotConfig, body: str
) -> EpisodeTrack:
    """Make the track of a twin that gets the recorded commands, with odometry by `config`."""
    wire, poses = replay_commands(twin, episode.wire, episode.stamps, body=body)
    return _make_track(wire, episode.stamps, poses, config)


def _make_track(wire: WireLog, ticks: Floats, truth: Floats, config: RobotConfig) -> EpisodeTrack:
    """Decode the wire, and integrate its lines as `Odometry` does."""
    lines, speeds = wire.feedback(config)
    geometry = (*config.wheel_radii, config.effective_separation)
    a, b, c, d = speeds.T
    columns: Any = compute_twist(a, b, c, d, *geometry)
    twists = np.column_stack(columns)

    # Lines before the first tick don't count.
    start = ticks[0] - config.period
    periods = np.diff(np.maximum.accumulate(np.append(start, lines)))
    turned = twists[:, 1] * periods
    thetas = np.cumsum(turned)
    ways = twists[:, 0] * periods
    x = np.cumsum(ways * np.cos(thetas - turned))
    y = np.cumsum(ways * np.sin(thetas - turned))
    poses = interpolate(ticks, lines, np.column_stack((x, y, thetas)))

    # Delays by this computer aren't part of the robot.
    stamps = remove_jitter(lines, 1.0 / config.feedback_rate)
    return EpisodeTrack(stamps, speeds, twists, odometry=poses, truth=truth)


def interpolate(wanted: Floats, stamps: Floats, values: Floats) -> Floats:
    """Interpolate rows linearly. NaN if there are none."""
    if not len(stamps):
        return np.full((len(wanted), values.shape[1]), np.nan)
    return np.column_stack([np.interp(wanted, stamps, column) for column in values.T])


def add_truth(recording: Recording, log: Path) -> Recording:
    """Add true poses to a recording that was made over a pseudo-terminal.

    The link and the emulator both use the machine's monotonic clock.

    Raises:
        ConfigError: The log holds no true poses, or is of another time.
    """
    # An emulator logs whenever its robot moves, so poses are interpolated to the ticks.
    stamps, poses = map(np.array, read_true_poses(log))
    poses[:, 2] = np.unwrap(poses[:, 2])

    episodes = []
    for episode in recording.episodes:
        # The reset counts as well, since the truth starts there.
        when = np.append(episode.stamps[:1] - recording.config.period, episode.stamps)
        is_blind = len(when) and not np.isfinite(episode.truth).any()
        if is_blind and stamps[0] <= when[0] and when[-1] <= stamps[-1]:
            truth = interpolate(when, stamps, poses)
            info = {**episode.info, "start": truth[0].tolist()}
            episode = replace(episode, truth=truth[1:], info=info)  # noqa: PLW2901
        episodes.append(episode)
    if not any(np.isfinite(episode.truth).any() for episode in episodes):
        raise ConfigError(f"{log}: is of another time than the recording")
    return replace(recording, episodes=tuple(episodes))


def replay_commands(
    config: RobotConfig, log: WireLog, ticks: Floats, *, body: str = "planar"
) -> tuple[WireLog, Floats]:
    """Send recorded command bytes to a twin at their times.

    The twin is at rest at the origin when the log starts. Its clock is set so that its feedback
    lines arrive at the same phase as the recorded lines: that phase depends on when a board was
    switched on. If the log has no times of a wire, as of a robot in ROS, commands are sent earlier
    and lines count earlier by the time that they take on the twin's wire.

    Args:
        config: Robot configuration of the twin.
        log: The recorded bytes, with a command or more.
        ticks: Times at which the pose is wanted, (n,) [s].
        body: Name of the twin's body.

    Returns:
        The recorded bytes to the board with the twin's answers, and the twin's true poses,
        (n, 3): x [m], y [m], theta [rad, unwrapped].

    Raises:
        ConfigError: The body is unknown.
    """
    robot = make_body(body, config)
    try:
        firmware = Firmware(config, robot)

        # Without a wire in the log, the wire of the twin is taken off.
        wire = config.wire_time if log.stamped else 0.0
        now = origin = _find_origin(config, firmware, log, wire)
        answers: list[tuple[float, bytes]] = []
        poses: list[tuple[float, float, float]] = []

        # At equal times the pose comes first: it ends a tick, and the command begins the next tick.
        events: list[tuple[float, int, bytes]] = [(stamp, 0, b"") for stamp in ticks.tolist()]
        sent = zip((log.sent_stamps - wire).tolist(), log.sent, strict=True)
        events += [(stamp, 1, data) for stamp, data in sent]
        events += [(stamp + wire, 2, b"") for stamp in log.got_stamps[-1:].tolist()]
        for stamp, kind, data in sorted(events, key=lambda event: event[:2]):
            if stamp > now:
                firmware.advance(stamp - now)
                answers += [(origin + when - wire, line) for when, line in firmware.arrived]
                now = stamp
            if kind == 0:
                poses.append(robot.truth.pose)
            else:
                firmware.receive(data)
    finally:
        robot.close()

    track = np.array(poses, np.float64).reshape(-1, 3)
    track[:, 2] = np.unwrap(track[:, 2])
    answered = WireLog.of((), answers, stamped=log.stamped)
    return replace(answered, sent_stamps=log.sent_stamps, sent=log.sent), track


def _find_origin(config: RobotConfig, firmware: Firmware, log: WireLog, wire: float) -> float:
    """Return the time of the log at which the twin's clock is zero [s].

    It is the latest time before the first command at which the phase of the twin's lines, which
    count earlier by `wire` [s], is the recorded phase.
    """
    period = 1.0 / config.feedback_rate
    first = float(log.sent_stamps[0]) - wire
    # A few lines show at which phase this twin prints. Then it starts again.
    firmware.advance(4.0 * period)
    answered = np.array([stamp for stamp, _ in firmware.arrived]) - wire
    firmware.reset()
    recorded = log.feedback(config)[0]
    if len(recorded) < 2 or not len(answered):
        return first

    # A phase is the mean angle of the times on a circle of one period.
    circles = [
        np.exp(2j * math.pi * stamps / period).mean()
        for stamps in (remove_jitter(recorded, period), answered)
    ]
    phases = np.angle(circles) / (2.0 * math.pi) * period
    ahead = float((first - (phases[0] - phases[1])) % period)
    return first if min(ahead, period - ahead) < PHASE_TOLERANCE else first - ahead


def remove_jitter(stamps: Floats, period: float) -> Floats:
    """Estimate when nearly periodic lines would have arrived without delays by the host [s], (k,).

    Within a window the phase of the earliest lines is that of the board's clock, and every line is
    late by what its phase is after it. Lines that aren't periodic, or too few, stay as they are.
    """
    with require_extra("identification", "scipy"):
        from scipy.ndimage import rank_filter, uniform_filter1d  # noqa: PLC0415 - slow to import

    if len(stamps) < JITTER_WINDOW:
        return stamps

    # The configured period is a guess if lines come at another rate.
    step = float(np.median(np.diff(stamps)))
    if abs(step - period) > 0.1 * period:
        step = period

    half = JITTER_WINDOW // 2
    durations = stamps[half:] - stamps[:-half]  # some of its lines may be lost
    step = float(np.median(durations / np.maximum(1.0, np.rint(durations / step))))

    # The mean phase of a window follows a clock that drifts.
    turns = stamps / step
    waves = np.exp(2j * np.pi * turns)
    real = uniform_filter1d(waves.real, JITTER_WINDOW, mode="nearest")
    imaginary = uniform_filter1d(waves.imag, JITTER_WINDOW, mode="nearest")
    deviations = turns - np.arctan2(imaginary, real) / (2.0 * np.pi)
    deviations = (deviations - np.rint(deviations)) * step

    # The earliest lines of a window were hardly late. All others are compared with them.
    ranked = rank_filter(deviations, JITTER_RANK, JITTER_WINDOW, mode="nearest")
    late = deviations - uniform_filter1d(ranked, JITTER_WINDOW)
    late = np.where(late < -PERIODIC_SHARE * step, late + step, late)  # by more than half a period
    return stamps - late if float(np.median(late)) < PERIODIC_SHARE * step else stamps
