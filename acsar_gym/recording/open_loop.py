"""Open-loop replay: the recorded command bytes at their recorded times, through the twin."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from acsar_gym.bodies import Body
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, suggestion
from acsar_gym.firmware import Firmware
from acsar_gym.recording.jitter import steady
from acsar_gym.recording.wire_log import Floats, WireLog

BODIES = ("planar", "bullet")
NEAR = 0.0005
"""Phases that differ by less are the same [s]."""


@dataclass(frozen=True, eq=False)
class Replayed:
    """What the twin did with recorded commands."""

    wire: WireLog
    """The recorded bytes to the board, and those that the twin answered."""
    poses: Floats
    """(n, 3): the twin's true pose at the times asked for: x [m], y [m], theta [rad, unwrapped];
    it begins at the origin."""


def replayed(
    config: RobotConfig, log: WireLog, stamps: Floats, *, body: str = "planar"
) -> Replayed:
    """Send recorded command bytes to a twin at their recorded times.

    The twin stands at the origin when the log begins. Its clock is set so that its feedback lines
    arrive at the same phase as the recorded ones: that phase is a matter of when a board was
    switched on, and no property of it.

    Args:
        config: of the twin.
        log: the recorded bytes.
        stamps: (n,) times at which the twin's pose is wanted [s], ascending.
        body: physics, "planar" or "bullet".

    Raises:
        ConfigError: the log holds no commands, or for another body.
    """
    if not len(log.sent_stamps):
        raise ConfigError("the log holds no commands to replay")
    robot = made(body, config)
    try:
        firmware = Firmware(config, robot)
        begin = _beginning(config, firmware, log)
        return _run(firmware, robot, log, stamps, begin)
    finally:
        robot.close()


def made(body: str, config: RobotConfig) -> Body:
    """Make the physics of a twin; ConfigError for names other than those in BODIES."""
    if body == "planar":
        from acsar_gym.bodies.planar import PlanarBody  # noqa: PLC0415

        return PlanarBody(config)
    if body == "bullet":
        from acsar_gym.bodies.bullet import BulletBody  # noqa: PLC0415 - optional

        return BulletBody(config)
    raise ConfigError(f"unknown body {body!r}{suggestion(body[:40], BODIES)}")


def _beginning(config: RobotConfig, firmware: Firmware, log: WireLog) -> float:
    """Return the time of the log at which the twin's clock is zero [s].

    It is the latest one before the first command at which the phase of the twin's lines is that of
    the recorded ones.
    """
    period, first = 1.0 / config.feedback_rate, float(log.sent_stamps[0])
    recorded = log.feedback(config)[0]
    if len(recorded) < 2:
        return first
    firmware.advance(4.0 * period)
    own = np.array([stamp for stamp, _ in firmware.arrived])
    firmware.reset()
    if not len(own):
        return first
    phase = _phase(steady(recorded, period), period) - _phase(own, period)
    ahead = math.fmod(first - phase, period)
    ahead += period if ahead < 0.0 else 0.0
    return first if min(ahead, period - ahead) < NEAR else first - ahead


def _phase(stamps: Floats, period: float) -> float:
    """Return the mean phase of nearly periodic times [s]."""
    turns = np.exp(2j * math.pi * stamps / period)
    return float(np.angle(turns.mean())) / (2.0 * math.pi) * period


def _run(firmware: Firmware, robot: Body, log: WireLog, stamps: Floats, begin: float) -> Replayed:
    """Replay the log on a twin whose clock is zero at `begin`."""
    now, last = begin, float(log.got_stamps[-1]) if len(log.got_stamps) else -math.inf
    pieces: list[tuple[float, bytes]] = []
    poses: list[tuple[float, float, float]] = []
    for when, _, data in _events(log, stamps, last):
        if when > now:
            firmware.advance(when - now)
            pieces += [(begin + stamp, line) for stamp, line in firmware.arrived]
            now = when
        if data is None:
            poses.append(robot.truth.pose)
        else:
            firmware.receive(data)
    track = np.array(poses, np.float64).reshape(-1, 3)
    track[:, 2] = np.unwrap(track[:, 2])
    answered = np.array([stamp for stamp, _ in pieces]), tuple(data for _, data in pieces)
    return Replayed(WireLog(log.sent_stamps, log.sent, *answered), track)


def _events(log: WireLog, stamps: Floats, last: float) -> Iterator[tuple[float, int, bytes | None]]:
    """Yield (time, order, bytes to send or None for a pose) in the order of time.

    At equal times the pose comes first: it ends a tick, and the command begins the next one.
    """
    poses = ((stamp, 0, None) for stamp in stamps.tolist())
    sent = zip(log.sent_stamps.tolist(), itertools.repeat(1), log.sent, strict=False)
    end = [(last, 2, b"")]
    events: list[tuple[float, int, bytes | None]] = [*poses, *sent, *end]
    yield from sorted(events, key=lambda event: event[:2])
