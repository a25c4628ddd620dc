"""Limits on speed, acceleration and jerk, with the names and rules of ROS diff_drive_controller.

The controller's SpeedLimiter limits a velocity by the two velocities before it: first jerk, then
acceleration, then velocity. In ROS 2 from Jazzy on, accelerations may differ between a robot that
goes forward and one that goes backward. These are pure functions, so that numba can compile them
for batches.
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
    """Of a robot that goes forward, with the next one."""
    max_acceleration: float = FREE
    min_jerk: float = -FREE
    max_jerk: float = FREE
    min_reverse: float = -FREE
    """Acceleration of a robot that goes backward, with the next one."""
    max_reverse: float = FREE

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
    low, high = _range(config.min_velocity, config.max_velocity)
    slower, faster = _range(config.min_acceleration, config.max_acceleration)
    brakes = slower if config.max_deceleration is None else -abs(config.max_deceleration)
    back, forth = config.max_acceleration_reverse, config.max_deceleration_reverse
    if forth is None:
        forth = faster if config.max_deceleration is None else config.max_deceleration
    jerks = _range(config.min_jerk, config.max_jerk)
    low, high = max(low, -top), min(high, top)
    return Limits(
        low, high, brakes, faster, *jerks, slower if back is None else -abs(back), abs(forth)
    )


def _range(low: float | None, high: float | None) -> tuple[float, float]:
    """Lower and upper limit; a missing lower one is minus the upper one."""
    high = FREE if high is None else high
    return (-high if low is None else low), high


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
    least = axis.min_acceleration if last > 0.0 else axis.min_reverse
    most = axis.max_acceleration if last >= 0.0 else axis.max_reverse
    rise = min(max(velocity - last, least * dt), most * dt)
    return min(max(last + rise, axis.min_velocity), axis.max_velocity)
