"""The rules of the safety layer, as pure functions of one robot and one tick.

`Safety` calls them for a single robot, and the loops of `vector/kernel` for batches, so numba must
be able to compile them. Limits on speed, acceleration and jerk have the names and the arithmetic of
ROS diff_drive_controller.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

from acsar_gym import kinematics
from acsar_gym.config import Geofence, RobotConfig, SpeedLimits
from acsar_gym.jit import jit, loop

NO_LIMIT = 1e18  # a number that no limit reaches
STALE_SHARE = 0.8  # of feedback_timeout: older feedback stops the wheels until it is fresh again
TWIST_TOLERANCE = 1e-9  # difference of twists that are equal except for rounding [m/s, rad/s]
TIME_SLACK = 1e-9  # tolerance for comparing ages, which are sums of periods [s]

_compute_sides = jit(kinematics.compute_sides)
_compute_twist = jit(kinematics.compute_twist)


class Reason(IntEnum):
    """Why the twist that was sent differs from the commanded twist."""

    NONE = 0
    LIMITS = 1
    """A limit of speed, acceleration or jerk, or the wheels' top speed."""
    GEOFENCE = 2
    """The robot has left the geofence by odometry. Holds until the next reset."""
    STALE_FEEDBACK = 3
    """The feedback is too old. Holds until a new line arrives."""
    EMERGENCY_STOP = 4
    """An emergency stop. Holds until it is released and the robot is reset."""


# Reasons as floats, for compiled functions.
_LIMITS = float(Reason.LIMITS)
_GEOFENCE = float(Reason.GEOFENCE)
_STALE = float(Reason.STALE_FEEDBACK)

HELD_REASONS = {
    Reason.GEOFENCE: (
        "the geofence",
        "start farther inside, or change geofence in the robot's file",
    ),
    Reason.EMERGENCY_STOP: ("an emergency stop", "start again when it is safe"),
}
"""Reasons that hold until the reset: what ended an episode, and what to do."""


class AxisLimits(NamedTuple):
    """Limits of the linear or the angular velocity, in m or rad, and s."""

    min_velocity: float = -NO_LIMIT
    max_velocity: float = NO_LIMIT
    min_acceleration: float = -NO_LIMIT
    """Least acceleration of a robot that drives forward."""
    max_acceleration: float = NO_LIMIT
    """Largest acceleration of a robot that drives forward."""
    min_jerk: float = -NO_LIMIT
    max_jerk: float = NO_LIMIT
    min_reverse: float = -NO_LIMIT
    """Least acceleration of a robot that drives backward."""
    max_reverse: float = NO_LIMIT
    """Largest acceleration of a robot that drives backward."""


def read_limits(config: SpeedLimits, top: float = NO_LIMIT) -> AxisLimits:
    """Convert the configured limits of an axis to numbers.

    Args:
        config: Limits. None is no limit.
        top: Largest speed in both directions.
    """
    low, high = _read_pair(config.min_velocity, config.max_velocity)
    slow_down, speed_up = _read_pair(config.min_acceleration, config.max_acceleration)
    min_jerk, max_jerk = _read_pair(config.min_jerk, config.max_jerk)

    # From ROS 2 Jazzy on: a deceleration, and accelerations of a robot that drives backward.
    braking = slow_down if config.max_deceleration is None else -abs(config.max_deceleration)
    reverse = config.max_acceleration_reverse
    reverse_braking = config.max_deceleration_reverse
    if reverse_braking is None:
        reverse_braking = speed_up if config.max_deceleration is None else config.max_deceleration
    return AxisLimits(
        min_velocity=max(low, -top),
        max_velocity=min(high, top),
        min_acceleration=braking,
        max_acceleration=speed_up,
        min_jerk=min_jerk,
        max_jerk=max_jerk,
        min_reverse=slow_down if reverse is None else -abs(reverse),
        max_reverse=abs(reverse_braking),
    )


def _read_pair(low: float | None, high: float | None) -> tuple[float, float]:
    """Return both limits of a quantity. The lower limit is the negative upper one by default."""
    high = NO_LIMIT if high is None else high
    return -high if low is None else low, high


def is_unlimited(config: RobotConfig) -> bool:
    """Return whether a robot has no limits except the speeds of a full action."""
    axes = (config.linear_limits, config.angular_limits)
    return all(read_limits(axis) == AxisLimits() for axis in axes)


class SafetyRules(NamedTuple):
    """The numbers of a robot's configuration that the rules need, in SI units."""

    period: float
    """Duration of a tick [s]."""
    free: bool
    """Whether only the speeds of a full action limit a twist."""
    linear: AxisLimits
    angular: AxisLimits
    min_x: float
    """Bounds of the geofence [m]. Infinite without a geofence."""
    max_x: float
    min_y: float
    max_y: float
    stale: float
    """Age of the feedback that stops the wheels [s]."""
    timeout: float
    """Age of the feedback that ends the episode [s]."""
    left_radius: float
    """Radius of the left wheels [m]."""
    right_radius: float
    """Radius of the right wheels [m]."""
    separation: float
    """Effective wheel separation, which includes the factor for skidding [m]."""
    top: float
    """Fastest wheel speed that may be sent [rad/s]."""


def make_rules(config: RobotConfig) -> SafetyRules:
    """Return the rules of a robot."""
    left_radius, right_radius = config.wheel_radii
    fence = config.geofence or Geofence()

    return SafetyRules(
        period=config.period,
        free=is_unlimited(config),
        linear=read_limits(config.linear_limits, config.max_linear),
        angular=read_limits(config.angular_limits, config.max_angular),
        **fence.model_dump(),
        stale=STALE_SHARE * config.feedback_timeout,
        timeout=config.feedback_timeout,
        left_radius=left_radius,
        right_radius=right_radius,
        separation=config.effective_separation,
        top=config.max_wheel_speed,
    )


class SafetyMemory(NamedTuple):
    """What the rules remember of a robot from tick to tick. All zeros after a reset."""

    latched: float = 0.0
    """The `Reason` that holds the robot until the reset. 0 for none."""
    reason: float = 0.0
    """The `Reason` of this tick. 0 for none."""
    linear: float = 0.0
    """Velocity of the newest twist [m/s]."""
    angular: float = 0.0
    """Turn rate of the newest twist [rad/s]."""
    past_linear: float = 0.0
    """Velocity of the twist before it [m/s]."""
    past_angular: float = 0.0
    """Turn rate of the twist before it [rad/s]."""
    sent_linear: float = 0.0
    """Velocity of the wheel speeds that were sent [m/s]. Only for a single robot."""
    sent_angular: float = 0.0
    """Turn rate of the wheel speeds that were sent [rad/s]. Only for a single robot."""


@jit
def find_holds(
    memory: SafetyMemory, x: float, y: float, age: float, rules: SafetyRules
) -> tuple[float, float]:
    """Find the reasons for which the wheels must not turn.

    Args:
        memory: Memory of the tick before.
        x: Position by odometry [m].
        y: Position by odometry [m].
        age: Age of the feedback [s].
        rules: Rules of the robot.

    Returns:
        The reason that holds until the reset, and the reason of this tick. 0 for none.
    """
    # NaN is inside of nothing, so a lost pose stops the robot.
    inside = (rules.min_x <= x) & (x <= rules.max_x) & (rules.min_y <= y) & (y <= rules.max_y)
    latched = memory.latched if inside or memory.latched > 0.0 else _GEOFENCE
    stale = _STALE if age > rules.stale + TIME_SLACK else 0.0
    return latched, (latched if latched > 0.0 else stale)


@jit
def limit_twist(
    linear: float,
    angular: float,
    x: float,
    y: float,
    age: float,
    memory: SafetyMemory,
    rules: SafetyRules,
) -> SafetyMemory:
    """Compute the twist that may be sent in this tick. A stop, (0, 0), is immediate.

    Returns:
        The memory of this tick, with the twist.
    """
    latched, reason = find_holds(memory, x, y, age=age, rules=rules)
    stops = (reason > 0.0) | ((linear == 0.0) & (angular == 0.0))
    new_linear = _limit_axis(
        linear, memory.linear, memory.past_linear, axis=rules.linear, rules=rules
    )
    new_angular = _limit_axis(
        angular, memory.angular, memory.past_angular, axis=rules.angular, rules=rules
    )

    return SafetyMemory(
        latched=latched,
        reason=reason,
        linear=0.0 if stops else new_linear,
        angular=0.0 if stops else new_angular,
        past_linear=0.0 if stops else memory.linear,
        past_angular=0.0 if stops else memory.angular,
        sent_linear=memory.sent_linear,
        sent_angular=memory.sent_angular,
    )


@jit
def _limit_axis(
    wanted: float, last: float, second_last: float, axis: AxisLimits, rules: SafetyRules
) -> float:
    """Compute the velocity of an axis that may follow the last two."""
    if rules.free:
        return min(max(wanted, axis.min_velocity), axis.max_velocity)
    return limit_velocity(wanted, last, second_last, dt=rules.period, axis=axis)


@jit
def limit_velocity(
    wanted: float, last: float, second_last: float, dt: float, axis: AxisLimits
) -> float:
    """Compute the velocity that may follow the last two: limit jerk, acceleration, velocity.

    As in the ROS controller, jerk is the change of the change of velocity over 2 dt^2.
    """
    step = last - second_last
    scale = 2.0 * dt * dt
    change = min(max(wanted - last - step, axis.min_jerk * scale), axis.max_jerk * scale)
    velocity = last + step + change

    # A robot that turns round brakes by the limits of the direction it came from.
    braking = axis.min_acceleration if last > 0.0 else axis.min_reverse
    speeding_up = axis.max_acceleration if last >= 0.0 else axis.max_reverse
    rise = min(max(velocity - last, braking * dt), speeding_up * dt)
    return min(max(last + rise, axis.min_velocity), axis.max_velocity)


@jit
def compute_wheels(linear: float, angular: float, rules: SafetyRules) -> tuple[float, float]:
    """Compute the speeds of the right and the left wheels for a twist [rad/s]."""
    return _compute_sides(
        linear,
        angular,
        left_radius=rules.left_radius,
        right_radius=rules.right_radius,
        wheel_separation=rules.separation,
        max_speed=rules.top,
    )


@jit
def explain_sent(
    linear: float, angular: float, right: float, left: float, reason: float, rules: SafetyRules
) -> tuple[float, float, float]:
    """Compute the twist of sent wheel speeds, and why it differs from the commanded twist.

    Args:
        linear: Commanded velocity [m/s].
        angular: Commanded turn rate [rad/s].
        right: Sent speed of the right wheels [rad/s].
        left: Sent speed of the left wheels [rad/s].
        reason: Reason that holds the robot. 0 for none.
        rules: Rules of the robot.

    Returns:
        Velocity [m/s], turn rate [rad/s] and the `Reason`.
    """
    geometry = (rules.left_radius, rules.right_radius, rules.separation)
    sent_linear, sent_angular = _compute_twist(right, left, left, right, *geometry)
    same_linear = abs(sent_linear - linear) < TWIST_TOLERANCE
    same_angular = abs(sent_angular - angular) < TWIST_TOLERANCE
    limits = 0.0 if same_linear & same_angular else _LIMITS
    return sent_linear, sent_angular, (reason if reason > 0.0 else limits)


@jit
def is_silent(age: float, rules: SafetyRules) -> bool:
    """Return whether feedback of this age [s] ends the episode."""
    return age > rules.timeout + TIME_SLACK


@loop
def update_twist(
    linear: float, angular: float, x: float, y: float, age: float, memory: Any, rules: Any
) -> tuple[float, float]:
    """Update the memory of a single robot by `limit_twist`. Records as in `jit.record_of`.

    Returns:
        Speeds of the right and the left wheels [rad/s].
    """
    robot = memory[0]
    numbers = rules[0]
    new = limit_twist(linear, angular, x, y=y, age=age, memory=robot, rules=numbers)
    right, left = compute_wheels(new.linear, new.angular, numbers)
    robot.sent_linear, robot.sent_angular, robot.reason = explain_sent(
        linear, angular, right, left=left, reason=new.reason, rules=numbers
    )

    robot.latched = new.latched
    robot.past_linear = new.past_linear
    robot.past_angular = new.past_angular
    robot.linear = new.linear
    robot.angular = new.angular
    return right, left
