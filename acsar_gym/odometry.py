"""Wheel odometry: equations (1)-(11) of the robot's hardware interface document.

Example:
    >>> from acsar_gym import odometry
    >>> track = odometry.Odometry(wheel_radius=0.05, wheel_separation=0.3)
    >>> track.update((10.0, 10.0, 10.0, 10.0), dt=2.0)
    >>> track.twist
    (0.5, 0.0)
"""

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
        x: Position in the odometry frame [m].
        y: Position in the odometry frame [m].
        theta: Heading [rad].
        cos: Cosine of theta.
        sin: Sine of theta.
        linear: Forward velocity [m/s].
        angular: Yaw rate [rad/s].
        dt: Duration [s].

    Returns:
        The new x, y and theta. Theta isn't normalized.
    """
    x += linear * cos * dt
    y += linear * sin * dt
    return x, y, theta + angular * dt


class Odometry:
    """Integrates wheel speeds to a pose in the odometry frame, which starts at the origin.

    Args:
        wheel_radius: Radius of the wheels [m].
        wheel_separation: Distance of the wheels of both sides [m].
        wheel_separation_multiplier: Factor for the skidding of the wheels, as in ROS
            diff_drive_controller. With 1.0 the equations are those of the document.

    Attributes:
        pose: Pose x [m], y [m], theta [rad] within [-pi, pi].
        twist: Linear [m/s] and angular velocity [rad/s], in the base frame.
        wheel_positions: Integrated wheel angles [rad], in the order of `protocol.WHEELS`.
        pose_covariance: Row-major 6 x 6 matrix of (x, y, z, roll, pitch, yaw).
        twist_covariance: Row-major 6 x 6 matrix of the twist.

    Raises:
        ConfigError: An argument isn't positive and finite.

    Example:
        >>> from acsar_gym.odometry import Odometry
        >>> odometry = Odometry(wheel_radius=0.05, wheel_separation=0.3)
        >>> odometry.update((10.0, 10.0, 10.0, 10.0), dt=2.0)
        >>> odometry.pose
        (1.0, 0.0, 0.0)
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
        lengths = (wheel_radius, wheel_separation, wheel_separation_multiplier)
        if not all(0.0 < value < math.inf for value in lengths):
            raise ConfigError(
                f"wheel_radius = {wheel_radius}, wheel_separation = {wheel_separation}, "
                f"wheel_separation_multiplier = {wheel_separation_multiplier}: must be positive "
                "and finite"
            )
        self._left_radius = self._right_radius = wheel_radius
        self._separation = wheel_separation * wheel_separation_multiplier
        self.reset()

    @classmethod
    def of(cls, config: RobotConfig) -> Self:
        """Return the odometry of a robot, at the origin.

        Args:
            config: Robot configuration.
        """
        odometry = cls(
            config.wheel_radius, config.wheel_separation, config.wheel_separation_multiplier
        )
        odometry._left_radius, odometry._right_radius = config.wheel_radii
        return odometry

    def reset(self) -> None:
        """Set pose, twist and wheel angles to zero."""
        self.pose = (0.0, 0.0, 0.0)
        self.twist = (0.0, 0.0)
        self.wheel_positions = ZERO

    def update(self, speeds: Sequence[float], dt: float) -> None:
        """Integrate wheel speeds over time.

        Args:
            speeds: Four wheel speeds [rad/s], in the order of `protocol.WHEELS`.
            dt: Duration [s].

        Raises:
            CommandError: There aren't four finite speeds, or `dt` is negative or not finite.
        """
        if len(speeds) != 4:
            raise CommandError(f"odometry needs 4 wheel speeds (a, b, c, d), got {len(speeds)}")
        a, b, c, d = speeds
        # Equations (1)-(3): wheel speeds to a twist.
        linear, angular = kinematics.compute_twist(
            a,
            b,
            c,
            d,
            left_radius=self._left_radius,
            right_radius=self._right_radius,
            wheel_separation=self._separation,
        )

        x, y, theta = self.pose
        cos = math.cos(theta)
        sin = math.sin(theta)
        x, y, theta = integrate_twist(
            x, y, theta, cos=cos, sin=sin, linear=linear, angular=angular, dt=dt
        )
        # Nothing is changed by bad numbers, since the fields are set only below.
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

        # Wheel angles are those of the joints in ROS.
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
