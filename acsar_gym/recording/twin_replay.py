"""Sends recorded commands to a twin, and takes the host's jitter off recorded times."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

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
    """(n, 3): the twin's true pose at the times asked for: x [m], y [m], theta [rad, unwrapped];
    it begins at the origin."""


def replay_commands(
    config: RobotConfig, log: WireLog, stamps: Floats, *, body: str = "planar"
) -> TwinReplay:
    """Send recorded command bytes to a twin at their times; its pose is told at `stamps` [s].

    The twin stands at the origin when the log begins. Its clock is set so that its feedback lines
    arrive at the same phase as the recorded ones: that phase is a matter of when a board was
    switched on, and no property of it. Where the log has no times of a wire, as of a robot in ROS,
    commands are sent earlier and lines count earlier by the time that they take on the twin's.

    Raises:
        ConfigError: the log holds no commands, or for another body.
    """
    if not len(log.sent_stamps):
        raise ConfigError("the log holds no commands to replay")
    robot = make_body(body, config)
    try:
        firmware = Firmware(config, robot)
        wire = config.wire_time if log.stamped else 0.0
        origin = now = _find_beginning(config, firmware, log, wire)
        last = float(log.got_stamps[-1]) + wire if len(log.got_stamps) else -math.inf
        pieces: list[tuple[float, bytes]] = []
        poses: list[tuple[float, float, float]] = []

        # At equal times the pose comes first: it ends a tick, and the command begins the next one.
        sent = zip((log.sent_stamps - wire).tolist(), itertools.repeat(1), log.sent, strict=False)
        events: list[tuple[float, int, bytes | None]]
        events = [*((stamp, 0, None) for stamp in stamps.tolist()), *sent, (last, 2, b"")]
        for when, _, data in sorted(events, key=lambda event: event[:2]):
            if when > now:
                firmware.advance(when - now)
                pieces += [(origin + stamp - wire, line) for stamp, line in firmware.arrived]
                now = when
            if data is None:
                poses.append(robot.truth.pose)
            else:
                firmware.receive(data)
    finally:
        robot.close()
    track = np.array(poses, np.float64).reshape(-1, 3)
    track[:, 2] = np.unwrap(track[:, 2])
    answered = np.array([stamp for stamp, _ in pieces]), tuple(data for _, data in pieces)
    return TwinReplay(WireLog(log.sent_stamps, log.sent, *answered, stamped=log.stamped), track)


def _find_beginning(config: RobotConfig, firmware: Firmware, log: WireLog, wire: float) -> float:
    """The time of the log at which the twin's clock is zero [s]; lines count earlier by `wire` [s].

    The latest one before the first command at which the phase of its lines is the recorded one.
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
    ahead = math.fmod(first - (phases[0] - phases[1]), period)
    ahead += period if ahead < 0.0 else 0.0
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
    step = float(np.median(np.diff(stamps)))
    if abs(step - period) > 0.1 * period:
        step = period
    half = JITTER_WINDOW // 2
    lasted = stamps[half:] - stamps[:-half]  # some of its lines may be lost
    step = float(np.median(lasted / np.maximum(1.0, np.rint(lasted / step))))
    turns = stamps / step
    waves = np.exp(2j * np.pi * turns)
    means = [
        uniform_filter1d(part, JITTER_WINDOW, mode="nearest") for part in (waves.real, waves.imag)
    ]
    phases = np.arctan2(means[1], means[0]) / (2.0 * np.pi)
    off = turns - phases
    off = (off - np.rint(off)) * step
    ranked = rank_filter(off, JITTER_RANK, JITTER_WINDOW, mode="nearest")
    late = off - uniform_filter1d(ranked, JITTER_WINDOW)
    late = np.where(late < -PERIODIC_SHARE * step, late + step, late)  # by more than half a period
    return stamps - late if float(np.median(late)) < PERIODIC_SHARE * step else stamps
