"""Wheel odometry: equations (1)-(11) of the robot's hardware interface document."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Self

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.protocol import ZERO, Speeds

__all__ = ["POSE_COVARIANCE", "TWIST_COVARIANCE", "Odometry"]
POSE_COVARIANCE: tuple[float, ...] = tuple(0.01 if i in (0, 7, 35) else 0.0 for i in range(36))
"""Row-major 6 x 6 covariance (x, y, z, roll, pitch, yaw), as the robot's driver publishes it."""
TWIST_COVARIANCE: tuple[float, ...] = tuple(0.01 if i in (0, 35) else 0.0 for i in range(36))
"""Row-major 6 x 6 covariance of the twist, as the robot's driver publishes it."""


def integrate_twist(
    x: float,
    y: float,
    theta: float,
    cos: float,
    sin: float,
    linear: float,
    angular: float,
    dt: float,
) -> tuple[float, float, float]:
    """Integrate a twist over `dt` [s], equations (4)-(9).

    Args:
        x: [m], odometry frame.
        y: [m], odometry frame.
        theta: heading [rad].
        cos: cosine of theta.
        sin: sine of theta.
        linear: [m/s], base frame.
        angular: [rad/s].
        dt: duration [s].

    Returns:
        The new x, y and theta; theta isn't normalized.
    """
    x += linear * cos * dt
    y += linear * sin * dt
    return x, y, theta + angular * dt


class Odometry:
    """Integrates wheel speeds to a pose in the odometry frame, which starts at the origin.

    Args:
        wheel_radius: [m].
        wheel_separation: [m].
        wheel_separation_multiplier: factor for the skidding of the wheels, as in ROS
            diff_drive_controller; with 1.0 the equations are those of the document.
        left_wheel_radius_multiplier: factor from wheel_radius to the radius of the left wheels.
        right_wheel_radius_multiplier: factor from wheel_radius to the radius of the right wheels.

    Attributes:
        pose: x [m], y [m], theta [rad] within [-pi, pi].
        twist: linear [m/s], angular [rad/s], in the base frame.
        wheel_positions: integrated wheel angles [rad], in the order of `protocol.WHEELS`.
        pose_covariance: row-major 6 x 6 matrix of (x, y, z, roll, pitch, yaw).
        twist_covariance: likewise.

    Raises:
        ConfigError: an argument isn't positive and finite.
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
        *,
        left_wheel_radius_multiplier: float = 1.0,
        right_wheel_radius_multiplier: float = 1.0,
    ) -> None:
        given = {
            "wheel_radius": wheel_radius,
            "wheel_separation": wheel_separation,
            "wheel_separation_multiplier": wheel_separation_multiplier,
            "left_wheel_radius_multiplier": left_wheel_radius_multiplier,
            "right_wheel_radius_multiplier": right_wheel_radius_multiplier,
        }
        for name, value in given.items():
            if not 0.0 < value < math.inf:
                raise ConfigError(f"{name} = {value}: must be positive and finite")
        self._left_radius = wheel_radius * left_wheel_radius_multiplier
        self._right_radius = wheel_radius * right_wheel_radius_multiplier
        self._separation = wheel_separation * wheel_separation_multiplier
        self.reset()

    @classmethod
    def of(cls, config: RobotConfig) -> Self:
        """Return the odometry of a robot, at the origin.

        Args:
            config: of the robot.
        """
        return cls(
            config.wheel_radius,
            config.wheel_separation,
            config.wheel_separation_multiplier,
            left_wheel_radius_multiplier=config.left_wheel_radius_multiplier,
            right_wheel_radius_multiplier=config.right_wheel_radius_multiplier,
        )

    def reset(self) -> None:
        """Set pose, twist and wheel angles to zero."""
        self.pose = (0.0, 0.0, 0.0)
        self.twist = (0.0, 0.0)
        self.wheel_positions = ZERO

    def update(self, speeds: Sequence[float], dt: float) -> None:
        """Integrate wheel speeds over time.

        Args:
            speeds: four wheel speeds [rad/s], in the order of `protocol.WHEELS`.
            dt: duration [s].

        Raises:
            CommandError: there aren't four finite speeds, or `dt` is negative or not finite.
        """
        if len(speeds) != 4:
            raise CommandError(f"odometry needs 4 wheel speeds (a, b, c, d), got {len(speeds)}")
        a, b, c, d = speeds
        linear, angular = kinematics.compute_twist(
            a, b, c, d, self._left_radius, self._right_radius, self._separation
        )
        x, y, theta = self.pose
        cos, sin = math.cos(theta), math.sin(theta)
        x, y, theta = integrate_twist(x, y, theta, cos, sin, linear, angular, dt)
        if not (math.isfinite(x + y + theta) and 0.0 <= dt < math.inf):
            raise CommandError(f"odometry can't integrate speeds {tuple(speeds)} over dt = {dt} s")
        if abs(theta) > 1e3:  # the loops of equation (10) would take long
            theta = math.remainder(theta, 2.0 * math.pi)
        while theta > math.pi:
            theta -= 2.0 * math.pi
        while theta < -math.pi:
            theta += 2.0 * math.pi
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
