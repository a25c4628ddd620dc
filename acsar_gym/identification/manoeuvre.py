"""Drives the manoeuvre of an identification, and logs the wire with fine stamps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.identification.excitation import Plan, plan
from acsar_gym.links import Link
from acsar_gym.recording.wire_log import WireLog
from acsar_gym.robot import Robot
from acsar_gym.worlds import Scene

RESOLUTION = 0.001
"""Interval at which the link is read [s]."""
STRETCH = 1.013
"""Factor on a tick: its phase to the board's loops and lines then takes every value."""
STANDS = 0.1
"""A wheel below this stands [rad/s]."""
STOOD = 0.2
"""The pause ends when all wheels have stood this long [s]."""
SHORTEST = 8.0
LONGEST = 600.0
"""Limits of the manoeuvre's duration [s]."""


class TappedLink:
    """Passes a link's bytes on, and keeps a log of them with stamps of 1 ms.

    Args:
        link: to the robot.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._sent: list[tuple[float, bytes]] = []
        self._got: list[tuple[float, bytes]] = []

    def open(self) -> None:
        """Open the link."""
        self._link.open()

    def reset(self, scene: Scene) -> None:
        """Reset the link, and begin a new log."""
        self._link.reset(scene)
        self._sent.clear()
        self._got.clear()

    def write(self, data: bytes) -> None:
        """Send bytes to the robot."""
        stamp = self._link.now()
        self._link.write(data)
        self._sent.append((stamp, data))

    def advance(self, period: float) -> bytes:
        """Let a stretched period pass; returns what arrived."""
        arrived = b""
        slices = max(1, round(period / RESOLUTION))
        for _ in range(slices):
            data = self._link.advance(period * STRETCH / slices)
            if data:
                self._got.append((self._link.now(), data))
                arrived += data
        return arrived

    def now(self) -> float:
        """Return the link's time [s]."""
        return self._link.now()

    @property
    def lateness(self) -> float | None:
        """Lateness of the link [s]."""
        return self._link.lateness

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of the link."""
        return self._link.truth

    def close(self) -> None:
        """Close the link."""
        self._link.close()

    @property
    def log(self) -> WireLog:
        """What passed since the reset."""
        sent, got = zip(*self._sent, strict=True), zip(*self._got, strict=True)
        (sent_stamps, sent_bytes), (got_stamps, got_bytes) = sent, got
        return WireLog(np.array(sent_stamps), sent_bytes, np.array(got_stamps), got_bytes)


def drive(
    link: Link,
    config: RobotConfig,
    duration: float,
    begun: Callable[[], None] = lambda: None,
) -> WireLog:
    """Drive the manoeuvre; the robot is stopped on any way out.

    Args:
        link: to the robot, whose wheels are lifted.
        config: of the robot.
        duration: [s].
        begun: called once the robot is active, before the wheels turn.

    Returns:
        The log of the wire.

    Raises:
        ConfigError: the duration is out of range.
        LinkError: the robot can't be reached, or fails.
    """
    if not SHORTEST <= duration <= LONGEST:
        raise ConfigError(f"duration = {duration}: must be {SHORTEST:g} to {LONGEST:g} s")
    tapped = TappedLink(link)
    whole = plan(config, duration, config.period * STRETCH)
    with Robot(tapped, config) as robot:
        begun()
        _drive(robot, whole)
    return tapped.log


def _drive(robot: Robot, whole: Plan) -> None:
    """Command the plan's speeds, tick by tick; the pause ends early where the wheels stand."""
    for speeds in whole.before.tolist():
        robot.tick(speeds)
    still = 0
    for _ in range(whole.pause):
        robot.listen()
        still = still + 1 if max(map(abs, robot.speeds)) < STANDS else 0
        if still * robot.config.period > STOOD:
            break
    for speeds in whole.after.tolist():
        robot.tick(speeds)
    robot.stop()
