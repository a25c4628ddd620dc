"""Forward and inverse kinematics: equations (1)-(3) of the robot's hardware interface document.

Wheel order is front_right, front_left, rear_left, rear_right. A twist is (linear [m/s] along +x,
angular [rad/s], counter-clockwise positive) in the base frame of REP 103.

Example:
    >>> from acsar_gym import kinematics
    >>> speeds = kinematics.inverse(0.5, 0.0, wheel_radius=0.05, wheel_separation=0.3)
    >>> kinematics.forward(speeds, wheel_radius=0.05, wheel_separation=0.3)
    (0.5, 0.0)
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.protocol import Speeds

__all__ = ["forward", "inverse"]


def forward(
    speeds: Sequence[float], wheel_radius: float, wheel_separation: float
) -> tuple[float, float]:
    """Compute the twist of four wheel speeds.

    Args:
        speeds: Wheel speeds [rad/s] in the order of this module.
        wheel_radius: Radius of the wheels [m].
        wheel_separation: Effective separation [m], which includes wheel_separation_multiplier.

    Returns:
        Linear [m/s] and angular velocity [rad/s].

    Example:
        >>> from acsar_gym import kinematics
        >>> kinematics.forward((10.0, 10.0, 10.0, 10.0), wheel_radius=0.05, wheel_separation=0.3)
        (0.5, 0.0)
    """
    a, b, c, d = speeds
    return compute_twist(
        a,
        b,
        c,
        d,
        left_radius=wheel_radius,
        right_radius=wheel_radius,
        wheel_separation=wheel_separation,
    )


def compute_twist(
    a: float,
    b: float,
    c: float,
    d: float,
    left_radius: float,
    right_radius: float,
    wheel_separation: float,
) -> tuple[float, float]:
    """Compute the twist of four wheel speeds, for each side's own radius. Also in compiled code."""
    left_speed = (b * left_radius + c * left_radius) / 2.0
    right_speed = (a * right_radius + d * right_radius) / 2.0
    return (left_speed + right_speed) / 2.0, (right_speed - left_speed) / wheel_separation


def inverse(
    linear: float,
    angular: float,
    wheel_radius: float,
    wheel_separation: float,
    max_speed: float = math.inf,
) -> Speeds:
    """Compute the wheel speeds of a twist.

    Args:
        linear: Linear velocity [m/s].
        angular: Angular velocity [rad/s].
        wheel_radius: Radius of the wheels [m].
        wheel_separation: Effective separation [m], which includes wheel_separation_multiplier.
        max_speed: Largest wheel speed [rad/s]. If it is exceeded, all four are scaled by the same
            factor, which keeps the turning radius.

    Returns:
        Wheel speeds [rad/s] in the order of this module.

    Raises:
        ConfigError: A length isn't positive, or `max_speed` is negative.
        CommandError: A wheel speed would not be finite.

    Example:
        >>> from acsar_gym import kinematics
        >>> kinematics.inverse(0.5, 0.0, wheel_radius=0.05, wheel_separation=0.3)
        (10.0, 10.0, 10.0, 10.0)
    """
    if not (wheel_radius > 0.0 and wheel_separation > 0.0 and max_speed >= 0.0):
        raise ConfigError(
            f"wheel_radius = {wheel_radius}, wheel_separation = {wheel_separation}, max_speed = "
            f"{max_speed}: must be positive"
        )
    return compute_speeds(
        linear,
        angular,
        left_radius=wheel_radius,
        right_radius=wheel_radius,
        wheel_separation=wheel_separation,
        max_speed=max_speed,
    )


def compute_speeds(
    linear: float,
    angular: float,
    left_radius: float,
    right_radius: float,
    wheel_separation: float,
    max_speed: float,
) -> Speeds:
    """Compute the wheel speeds of `inverse`, for each side's own radius [m].

    Raises:
        CommandError: A wheel speed would not be finite.
    """
    right_speed, left_speed = compute_sides(
        linear,
        angular,
        left_radius=left_radius,
        right_radius=right_radius,
        wheel_separation=wheel_separation,
        max_speed=max_speed,
    )
    if not (math.isfinite(right_speed) and math.isfinite(left_speed)):
        raise CommandError(
            f"twist = ({linear}, {angular}): must be finite m/s and rad/s, and so must wheel speeds"
        )
    return right_speed, left_speed, left_speed, right_speed


def compute_sides(
    linear: float,
    angular: float,
    left_radius: float,
    right_radius: float,
    wheel_separation: float,
    max_speed: float,
) -> tuple[float, float]:
    """Return the right and left wheel speeds [rad/s], also in compiled code. NaN on overflow."""
    # Equations (1) and (2) solved for the speeds of the two sides.
    half_turn = angular * wheel_separation / 2.0
    left_speed = (linear - half_turn) / left_radius
    right_speed = (linear + half_turn) / right_radius
    fastest = max(abs(left_speed), abs(right_speed))
    # One factor for both sides keeps the turn radius.
    scale = max_speed / fastest if fastest > max_speed else 1.0
    return scale * right_speed, scale * left_speed
