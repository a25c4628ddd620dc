"""The rules of the safety layer, as pure functions of one robot and one tick.

`Safety` calls them for the single robot, and the loops of `vector/kernel` for thousands. Everything
that a rule needs to know of the robot's configuration is in `Rules`.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from acsar_gym import kinematics
from acsar_gym.config import Geofence, RobotConfig
from acsar_gym.jit import jit
from acsar_gym.safety import limiter
from acsar_gym.safety.limiter import Limits, limited

STALE_SHARE = 0.8
"""Feedback older than this share of `feedback_timeout` stops the wheels until it is fresh again."""
TELLABLE = 1e-9
"""A twist that differs by less was sent as asked [m/s, rad/s]."""
SLACK = 1e-9
"""For comparing ages, which are sums of periods [s]."""

_sides = jit(kinematics.sides)
_twist = jit(kinematics.twist)


class Reason(IntEnum):
    """Why the twist that was sent isn't the one that was asked for."""

    NONE = 0
    LIMITS = 1
    """Of speed, acceleration or jerk, or the wheels' top speed."""
    GEOFENCE = 2
    """Odometry is outside; until the next reset."""
    STALE_FEEDBACK = 3
    """The board hasn't answered for a while; until it does."""
    EMERGENCY_STOP = 4
    """A person said so; until the next reset."""


_LIMITS, _GEOFENCE, _STALE = 1.0, 2.0, 3.0
"""Numbers of these reasons, as compiled functions have them."""


class Rules(NamedTuple):
    """What the rules need to know of a robot's configuration; SI units."""

    period: float
    """Of a tick [s]."""
    free: bool
    """Whether nothing but the full speeds limits a twist."""
    linear: Limits
    angular: Limits
    fence: tuple[float, float, float, float]
    """Least and largest x, least and largest y [m]; infinite where there is no geofence."""
    stale: float
    """Feedback older than this stops the wheels [s]."""
    timeout: float
    """Feedback older than this ends the episode [s]."""
    radius: float
    """Of the wheels [m]."""
    separation: float
    """Of the wheels, multiplied for their skidding [m]."""
    top: float
    """The fastest that a wheel may be asked to turn [rad/s]."""


def of(config: RobotConfig) -> Rules:
    """The rules' numbers for a configured robot."""
    linear, angular = limiter.both(config)
    fence = config.geofence or Geofence()
    return Rules(
        period=config.period,
        free=limiter.free(config),
        linear=linear,
        angular=angular,
        fence=(fence.min_x, fence.max_x, fence.min_y, fence.max_y),
        stale=STALE_SHARE * config.feedback_timeout,
        timeout=config.feedback_timeout,
        radius=config.wheel_radius,
        separation=config.effective_separation,
        top=config.max_wheel_speed,
    )


class Memory(NamedTuple):
    """What the rules remember of a robot from tick to tick; all zeros at a reset."""

    latched: float = 0.0
    """The `Reason` that holds the robot until the reset."""
    reason: float = 0.0
    """The `Reason` that holds it in this tick."""
    linear: float = 0.0
    """The newest twist, on its way to the wheels [m/s]."""
    angular: float = 0.0
    """[rad/s]"""
    past_linear: float = 0.0
    """The twist before it [m/s]."""
    past_angular: float = 0.0
    """[rad/s]"""


@jit
def held(memory: Memory, x: float, y: float, age: float, rules: Rules) -> tuple[float, float]:
    """Reasons for which the wheels must not turn: until the reset, and in this tick; 0 for none.

    Odometry is at (x, y) [m], and the newest feedback is of this age [s].
    """
    low_x, high_x, low_y, high_y = rules.fence
    inside = (low_x <= x) & (x <= high_x) & (low_y <= y) & (y <= high_y)
    latched = memory.latched if inside or memory.latched > 0.0 else _GEOFENCE
    stale = _STALE if age > rules.stale + SLACK else 0.0
    return latched, (latched if latched > 0.0 else stale)


@jit
def allowed(
    linear: float, angular: float, x: float, y: float, age: float, memory: Memory, rules: Rules
) -> Memory:
    """The twist that may be sent in this tick, when this one is wanted (linear, angular).

    A stop is immediate. Where odometry is, and how old the newest feedback, is as in `held`.
    """
    latched, reason = held(memory, x, y, age, rules)
    stands = (reason > 0.0) | ((linear == 0.0) & (angular == 0.0))
    ahead = _within(linear, memory.linear, memory.past_linear, rules.linear, rules)
    turn = _within(angular, memory.angular, memory.past_angular, rules.angular, rules)
    return Memory(
        latched,
        reason,
        0.0 if stands else ahead,
        0.0 if stands else turn,
        0.0 if stands else memory.linear,
        0.0 if stands else memory.angular,
    )


@jit
def _within(wanted: float, last: float, before: float, axis: Limits, rules: Rules) -> float:
    """The velocity of one axis that may follow the last two."""
    if rules.free:
        return min(max(wanted, axis[0]), axis[1])
    return limited(wanted, last, before, rules.period, axis)


@jit
def wheels(memory: Memory, rules: Rules) -> tuple[float, float]:
    """Speeds of the right and the left wheels for the newest twist [rad/s]."""
    return _sides(memory.linear, memory.angular, rules.radius, rules.separation, rules.top)


@jit
def told(
    linear: float, angular: float, right: float, left: float, reason: float, rules: Rules
) -> tuple[float, float, float]:
    """The twist that these wheel speeds are, and the `Reason` why it isn't the one wanted."""
    ahead, turn = _twist(right, left, left, right, rules.radius, rules.separation)
    same = (abs(ahead - linear) < TELLABLE) & (abs(turn - angular) < TELLABLE)
    return ahead, turn, (reason if reason > 0.0 else (0.0 if same else _LIMITS))


def silent(age: float, rules: Rules) -> bool:
    """Whether feedback is so old [s] that the episode ends; plain Python, to be compiled or not."""
    return age > rules.timeout + SLACK


# One robot at a time: numba takes two arrays in a fifth of the time that it takes for named tuples.

SENT = len(Memory._fields)
"""Where the memory of one robot has the twist that was sent, behind what the rules remember."""
NUMBERS = SENT + 2


def flat(rules: Rules) -> list[float]:
    """The rules' numbers, one after the other."""
    first, last = (rules.period, float(rules.free)), rules[5:]
    return [*first, *rules.linear, *rules.angular, *rules.fence, *last]


@jit
def _rules(n: Sequence[float]) -> Rules:
    """The rules of which these are the numbers."""
    return Rules(
        n[0],
        n[1] > 0.0,
        Limits(n[2], n[3], n[4], n[5], n[6], n[7]),
        Limits(n[8], n[9], n[10], n[11], n[12], n[13]),
        (n[14], n[15], n[16], n[17]),
        n[18],
        n[19],
        n[20],
        n[21],
        n[22],
    )


@jit
def hold(x: float, y: float, age: float, memory: list[float], numbers: Sequence[float]) -> float:
    """`held` for one robot whose memory is kept in place; the reason that holds in this tick."""
    before = Memory(memory[0], memory[1], memory[2], memory[3], memory[4], memory[5])
    memory[0], memory[1] = held(before, x, y, age, _rules(numbers))
    return memory[1]


@jit
def tick(
    linear: float,
    angular: float,
    x: float,
    y: float,
    age: float,
    memory: list[float],
    numbers: Sequence[float],
) -> tuple[float, float]:
    """`allowed` for one robot whose memory is kept in place; right and left wheels [rad/s]."""
    rules = _rules(numbers)
    before = Memory(memory[0], memory[1], memory[2], memory[3], memory[4], memory[5])
    after = allowed(linear, angular, x, y, age, before, rules)
    right, left = wheels(after, rules)
    ahead, turn, reason = told(linear, angular, right, left, after.reason, rules)
    memory[0], memory[1], memory[2], memory[3] = after.latched, reason, after.linear, after.angular
    memory[4], memory[5] = after.past_linear, after.past_angular
    memory[6], memory[7] = ahead, turn
    return right, left
