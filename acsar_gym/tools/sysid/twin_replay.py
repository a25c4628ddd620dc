"""Sends recorded commands to a twin, and takes the host's jitter off recorded times."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.firmware import Firmware
from acsar_gym.recording.types import Floats, WireLog

PHASE_TOLERANCE = 0.0005  # phases that differ by less are the same [s]
JITTER_WINDOW = 50  # number of lines over which the board's clock is followed
JITTER_RANK = 2  # how many earlier lines of a window may be late by more than half a period
PERIODIC_SHARE = 0.25  # lines are periodic if half of them are late by less, in parts of a period


@dataclass(frozen=True, eq=False)
class TwinReplay:
    """What the twin did with recorded commands."""

    wire: WireLog
    """The recorded bytes to the board, and those that the twin answered."""
    poses: Floats
    """(n, 3): the twin's true pose at the requested times: x [m], y [m], theta [rad, unwrapped]. It
    starts at the origin."""


def replay_commands(
    config: RobotConfig, log: WireLog, stamps: Floats, *, body: str = "planar"
) -> TwinReplay:
    """Send recorded command bytes to a twin at their times.

    The twin is at rest at the origin when the log starts. Its clock is set so that its feedback
    lines arrive at the same phase as the recorded lines: that phase depends on when a board was
    switched on. If the log has no times of a wire, as of a robot in ROS, commands are sent earlier
    and lines count earlier by the time that they take on the twin's wire.

    Args:
        config: Robot configuration of the twin.
        log: The recorded bytes.
        stamps: Times at which the pose is wanted, (n,) [s].
        body: Name of the twin's body.

    Raises:
        ConfigError: The log holds no commands, or the body is unknown.
    """
    if not len(log.sent_stamps):
        raise ConfigError("the log holds no commands to replay")
    robot = make_body(body, config)
    try:
        firmware = Firmware(config, robot)

        # Without a wire in the log, the wire of the twin is taken off.
        wire = config.wire_time if log.stamped else 0.0
        origin = _find_origin(config, firmware, log, wire)
        now = origin
        pieces: list[tuple[float, bytes]] = []
        poses: list[tuple[float, float, float]] = []

        # At equal times the pose comes first: it ends a tick, and the command begins the next tick.
        events: list[tuple[float, int, bytes]] = [(stamp, 0, b"") for stamp in stamps.tolist()]
        sent = zip((log.sent_stamps - wire).tolist(), log.sent, strict=False)
        events += [(stamp, 1, data) for stamp, data in sent]
        events += [(stamp + wire, 2, b"") for stamp in log.got_stamps[-1:].tolist()]
        for stamp, kind, data in sorted(events, key=lambda event: event[:2]):
            if stamp > now:
                firmware.advance(stamp - now)
                pieces += [(origin + when - wire, line) for when, line in firmware.arrived]
                now = stamp
            if kind == 0:
                poses.append(robot.truth.pose)
            else:
                firmware.receive(data)
    finally:
        robot.close()

    track = np.array(poses, np.float64).reshape(-1, 3)
    track[:, 2] = np.unwrap(track[:, 2])
    answered = WireLog.of((), pieces, stamped=log.stamped)
    return TwinReplay(replace(answered, sent_stamps=log.sent_stamps, sent=log.sent), track)


def _find_origin(config: RobotConfig, firmware: Firmware, log: WireLog, wire: float) -> float:
    """Return the time of the log at which the twin's clock is zero [s].

    It is the latest time before the first command at which the phase of the twin's lines, which
    count earlier by `wire` [s], is the recorded phase.
    """
    period = 1.0 / config.feedback_rate
    first = float(log.sent_stamps[0]) - wire
    recorded = log.feedback(config)[0]
    if len(recorded) < 2:
        return first
    firmware.advance(4.0 * period)
    answered = np.array([stamp for stamp, _ in firmware.arrived]) - wire
    firmware.reset()
    if not len(answered):
        return first

    phases = [
        float(np.angle(np.exp(2j * math.pi * stamps / period).mean())) / (2.0 * math.pi) * period
        for stamps in (remove_jitter(recorded, period), answered)
    ]
    ahead = (first - (phases[0] - phases[1])) % period
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
