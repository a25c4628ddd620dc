"""Drives the manoeuvre of an identification, and logs the wire with fine stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import GroundTruth
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.identification.excitation import Plan, plan
from acsar_gym.links import Link
from acsar_gym.links.base import Arrivals, arrivals_of
from acsar_gym.recording import Recorder
from acsar_gym.recording.wire_log import WireLog
from acsar_gym.robot import Robot
from acsar_gym.worlds import Scene

STRETCH = 1.013
"""Factor on a tick: its phase to the board's loops and lines then takes every value."""
STANDS = 0.1
"""A wheel below this stands [rad/s]."""
STOOD = 0.2
"""The pause ends when all wheels have stood this long [s]."""
SHORTEST = 12.0
LONGEST = 600.0
"""Limits of the manoeuvre's duration [s]."""


class TappedLink:
    """Passes a link's bytes on, and keeps a log of them.

    Args:
        link: to the robot.

    Attributes: `link`, the inner one; `device`, its name if it has one.
    """

    def __init__(self, link: Link) -> None:
        self.link = link
        self.device = getattr(link, "device", "")
        self._sent: Arrivals = []
        self._got: Arrivals = []
        self.arrivals: Arrivals = []

    def open(self) -> None:
        """Open the link."""
        self.link.open()

    def reset(self, scene: Scene) -> None:
        """Reset the link, and begin a new log."""
        self.link.reset(scene)
        self._sent.clear()
        self._got.clear()
        arrivals_of(self.link)  # from now on, it notes when bytes arrive

    def write(self, data: bytes) -> None:
        """Send bytes to the robot."""
        self.link.write(data)
        self._sent.append((self.link.now(), data))

    def advance(self, period: float) -> bytes:
        """Let a stretched period pass; returns what arrived."""
        data = self.link.advance(period * STRETCH)
        self.arrivals = list(arrivals_of(self.link))
        if data and not self.arrivals:
            self.arrivals = [(self.link.now(), data)]
        self._got += self.arrivals
        return data

    def now(self) -> float:
        """Return the link's time [s]."""
        return self.link.now()

    @property
    def lateness(self) -> float | None:
        """Lateness of the link [s]."""
        return self.link.lateness

    @property
    def truth(self) -> GroundTruth | None:
        """Ground truth of the link."""
        return self.link.truth

    def close(self) -> None:
        """Close the link."""
        self.link.close()

    @property
    def log(self) -> WireLog:
        """What passed since the reset."""
        return WireLog(*_columns(self._sent), *_columns(self._got))


def _columns(pieces: Arrivals) -> tuple[NDArray[np.float64], tuple[bytes, ...]]:
    """Split times and bytes."""
    return np.array([stamp for stamp, _ in pieces]), tuple(data for _, data in pieces)


def drive(
    link: Link,
    config: RobotConfig,
    duration: float,
    recorder: Recorder | None = None,
) -> WireLog:
    """Drive the manoeuvre; the robot is stopped on any way out.

    Args:
        link: to the robot, whose wheels are lifted.
        config: of the robot.
        duration: [s].
        recorder: records it as well.

    Returns:
        The log of the wire.

    Raises:
        ConfigError: the duration is out of range.
        LinkError: the robot can't be reached, fails, or was stopped.
    """
    if not SHORTEST <= duration <= LONGEST:
        raise ConfigError(f"duration = {duration}: must be {SHORTEST:g} to {LONGEST:g} s")
    tapped = TappedLink(link)
    whole = plan(config, duration, config.period * STRETCH)
    # The wheels don't answer as configured: that is what is to be found.
    with Robot(tapped, config.with_(wheel_check=False), recorder=recorder) as robot:
        _drive(robot, whole)
    return tapped.log


def _drive(robot: Robot, whole: Plan) -> None:
    """Command the plan's speeds, tick by tick; the pause ends early where the wheels stand."""
    begin = robot.link.now()
    for speeds in whole.before.tolist():
        robot.tick(speeds)
        robot.safety.check(robot.link.now() - begin)
    still = 0
    for _ in range(whole.pause):
        robot.listen()
        robot.safety.check(robot.link.now() - begin)
        still = still + 1 if max(map(abs, robot.speeds)) < STANDS else 0
        if still * robot.config.period > STOOD:
            break
    for speeds in whole.after.tolist():
        robot.tick(speeds)
        robot.safety.check(robot.link.now() - begin)
    robot.stop()
