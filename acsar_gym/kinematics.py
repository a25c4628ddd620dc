"""Forward and inverse kinematics: equations (1)-(3) of the robot's hardware interface document.

Wheel order is front_right, front_left, rear_left, rear_right. A twist is (linear [m/s] along +x,
angular [rad/s], counter-clockwise positive) in the base frame of REP 103.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from acsar_gym.errors import CommandError, ConfigError
from acsar_gym.protocol import Speeds

__all__ = ["forward", "inverse"]


def forward(
    speeds: Sequence[float],
    wheel_radius: float,
    wheel_separation: float,
    *,
    left_wheel_radius_multiplier: float = 1.0,
    right_wheel_radius_multiplier: float = 1.0,
) -> tuple[float, float]:
    """Compute the twist of four wheel speeds.

    Args:
        speeds: wheel speeds [rad/s] in the order of this module.
        wheel_radius: [m].
        wheel_separation: effective separation [m], which includes wheel_separation_multiplier.
        left_wheel_radius_multiplier: factor from wheel_radius to the radius of the left wheels.
        right_wheel_radius_multiplier: factor from wheel_radius to the radius of the right wheels.

    Returns:
        Linear [m/s] and angular velocity [rad/s].
    """
    a, b, c, d = speeds
    left_radius = wheel_radius * left_wheel_radius_multiplier
    right_radius = wheel_radius * right_wheel_radius_multiplier
    return compute_twist(a, b, c, d, left_radius, right_radius, wheel_separation)


def compute_twist(
    a: float,
    b: float,
    c: float,
    d: float,
    left_radius: float,
    right_radius: float,
    wheel_separation: float,
) -> tuple[float, float]:
    """Compute `forward` from four single wheel speeds, for compiled code."""
    left = (b * left_radius + c * left_radius) / 2.0
    right = (a * right_radius + d * right_radius) / 2.0
    return (left + right) / 2.0, (right - left) / wheel_separation


def inverse(
    linear: float,
    angular: float,
    wheel_radius: float,
    wheel_separation: float,
    max_speed: float = math.inf,
    *,
    left_wheel_radius_multiplier: float = 1.0,
    right_wheel_radius_multiplier: float = 1.0,
) -> Speeds:
    """Compute the wheel speeds of a twist.

    Args:
        linear: linear velocity [m/s].
        angular: angular velocity [rad/s].
        wheel_radius: [m].
        wheel_separation: effective separation [m], which includes wheel_separation_multiplier.
        max_speed: largest wheel speed [rad/s]. Beyond it, all four are scaled by the same
            factor, which keeps the turning radius.
        left_wheel_radius_multiplier: factor from wheel_radius to the radius of the left wheels.
        right_wheel_radius_multiplier: factor from wheel_radius to the radius of the right wheels.

    Returns:
        Wheel speeds [rad/s] in the order of this module.

    Raises:
        ConfigError: a length isn't positive, or `max_speed` is negative.
        CommandError: a wheel speed would not be finite.
    """
    left_radius = wheel_radius * left_wheel_radius_multiplier
    right_radius = wheel_radius * right_wheel_radius_multiplier
    if not (min(left_radius, right_radius) > 0.0 and wheel_separation > 0.0 and max_speed >= 0.0):
        raise ConfigError(
            f"wheel_radius = {wheel_radius}, wheel_separation = {wheel_separation}, max_speed = "
            f"{max_speed}: must be positive, and so must the multipliers"
        )
    right, left = compute_sides(
        linear, angular, left_radius, right_radius, wheel_separation, max_speed
    )
    if not (math.isfinite(right) and math.isfinite(left)):
        raise CommandError(
            f"twist = ({linear}, {angular}): must be finite m/s and rad/s, and so must wheel speeds"
        )
    return right, left, left, right


def compute_sides(
    linear: float,
    angular: float,
    left_radius: float,
    right_radius: float,
    wheel_separation: float,
    max_speed: float,
) -> tuple[float, float]:
    """Return the right and left wheel speeds [rad/s] of `inverse`, unchecked; NaN on overflow."""
    half_turn = angular * wheel_separation / 2.0
    left = (linear - half_turn) / left_radius
    right = (linear + half_turn) / right_radius
    fastest = max(abs(left), abs(right))
    scale = max_speed / fastest if fastest > max_speed else 1.0
    return scale * right, scale * left
