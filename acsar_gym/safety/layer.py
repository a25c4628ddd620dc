"""What stands between a wanted twist and the wheels: limits, geofence, stale feedback, and stop.

The same on every link, so that policies train through it. What is really sent, and why it differs
from what was asked, is told in `sent` and `reason`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import IntEnum

from acsar_gym import kinematics
from acsar_gym.config import RobotConfig
from acsar_gym.errors import CommandError
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.safety import limiter
from acsar_gym.worlds import Pose

Twist = tuple[float, float]
STANDING: Twist = (0.0, 0.0)
WHEELS = 4
STALE_SHARE = 0.8
"""Feedback older than this share of `feedback_timeout` stops the wheels until it is fresh again."""
TELLABLE = 1e-9
"""A twist that differs by less was sent as asked [m/s, rad/s]."""


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


class Safety:
    """One robot's safety layer."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._linear, self._angular = limiter.both(config)
        self._free = limiter.free(config)
        self._period = config.period
        self._fence = config.geofence
        self._stale = STALE_SHARE * config.feedback_timeout
        self.reset()

    def reset(self) -> None:
        """Arm: nothing has been sent, and every stop is forgotten."""
        self._latched = Reason.NONE
        self._asked: Twist = STANDING
        self.halt(Reason.NONE)

    def estop(self) -> None:
        """Stop now and until the reset."""
        self._latched = Reason.EMERGENCY_STOP

    @property
    def stopped(self) -> bool:
        """Whether a stop is latched."""
        return self._latched is not Reason.NONE

    def halt(self, reason: Reason) -> Speeds:
        """Wheels at zero, at once: limits are for driving, not for stopping."""
        self._last: Twist = STANDING
        self._before: Twist = STANDING
        self._steady = False
        self._speeds: Speeds = ZERO
        self._why: Reason | None = reason
        return ZERO

    @property
    def sent(self) -> Twist:
        """The newest twist on the wire (linear [m/s], angular [rad/s])."""
        config = self._config
        return kinematics.forward(self._speeds, config.wheel_radius, config.effective_separation)

    @property
    def reason(self) -> Reason:
        """Why it isn't the one that was asked for."""
        if self._why is not None:
            return self._why
        (linear, angular), sent = self._asked, self.sent
        same = abs(sent[0] - linear) < TELLABLE and abs(sent[1] - angular) < TELLABLE
        return Reason.NONE if same else Reason.LIMITS

    def hold(self, pose: Pose, feedback_age: float) -> Reason:
        """Why the wheels must not turn now; NONE where they may."""
        fence = self._fence
        if fence is not None and self._latched is Reason.NONE:
            x, y, _ = pose
            if not (fence.min_x <= x <= fence.max_x and fence.min_y <= y <= fence.max_y):
                self._latched = Reason.GEOFENCE
        if self._latched is not Reason.NONE:
            return self._latched
        return Reason.STALE_FEEDBACK if feedback_age > self._stale else Reason.NONE

    def speeds(self, linear: float, angular: float) -> Speeds:
        """Wheel speeds [rad/s] for a wanted twist, within the limits; a stop is immediate.

        Raises CommandError for a twist that isn't finite.
        """
        asked = (linear, angular)
        if self._steady and asked == self._asked:
            return self._speeds
        if not math.isfinite(linear + angular):
            raise CommandError(f"twist = ({linear}, {angular}): must be finite m/s and rad/s")
        if asked == STANDING:
            return self.halt(Reason.NONE)
        new = self._next(linear, angular)
        self._steady = self._free or new == self._last == self._before
        self._last, self._before, self._asked = new, self._last, asked
        self._speeds = self.wheels(*new)
        self._why = None
        return self._speeds

    def _next(self, linear: float, angular: float) -> Twist:
        """The twist that may follow the last ones."""
        ahead, turn = self._linear, self._angular
        if self._free:
            return (
                min(max(linear, ahead.min_velocity), ahead.max_velocity),
                min(max(angular, turn.min_velocity), turn.max_velocity),
            )
        last, before, dt = self._last, self._before, self._period
        return (
            limiter.limited(linear, last[0], before[0], dt, *ahead),
            limiter.limited(angular, last[1], before[1], dt, *turn),
        )

    def bounded(self, speeds: Sequence[float]) -> Sequence[float]:
        """Wheel speeds [rad/s], all shrunk by one factor where a wheel or the twist is too fast.

        What can't be sent at all is left for the encoder to refuse.
        """
        if len(speeds) != WHEELS or not all(map(math.isfinite, speeds)):
            return speeds
        config = self._config
        top = _share(max(map(abs, speeds)), -config.max_wheel_speed, config.max_wheel_speed)
        a, b, c, d = (top * speed for speed in speeds)
        twist = kinematics.twist(a, b, c, d, config.wheel_radius, config.effective_separation)
        share = min(
            _share(twist[0], self._linear.min_velocity, self._linear.max_velocity),
            _share(twist[1], self._angular.min_velocity, self._angular.max_velocity),
        )
        self._last = self._before = (share * twist[0], share * twist[1])
        self._speeds = (share * a, share * b, share * c, share * d)
        self._why = Reason.NONE if share * top == 1.0 else Reason.LIMITS
        self._steady = False
        return speeds if self._why is Reason.NONE else self._speeds

    def wheels(self, linear: float, angular: float) -> Speeds:
        """Wheel speeds [rad/s] for a twist, shrunk to the wheels' top speed at the same radius."""
        config = self._config
        return kinematics.inverse(
            linear,
            angular,
            config.wheel_radius,
            config.effective_separation,
            config.max_wheel_speed,
        )


def _share(value: float, low: float, high: float) -> float:
    """The factor, at most 1, that brings the value within low (at most 0) and high."""
    if value > high:
        return high / value
    return low / value if value < low else 1.0
