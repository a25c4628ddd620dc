"""How uncertain odometry is, from the intervals of what was measured on the robot.

An error of the turning factor (multiplier, or the body's turn_factor) is a share of every turn, and
an error of the wheels' radii a share of every distance. Both last, so the standard deviations grow
in proportion to the path: sigma_theta = s_turn * integral |omega| dt, sigma_along = s_roll *
integral |v| dt, and across the path sigma_across = integral sigma_theta |v| dt. x and y each get
the sum of both variances, as the direction of the path changes. What wasn't measured keeps the
constant variance that the robot's own driver publishes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.odometry import POSE_COVARIANCE, TWIST_COVARIANCE

Floats = NDArray[np.float64]
INTERVAL = 2.0 * 1.959964
"""Width of a 95 % interval of a normal distribution, in standard deviations."""
TURNING = ("wheel_separation_multiplier", "body.turn_factor")
ROLLING = ("wheel_radius", "left_wheel_radius_multiplier", "right_wheel_radius_multiplier")
LEAST = 1e-9
"""Variance at the start of an episode, as zero would mean that nothing can be wrong."""
UNKNOWN = 0.01
"""Variance that the robot's own driver publishes [m^2], [rad^2]."""
X, Y, YAW = 0, 7, 35
"""Places of the variances in a row-major 6 x 6 matrix."""


class Covariance:
    """Covariances of /odom during an episode.

    Args:
        config: of the robot; `measured` has the intervals.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._turn = share(config, TURNING)
        self._roll = share(config, ROLLING)
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the pose is known."""
        self._rolled = self._turned = self._across = 0.0
        self._last: float | None = None

    def of(self, stamps: Floats, twists: Floats) -> tuple[Floats, Floats]:
        """Continue with the next ticks.

        Args:
            stamps: (n,) [s].
            twists: (n, 2): linear [m/s], angular [rad/s].

        Returns:
            Covariances of pose and twist, (n, 36) each.
        """
        first = stamps[0] if self._last is None else self._last
        dt = np.diff(stamps, prepend=first)
        self._last = float(stamps[-1])
        way, turn = np.abs(twists[:, 0]) * dt, np.abs(twists[:, 1]) * dt
        rolled, turned = self._rolled + np.cumsum(way), self._turned + np.cumsum(turn)
        across = self._across + np.cumsum((self._turn or 0.0) * turned * way)
        self._rolled, self._turned = float(rolled[-1]), float(turned[-1])
        self._across = float(across[-1])
        pose = np.tile(POSE_COVARIANCE, (len(stamps), 1))
        along = UNKNOWN if self._roll is None else LEAST + (self._roll * rolled) ** 2
        pose[:, X] = pose[:, Y] = along + across**2
        if self._turn is not None:
            pose[:, YAW] = LEAST + (self._turn * turned) ** 2
        return pose, self._twist(twists)

    def _twist(self, twists: Floats) -> Floats:
        """Covariances of the twist."""
        found = np.tile(TWIST_COVARIANCE, (len(twists), 1))
        if self._roll is not None:
            found[:, X] = LEAST + (self._roll * twists[:, 0]) ** 2
        if self._turn is not None:
            found[:, YAW] = LEAST + (self._turn * twists[:, 1]) ** 2
        return found


def share(config: RobotConfig, names: tuple[str, ...]) -> float | None:
    """Return the relative standard deviation of a product of fields; None if none was measured."""
    measured: Any = getattr(config, "measured", {})
    found = [measured[name] for name in names if name in measured]
    if not found:
        return None
    return math.sqrt(sum(_relative(one.low, one.high) ** 2 for one in found) / len(found))


def _relative(low: float, high: float) -> float:
    """The standard deviation of a 95 % interval, relative to its middle."""
    middle = abs(low + high) / 2.0
    return abs(high - low) / INTERVAL / middle if middle else 0.0
