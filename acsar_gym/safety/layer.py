"""The safety layer between a wanted twist and the wheels: limits, geofence, stale feedback, stop.

It is the same on every link, so that policies are trained with it. `sent` is the twist that was
really sent, and `reason` says why it differs from what was asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from acsar_gym import kinematics
from acsar_gym.config import Geofence, RobotConfig
from acsar_gym.errors import CommandError, LinkError
from acsar_gym.jit import record_of
from acsar_gym.protocol import ZERO, Speeds, check_speeds
from acsar_gym.safety import rules
from acsar_gym.safety.rules import Reason, SafetyMemory
from acsar_gym.worlds import Pose

Twist = tuple[float, float]


class Safety:
    """The safety layer of one robot. Every tick calls either `allowed` or `bounded` once."""

    def __init__(self, config: RobotConfig) -> None:
        self._rules = rules.make_rules(config)
        self._numbers = record_of(self._rules)
        self._memory = record_of(SafetyMemory())
        self._speeds: Speeds = ZERO
        self.reset()

    def reset(self) -> None:
        """Begin an episode: nothing has been sent, and all stops are cleared."""
        self._memory["latched"] = 0.0
        self.halt(Reason.NONE)
        self.allowed(0.0, 0.0, (0.0, 0.0, 0.0), 0.0)  # loads compiled code before driving
        rules.update_holds(0.0, 0.0, 0.0, self._memory, self._numbers)  # and that of `bounded`

    def fence(self, area: Geofence | None) -> None:
        """Replace the geofence, before an episode; None for no limit."""
        at = area or Geofence()
        self._rules = self._rules._replace(
            min_x=at.min_x, max_x=at.max_x, min_y=at.min_y, max_y=at.max_y
        )
        self._numbers = record_of(self._rules)

    def estop(self) -> None:
        """Hold the wheels at zero from now until the reset."""
        self._memory["latched"] = float(Reason.EMERGENCY_STOP)

    @property
    def stopped(self) -> bool:
        """Whether the robot is held until the reset."""
        return bool(self._memory["latched"][0] > 0.0)

    def check(self, elapsed: float) -> None:
        """Check that the robot isn't held until the reset; `elapsed` [s] since the start is told.

        Raises:
            LinkError: it is; the message says why.
        """
        if self.stopped:
            why, fix = rules.HELD_REASONS[Reason(int(self._memory["latched"][0]))]
            raise LinkError(f"ended by {why} after {elapsed:.1f} s", fix)

    @property
    def sent(self) -> Twist:
        """The twist sent last: linear [m/s], angular [rad/s]."""
        return float(self._memory["sent_linear"][0]), float(self._memory["sent_angular"][0])

    @property
    def reason(self) -> Reason:
        """Why `sent` differs from the twist that was asked for."""
        return Reason(int(self._memory["reason"][0]))

    def halt(self, reason: Reason) -> Speeds:
        """Set the wheels to zero at once; acceleration limits don't apply to stops.

        Returns:
            Four wheel speeds of zero.
        """
        self._remember(SafetyMemory(reason=reason))
        self._speeds = ZERO
        return ZERO

    def _remember(self, memory: SafetyMemory) -> None:
        """Set all but `latched`, which an emergency stop may set at any time."""
        for name, value in zip(SafetyMemory._fields[1:], memory[1:], strict=True):
            self._memory[name] = value

    def allowed(self, linear: float, angular: float, pose: Pose, feedback_age: float) -> Speeds:
        """Compute the wheel speeds that may be sent in this tick for a wanted twist.

        Returns:
            Four wheel speeds [rad/s]; the same tuple object for as long as they don't change.

        Raises:
            CommandError: for a twist that isn't finite.
        """
        linear, angular = float(linear), float(angular)
        if not (math.isfinite(linear) and math.isfinite(angular)):
            raise CommandError(f"twist = ({linear}, {angular}): must be finite m/s and rad/s")
        right, left = rules.update_twist(
            linear, angular, pose[0], pose[1], feedback_age, self._memory, self._numbers
        )
        speeds = self._speeds
        if right != speeds[0] or left != speeds[1]:
            self._speeds = speeds = (right, left, left, right)
        return speeds

    def bounded(self, speeds: Sequence[float], pose: Pose, feedback_age: float) -> Speeds:
        """Compute the wheel speeds that may be sent in this tick for wanted ones.

        All are scaled by one factor where a wheel, or their twist, is too fast.

        Raises:
            CommandError: unless `speeds` are four finite numbers.
        """
        a, b, c, d = check_speeds(speeds)
        reason = rules.update_holds(pose[0], pose[1], feedback_age, self._memory, self._numbers)
        if reason:
            return self.halt(Reason(int(reason)))
        numbers = self._rules
        top = _scale_into(max(map(abs, (a, b, c, d))), -numbers.top, numbers.top)
        a, b, c, d = top * a, top * b, top * c, top * d
        radii = numbers.left_radius, numbers.right_radius
        linear, angular = kinematics.compute_twist(a, b, c, d, *radii, numbers.separation)
        share = min(
            _scale_into(linear, numbers.linear.min_velocity, numbers.linear.max_velocity),
            _scale_into(angular, numbers.angular.min_velocity, numbers.angular.max_velocity),
        )
        a, b, c, d = share * a, share * b, share * c, share * d
        limited = 0.0 if share * top == 1.0 else float(Reason.LIMITS)
        twist = share * linear, share * angular
        sent = kinematics.compute_twist(a, b, c, d, *radii, numbers.separation)
        self._remember(SafetyMemory(0.0, limited, *twist, *twist, *sent))
        self._speeds = ZERO
        return a, b, c, d

    def wheels(self, linear: float, angular: float) -> Speeds:
        """Wheel speeds [rad/s] for a twist, at most the top speed, at the same turn radius."""
        numbers = self._rules
        return kinematics.compute_speeds(
            linear,
            angular,
            left_radius=numbers.left_radius,
            right_radius=numbers.right_radius,
            wheel_separation=numbers.separation,
            max_speed=numbers.top,
        )


def _scale_into(value: float, low: float, high: float) -> float:
    """The factor, at most 1, that scales a value into the range low (at most 0) to high."""
    if value > high:
        return high / value
    return low / value if value < low else 1.0
