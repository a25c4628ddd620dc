"""The safety layer between commands and wheels: limits, geofence, stale feedback, stop.

It is the same for every link, so that policies are trained with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

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
    """The safety layer of one robot. Every tick calls either `allowed` or `bounded` once.

    Args:
        config: Robot configuration.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._rules = rules.make_rules(config)
        self._geometry = (*config.wheel_radii, config.effective_separation)
        self._numbers = record_of(self._rules)
        self._memory = record_of(SafetyMemory())
        self._speeds: Speeds = ZERO
        self.reset()

    def reset(self) -> None:
        """Start an episode: nothing has been sent, and all stops are cleared."""
        self._memory["latched"] = 0.0
        self.halt(Reason.NONE)
        # Load the compiled code before the robot drives.
        self.allowed(0.0, 0.0, pose=(0.0, 0.0, 0.0), feedback_age=0.0)

    def fence(self, area: Geofence | None) -> None:
        """Replace the geofence, before an episode. None for no limit."""
        fence = area or Geofence()
        self._rules = self._rules._replace(**fence.model_dump())
        self._numbers = record_of(self._rules)

    def estop(self) -> None:
        """Hold the wheels at zero until the reset."""
        self._memory["latched"] = float(Reason.EMERGENCY_STOP)

    @property
    def stopped(self) -> bool:
        """Whether the robot is held until the reset."""
        return bool(self._memory["latched"][0] > 0.0)

    def check(self, elapsed: float) -> None:
        """Check that the robot isn't held until the reset.

        Args:
            elapsed: Time since the start [s], for the message.

        Raises:
            LinkError: The robot is held. The message contains the reason.
        """
        if self.stopped:
            cause, fix = rules.HELD_REASONS[Reason(int(self._memory["latched"][0]))]
            raise LinkError(f"ended by {cause} after {elapsed:.1f} s", fix)

    @property
    def sent(self) -> Twist:
        """The twist that was sent last: linear [m/s], angular [rad/s]."""
        return float(self._memory["sent_linear"][0]), float(self._memory["sent_angular"][0])

    @property
    def reason(self) -> Reason:
        """Why `sent` differs from the commanded twist."""
        return Reason(int(self._memory["reason"][0]))

    def halt(self, reason: Reason) -> Speeds:
        """Set the wheels to zero at once. Acceleration limits don't apply to stops.

        Returns:
            Four wheel speeds of zero.
        """
        self._remember(SafetyMemory(reason=reason))
        self._speeds = ZERO
        return ZERO

    def _remember(self, memory: SafetyMemory) -> None:
        """Set everything but `latched`, which an emergency stop may set at any time."""
        for name, value in zip(memory._fields[1:], memory[1:], strict=True):
            self._memory[name] = value

    def allowed(self, linear: float, angular: float, pose: Pose, feedback_age: float) -> Speeds:
        """Compute the wheel speeds that may be sent in this tick for a commanded twist.

        Args:
            linear: Velocity [m/s].
            angular: Turn rate [rad/s].
            pose: Pose by odometry [m, m, rad].
            feedback_age: Age of the feedback [s].

        Returns:
            Four wheel speeds [rad/s]. The same tuple object while they don't change.

        Raises:
            CommandError: The twist isn't finite.
        """
        linear = float(linear)
        angular = float(angular)
        if not (math.isfinite(linear) and math.isfinite(angular)):
            raise CommandError(f"twist = ({linear}, {angular}): must be finite m/s and rad/s")
        x, y, _ = pose
        # By position, which saves a third of the call's time in every tick.
        inputs = (linear, angular, x, y, feedback_age)
        a, b = rules.update_twist(*inputs, self._memory, self._numbers)
        if a != self._speeds[0] or b != self._speeds[1]:
            self._speeds = (a, b, b, a)
        return self._speeds

    def bounded(self, speeds: Sequence[float], pose: Pose, feedback_age: float) -> Speeds:
        """Compute the wheel speeds that may be sent in this tick for commanded speeds.

        All are scaled by one factor if a wheel, or their twist, is too fast.

        Args:
            speeds: Four wheel speeds [rad/s].
            pose: Pose by odometry [m, m, rad].
            feedback_age: Age of the feedback [s].

        Raises:
            CommandError: `speeds` aren't four finite numbers.
        """
        wheels = np.array(check_speeds(speeds))
        x, y, _ = pose
        # Raw wheel speeds have no ramp, but the same holds.
        memory = SafetyMemory(latched=self._memory["latched"][0])
        latched, reason = rules.find_holds(memory, x, y, age=feedback_age, rules=self._rules)
        if latched:
            self._memory["latched"] = latched
        if reason:
            return self.halt(Reason(int(reason)))

        # One factor for the wheels' top speed, and one for the limits of the twist.
        top = self._rules.top
        wheel_factor = _find_factor(np.abs(wheels).max(), -top, top)
        wheels *= wheel_factor
        linear, angular = self.twist(wheels)
        linear_axis = self._rules.linear
        angular_axis = self._rules.angular
        factor = min(
            _find_factor(linear, linear_axis.min_velocity, linear_axis.max_velocity),
            _find_factor(angular, angular_axis.min_velocity, angular_axis.max_velocity),
        )
        wheels *= factor

        sent_linear, sent_angular = self.twist(wheels)
        self._remember(
            SafetyMemory(
                reason=Reason.NONE if factor * wheel_factor == 1.0 else Reason.LIMITS,
                linear=factor * linear,
                angular=factor * angular,
                past_linear=factor * linear,
                past_angular=factor * angular,
                sent_linear=sent_linear,
                sent_angular=sent_angular,
            )
        )
        self._speeds = ZERO
        a, b, c, d = wheels.tolist()
        return a, b, c, d

    def twist(self, speeds: Iterable[float]) -> Twist:
        """Return the twist of four wheel speeds [rad/s]: linear [m/s], angular [rad/s]."""
        a, b, c, d = speeds
        return kinematics.compute_twist(a, b, c, d, *self._geometry)

    def wheels(self, linear: float, angular: float) -> Speeds:
        """Return the wheel speeds [rad/s] of a twist, at most the top speed, at its turn radius."""
        return kinematics.compute_speeds(
            linear, angular, *self._geometry, max_speed=self._rules.top
        )


def _find_factor(value: float, low: float, high: float) -> float:
    """Return the factor, at most 1, that scales a value into the range low (at most 0) to high."""
    return min(max(value, low), high) / value if value else 1.0
