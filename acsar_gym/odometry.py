"""Dead reckoning: equations (1)-(11) of the robot's hardware interface document, in their order."""

from __future__ import annotations

import math
from collections.abc import Sequence

from acsar_gym import kinematics
from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.protocol import ZERO, Speeds

POSE_COVARIANCE: tuple[float, ...] = tuple(0.01 if i in (0, 7, 35) else 0.0 for i in range(36))
"""Row-major 6 x 6 covariance (x, y, z, roll, pitch, yaw), as the robot's driver publishes it."""
TWIST_COVARIANCE: tuple[float, ...] = tuple(0.01 if i in (0, 35) else 0.0 for i in range(36))
"""Row-major 6 x 6 covariance of the twist, as the robot's driver publishes it."""


def integrate(
    x: float,
    y: float,
    theta: float,
    cos: float,
    sin: float,
    linear: float,
    angular: float,
    dt: float,
) -> tuple[float, float, float]:
    """Equations (4)-(9): the pose after `dt` [s] at a twist; `cos` and `sin` are those of theta."""
    x += linear * cos * dt
    y += linear * sin * dt
    return x, y, theta + angular * dt


def _normalised(theta: float) -> float:
    """Equation (10), by its own loop where that ends soon."""
    if abs(theta) > 1e3:
        theta = math.remainder(theta, 2.0 * math.pi)
    while theta > math.pi:
        theta -= 2.0 * math.pi
    while theta < -math.pi:
        theta += 2.0 * math.pi
    return theta


class Odometry:
    """Integrates wheel speeds to a pose in the odometry frame, which starts at the origin.

    Attributes: `pose` (x [m], y [m], theta [rad] within [-pi, pi]); `twist` (linear [m/s], angular
    [rad/s]); `wheel_positions`, four integrated wheel angles [rad].

    `wheel_separation_multiplier` scales the wheel separation [m] for the skidding of the wheels,
    as in ROS diff_drive_controller; 1.0 is the document's own formula.
    Raises ConfigError unless all three are positive and finite.
    """

    pose: tuple[float, float, float]
    twist: tuple[float, float]
    wheel_positions: Speeds
    pose_covariance = POSE_COVARIANCE
    twist_covariance = TWIST_COVARIANCE

    def __init__(
        self,
        wheel_radius: float,
        wheel_separation: float,
        wheel_separation_multiplier: float = 1.0,
    ) -> None:
        given = {
            "wheel_radius": wheel_radius,
            "wheel_separation": wheel_separation,
            "wheel_separation_multiplier": wheel_separation_multiplier,
        }
        for name, value in given.items():
            if not 0.0 < value < math.inf:
                raise ConfigError(f"{name} = {value}: must be positive and finite")
        self._radius = wheel_radius
        self._separation = wheel_separation * wheel_separation_multiplier
        self.reset()

    def reset(self) -> None:
        """Back to the origin, at rest, with all wheel angles zero."""
        self.pose = (0.0, 0.0, 0.0)
        self.twist = (0.0, 0.0)
        self.wheel_positions = ZERO

    def update(self, speeds: Sequence[float], dt: float) -> None:
        """Integrate four wheel speeds [rad/s] over `dt` [s].

        Raises CommandError unless there are four finite speeds and a finite `dt` that isn't
        negative.
        """
        if len(speeds) != 4:
            raise CommandError(f"odometry needs 4 wheel speeds (a, b, c, d), got {len(speeds)}")
        a, b, c, d = speeds
        linear, angular = kinematics.twist(a, b, c, d, self._radius, self._separation)
        x, y, theta = self.pose
        cos, sin = math.cos(theta), math.sin(theta)
        x, y, theta = integrate(x, y, theta, cos, sin, linear, angular, dt)
        if not (math.isfinite(x + y + theta) and 0.0 <= dt < math.inf):
            raise CommandError(f"odometry can't integrate speeds {tuple(speeds)} over dt = {dt} s")
        if not -math.pi <= theta <= math.pi:
            theta = _normalised(theta)
        self.pose = (x, y, theta)
        self.twist = (linear, angular)
        turned_a, turned_b, turned_c, turned_d = self.wheel_positions
        self.wheel_positions = (
            turned_a + a * dt,
            turned_b + b * dt,
            turned_c + c * dt,
            turned_d + d * dt,
        )

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Heading as (x, y, z, w) = (0, 0, sin(theta / 2), cos(theta / 2)), equation (11)."""
        half = self.pose[2] / 2.0
        return (0.0, 0.0, math.sin(half), math.cos(half))
