"""Wheel speeds to twist and back: equations (1)-(3) of the robot's hardware interface document.

Wheel order is front_right, front_left, rear_left, rear_right. Twist is (linear m/s along +x,
angular rad/s, counter-clockwise positive), in the base frame of REP 103.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from acsar_gym.errors import CommandError
from acsar_gym.protocol import Speeds


def forward(
    speeds: Sequence[float], wheel_radius: float, wheel_separation: float
) -> tuple[float, float]:
    """Twist (linear [m/s], angular [rad/s]) of four wheel speeds [rad/s]. Lengths in m.

    `wheel_separation` is the effective one: multiplied by the wheel_separation_multiplier where
    the robot skids.
    """
    front_right, front_left, rear_left, rear_right = speeds
    left = (front_left * wheel_radius + rear_left * wheel_radius) / 2.0
    right = (front_right * wheel_radius + rear_right * wheel_radius) / 2.0
    return (left + right) / 2.0, (right - left) / wheel_separation


def inverse(
    linear: float,
    angular: float,
    wheel_radius: float,
    wheel_separation: float,
    max_speed: float = math.inf,
) -> Speeds:
    """Four wheel speeds [rad/s] for a twist (linear [m/s], angular [rad/s]).

    Beyond `max_speed` [rad/s] all four shrink by the same factor, which keeps the turn radius.
    Raises CommandError where a wheel speed would not be finite.
    """
    half_turn = angular * wheel_separation / 2.0
    left = (linear - half_turn) / wheel_radius
    right = (linear + half_turn) / wheel_radius
    fastest = max(abs(left), abs(right))
    if not math.isfinite(fastest):
        raise CommandError(f"twist = ({linear}, {angular}): must be finite m/s and rad/s")
    if fastest > max_speed:
        left = max_speed * (left / fastest)
        right = max_speed * (right / fastest)
    return right, left, left, right
