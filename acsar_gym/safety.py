"""What stands between a wanted twist and the wheels: limits, geofence, stale feedback, and stop.

The same on every link, so that policies train through it. What is really sent, and why it differs
from what was asked, is told in `sent` and `reason`.
"""

from __future__ import annotations

from enum import IntEnum

from acsar_gym import kinematics, limiter
from acsar_gym.config import RobotConfig
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Pose

Twist = tuple[float, float]
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
    """One robot's safety layer. `sent` is the newest twist on the wire, `reason` a Reason."""

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._linear, self._angular = limiter.both(config)
        self._free = self._linear.free and self._angular.free
        self._fence = config.geofence
        self._stale = STALE_SHARE * config.feedback_timeout
        self.reset()

    def reset(self) -> None:
        """Arm: nothing has been sent, and every stop is forgotten."""
        self._latched = Reason.NONE
        self._asked: Twist = (0.0, 0.0)
        self._speeds: Speeds = ZERO
        self._outcome: tuple[Twist, Reason] = ((0.0, 0.0), Reason.NONE)
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
        self._last: Twist = (0.0, 0.0)
        self._before: Twist = (0.0, 0.0)
        self.sent: Twist = (0.0, 0.0)
        self.reason = reason
        return ZERO

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
        """Wheel speeds [rad/s] for a wanted twist, within the limits. Raises CommandError."""
        if self._free:
            if (linear, angular) != self._asked:
                self._asked = (linear, angular)
                self._speeds = self.wheels(linear, angular)
                self._outcome = self._told(linear, angular, self._speeds)
            self.sent, self.reason = self._outcome
            return self._speeds
        dt = self._config.period
        new = (
            limiter.limited(linear, self._last[0], self._before[0], dt, *self._linear),
            limiter.limited(angular, self._last[1], self._before[1], dt, *self._angular),
        )
        speeds = self.wheels(*new)
        self.sent, self.reason = self._told(linear, angular, speeds)
        self._last, self._before = new, self._last
        return speeds

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

    def _told(self, linear: float, angular: float, speeds: Speeds) -> tuple[Twist, Reason]:
        config = self._config
        sent = kinematics.forward(speeds, config.wheel_radius, config.effective_separation)
        same = abs(sent[0] - linear) < TELLABLE and abs(sent[1] - angular) < TELLABLE
        return sent, Reason.NONE if same else Reason.LIMITS
