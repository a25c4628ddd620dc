"""Limits on speed, acceleration and jerk, named and behaving as in ROS diff_drive_controller.

The controller's SpeedLimiter (ROS 1, and ROS 2 up to Humble) limits a velocity against the two
velocities before it: first jerk, then acceleration, then velocity. Pure functions, compiled for
whole batches of robots, too.
"""

from __future__ import annotations

from typing import NamedTuple

from acsar_gym.config import RobotConfig, SpeedLimits
from acsar_gym.jit import jit

FREE = 1e18
"""Stands for no limit."""


class Limits(NamedTuple):
    """Of one axis: m or rad, and s."""

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
    """Numbers for what a robot's config limits; a missing minimum is minus the maximum.

    `top` bounds the velocity in both directions.
    """
    numbers = []
    for name in ("velocity", "acceleration", "jerk"):
        low, high = getattr(config, f"min_{name}"), getattr(config, f"max_{name}")
        high = FREE if high is None else high
        numbers += [-high if low is None else low, high]
    low, high, *others = numbers
    return Limits(max(low, -top), min(high, top), *others)


def both(config: RobotConfig) -> tuple[Limits, Limits]:
    """Of a robot's linear and angular velocity, whatever commands it."""
    return (
        limits(config.linear_limits, config.max_linear),
        limits(config.angular_limits, config.max_angular),
    )


def free(config: RobotConfig) -> bool:
    """Whether a full action and what leads to it is limited by nothing."""
    return limits(config.linear_limits).free and limits(config.angular_limits).free


@jit
def limited(wanted: float, last: float, before: float, dt: float, axis: Limits) -> float:
    """The velocity that may follow `last` and the one `before` it, each `dt` [s] earlier.

    As the ROS controller does it, jerk is the change of the change of velocity over 2 dt^2.
    """
    step, scale = last - before, 2.0 * dt * dt
    change = min(max(wanted - last - step, axis.min_jerk * scale), axis.max_jerk * scale)
    velocity = last + step + change
    rise = min(max(velocity - last, axis.min_acceleration * dt), axis.max_acceleration * dt)
    return min(max(last + rise, axis.min_velocity), axis.max_velocity)
