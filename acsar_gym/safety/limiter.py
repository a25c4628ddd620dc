"""Limits on speed, acceleration and jerk, with the names and rules of ROS diff_drive_controller.

The controller's SpeedLimiter (ROS 1, and ROS 2 up to Humble) limits a velocity by the two
velocities before it: first jerk, then acceleration, then velocity. These are pure functions, so
that numba can compile them for batches.
"""

from __future__ import annotations

from typing import NamedTuple

from acsar_gym.config import RobotConfig, SpeedLimits
from acsar_gym.jit import jit

FREE = 1e18
"""Number that stands for no limit."""


class Limits(NamedTuple):
    """Limits of one axis; velocity, acceleration and jerk in m or rad, and s."""

    min_velocity: float = -FREE
    max_velocity: float = FREE
    min_acceleration: float = -FREE
    max_acceleration: float = FREE
    min_jerk: float = -FREE
    max_jerk: float = FREE

    @property
    def free(self) -> bool:
        """Whether nothing is limited."""
        return self == Limits()


def limits(config: SpeedLimits, top: float = FREE) -> Limits:
    """Convert the limits of one axis to numbers.

    Args:
        config: of the axis; a missing minimum is minus the maximum.
        top: bounds the velocity in both directions [m/s or rad/s].
    """
    numbers = []
    for name in ("velocity", "acceleration", "jerk"):
        low, high = getattr(config, f"min_{name}"), getattr(config, f"max_{name}")
        high = FREE if high is None else high
        numbers += [-high if low is None else low, high]
    low, high, *others = numbers
    return Limits(max(low, -top), min(high, top), *others)


def both(config: RobotConfig) -> tuple[Limits, Limits]:
    """Limits of a robot's linear and angular velocity, including the speeds of a full action."""
    return (
        limits(config.linear_limits, config.max_linear),
        limits(config.angular_limits, config.max_angular),
    )


def free(config: RobotConfig) -> bool:
    """Whether the configuration has no limits beside the speeds of a full action."""
    return limits(config.linear_limits).free and limits(config.angular_limits).free


@jit
def limited(wanted: float, last: float, before: float, dt: float, axis: Limits) -> float:
    """Compute the velocity that may follow the last two.

    As in the ROS controller, jerk is the change of the change of velocity over 2 dt^2.

    Args:
        wanted: velocity of one axis [m/s or rad/s].
        last: velocity one period ago.
        before: velocity two periods ago.
        dt: period [s].
        axis: limits of the axis.
    """
    step, scale = last - before, 2.0 * dt * dt
    change = min(max(wanted - last - step, axis.min_jerk * scale), axis.max_jerk * scale)
    velocity = last + step + change
    rise = min(max(velocity - last, axis.min_acceleration * dt), axis.max_acceleration * dt)
    return min(max(last + rise, axis.min_velocity), axis.max_velocity)
