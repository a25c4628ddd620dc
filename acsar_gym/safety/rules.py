"""The rules of the safety layer, as pure functions of one robot and one tick.

`Safety` calls them for the single robot, and the loops of `vector/kernel` for batches. `Rules` has
everything that they need of the robot's configuration.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

from acsar_gym import kinematics
from acsar_gym.config import Geofence, RobotConfig, SpeedLimits
from acsar_gym.jit import jit, loop

# Limits on speed, acceleration and jerk, with the names and rules of ROS diff_drive_controller.
#
# The controller's SpeedLimiter limits a velocity by the two velocities before it: first jerk, then
# acceleration, then velocity. In ROS 2 from Jazzy on, accelerations may differ between a robot that
# goes forward and one that goes backward. These are pure functions, so that numba can compile them
# for batches.

NO_LIMIT = 1e18  # number that stands for no limit


class AxisLimits(NamedTuple):
    """Limits of one axis; velocity, acceleration and jerk in m or rad, and s."""

    min_velocity: float = -NO_LIMIT
    max_velocity: float = NO_LIMIT
    min_acceleration: float = -NO_LIMIT
    """Of a robot that goes forward, with the next one."""
    max_acceleration: float = NO_LIMIT
    min_jerk: float = -NO_LIMIT
    max_jerk: float = NO_LIMIT
    min_reverse: float = -NO_LIMIT
    """Acceleration of a robot that goes backward, with the next one."""
    max_reverse: float = NO_LIMIT

    @property
    def free(self) -> bool:
        """Whether nothing is limited."""
        return self == AxisLimits()


def read_limits(config: SpeedLimits, top: float = NO_LIMIT) -> AxisLimits:
    """Convert the limits of one axis to numbers."""

    def complete(low: float | None, high: float | None) -> tuple[float, float]:
        high = NO_LIMIT if high is None else high
        return (-high if low is None else low), high

    low, high = complete(config.min_velocity, config.max_velocity)
    slower, faster = complete(config.min_acceleration, config.max_acceleration)
    brakes = slower if config.max_deceleration is None else -abs(config.max_deceleration)
    back, forth = config.max_acceleration_reverse, config.max_deceleration_reverse
    if forth is None:
        forth = faster if config.max_deceleration is None else config.max_deceleration
    return AxisLimits(
        max(low, -top),
        min(high, top),
        brakes,
        faster,
        *complete(config.min_jerk, config.max_jerk),
        slower if back is None else -abs(back),
        abs(forth),
    )


def is_unlimited(config: RobotConfig) -> bool:
    """Whether the configuration has no limits beside the speeds of a full action."""
    return read_limits(config.linear_limits).free and read_limits(config.angular_limits).free


@jit
def limit_velocity(wanted: float, last: float, before: float, dt: float, axis: AxisLimits) -> float:
    """Compute the velocity that may follow the last two.

    As in the ROS controller, jerk is the change of the change of velocity over 2 dt^2.
    """
    step, scale = last - before, 2.0 * dt * dt
    change = min(max(wanted - last - step, axis.min_jerk * scale), axis.max_jerk * scale)
    velocity = last + step + change
    least = axis.min_acceleration if last > 0.0 else axis.min_reverse
    most = axis.max_acceleration if last >= 0.0 else axis.max_reverse
    rise = min(max(velocity - last, least * dt), most * dt)
    return min(max(last + rise, axis.min_velocity), axis.max_velocity)


STALE_SHARE = 0.8  # of feedback_timeout: older feedback stops the wheels until it is fresh again
TWIST_TOLERANCE = 1e-9  # a sent twist this near is the one asked for [m/s, rad/s]
TIME_SLACK = 1e-9  # tolerance for comparing ages, which are sums of periods [s]

_sides = jit(kinematics.compute_sides)
_twist = jit(kinematics.compute_twist)


class Reason(IntEnum):
    """Why the twist that was sent differs from the one that was asked for."""

    NONE = 0
    LIMITS = 1
    """A limit of speed, acceleration or jerk, or the wheels' top speed."""
    GEOFENCE = 2
    """The robot has left the geofence by odometry; holds until the next reset."""
    STALE_FEEDBACK = 3
    """The feedback is too old; holds until a new line comes."""
    EMERGENCY_STOP = 4
    """An emergency stop; holds until it is released and the robot is reset."""


HELD_REASONS = {
    Reason.GEOFENCE: (
        "the geofence",
        "start farther inside, or change geofence in the robot's file",
    ),
    Reason.EMERGENCY_STOP: ("an emergency stop", "start again when it is safe"),
}
"""Reasons that hold until the reset: what ended an episode, and what to do."""
_LIMITS, _GEOFENCE, _STALE = 1.0, 2.0, 3.0  # these reasons as floats, for compiled functions


class SafetyRules(NamedTuple):
    """The numbers of a robot's configuration that the rules need; SI units."""

    period: float
    """Duration of a tick [s]."""
    free: bool
    """Whether only the speeds of a full action limit a twist."""
    linear: AxisLimits
    angular: AxisLimits
    min_x: float
    """Least x within the geofence [m]; this and the next three are infinite without one."""
    max_x: float
    min_y: float
    max_y: float
    stale: float
    """Feedback older than this stops the wheels [s]."""
    timeout: float
    """Feedback older than this ends the episode [s]."""
    left_radius: float
    """Radius of the left wheels [m]."""
    right_radius: float
    """Radius of the right wheels [m]."""
    separation: float
    """Effective wheel separation, which includes the factor for skidding [m]."""
    top: float
    """Fastest wheel speed that may be sent [rad/s]."""


def make_rules(config: RobotConfig) -> SafetyRules:
    """Take the rules' numbers from a robot's configuration."""
    left_radius, right_radius = config.wheel_radii
    fence = config.geofence or Geofence()
    return SafetyRules(
        period=config.period,
        free=is_unlimited(config),
        linear=read_limits(config.linear_limits, config.max_linear),
        angular=read_limits(config.angular_limits, config.max_angular),
        min_x=fence.min_x,
        max_x=fence.max_x,
        min_y=fence.min_y,
        max_y=fence.max_y,
        stale=STALE_SHARE * config.feedback_timeout,
        timeout=config.feedback_timeout,
        left_radius=left_radius,
        right_radius=right_radius,
        separation=config.effective_separation,
        top=config.max_wheel_speed,
    )


class SafetyMemory(NamedTuple):
    """What the rules remember of a robot from tick to tick; all zeros at a reset."""

    latched: float = 0.0
    """The `Reason` that holds the robot until the reset; 0 for none."""
    reason: float = 0.0
    """The `Reason` that holds it in this tick; 0 for none."""
    linear: float = 0.0
    """Linear part of the newest twist [m/s]."""
    angular: float = 0.0
    """Angular part of the newest twist [rad/s]."""
    past_linear: float = 0.0
    """Linear part of the twist before it [m/s]."""
    past_angular: float = 0.0
    """Angular part of the twist before it [rad/s]."""
    sent_linear: float = 0.0
    """Linear velocity of the wheel speeds that were sent [m/s]; kept for a single robot."""
    sent_angular: float = 0.0
    """Its angular velocity [rad/s]."""


@jit
def find_holds(
    memory: SafetyMemory, x: float, y: float, age: float, rules: SafetyRules
) -> tuple[float, float]:
    """Reasons for which the wheels must not turn.

    Returns:
        The reason that holds until the reset, and the one that holds in this tick; 0 for none.
    """
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
    latched, reason = find_holds(memory, x, y, age, rules)
    stands = (reason > 0.0) | ((linear == 0.0) & (angular == 0.0))
    ahead = _within(linear, memory.linear, memory.past_linear, rules.linear, rules)
    turn = _within(angular, memory.angular, memory.past_angular, rules.angular, rules)
    return SafetyMemory(
        latched,
        reason,
        0.0 if stands else ahead,
        0.0 if stands else turn,
        0.0 if stands else memory.linear,
        0.0 if stands else memory.angular,
        memory.sent_linear,
        memory.sent_angular,
    )


@jit
def _within(
    wanted: float, last: float, before: float, axis: AxisLimits, rules: SafetyRules
) -> float:
    """The velocity of one axis that may follow the last two."""
    if rules.free:
        return min(max(wanted, axis.min_velocity), axis.max_velocity)
    return limit_velocity(wanted, last, before, rules.period, axis)


@jit
def compute_wheels(linear: float, angular: float, rules: SafetyRules) -> tuple[float, float]:
    """Speeds of the right and the left wheels for a twist [rad/s]."""
    left, right = rules.left_radius, rules.right_radius
    return _sides(linear, angular, left, right, rules.separation, rules.top)


@jit
def explain_sent(
    linear: float, angular: float, right: float, left: float, reason: float, rules: SafetyRules
) -> tuple[float, float, float]:
    """Compute the twist of sent wheel speeds, and why it differs from the wanted one.

    Returns:
        Velocity [m/s], turn rate [rad/s] and the `Reason`.
    """
    radii = rules.left_radius, rules.right_radius
    ahead, turn = _twist(right, left, left, right, radii[0], radii[1], rules.separation)
    same = (abs(ahead - linear) < TWIST_TOLERANCE) & (abs(turn - angular) < TWIST_TOLERANCE)
    return ahead, turn, (reason if reason > 0.0 else (0.0 if same else _LIMITS))


@jit
def is_silent(age: float, rules: SafetyRules) -> bool:
    """Whether feedback of this age [s] ends the episode."""
    return age > rules.timeout + TIME_SLACK


# For a single robot, whose memory and rules are records; see `jit.record_of`.


@loop
def update_holds(x: float, y: float, age: float, memory: Any, rules: Any) -> float:
    """`find_holds` for one robot, whose memory is changed; returns the reason of this tick."""
    own = memory[0]
    own.latched, own.reason = find_holds(own, x, y, age, rules[0])
    reason: float = own.reason
    return reason


@loop
def update_twist(
    linear: float, angular: float, x: float, y: float, age: float, memory: Any, rules: Any
) -> tuple[float, float]:
    """`limit_twist` for one robot, whose memory is changed.

    Returns:
        Speeds of the right and the left wheels [rad/s].
    """
    own, numbers = memory[0], rules[0]
    after = limit_twist(linear, angular, x, y, age, own, numbers)
    right, left = compute_wheels(after.linear, after.angular, numbers)
    ahead, turn, reason = explain_sent(linear, angular, right, left, after.reason, numbers)
    own.latched, own.reason = after.latched, reason
    own.linear, own.angular = after.linear, after.angular
    own.past_linear, own.past_angular = after.past_linear, after.past_angular
    own.sent_linear, own.sent_angular = ahead, turn
    return right, left
