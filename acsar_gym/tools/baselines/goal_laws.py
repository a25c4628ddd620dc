"""Laws that know the goal alone.

Random actions, turn and drive, and Park & Kuipers' smooth curve.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.baselines.tuning import Constants, constant
from acsar_gym.tools.policies.policy import GOAL_NUMBERS, DecodedObservation


class RandomActions(BaselinePolicy):
    """Draws every action anew, uniformly from the whole action space."""

    name = "random"

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Draw a velocity command [m/s, rad/s]."""
        linear, angular = self.rng.uniform(-1.0, 1.0, 2).tolist()
        config = self.setting.config
        return linear * config.max_linear, angular * config.max_angular


SLOW_GAIN, FAST_GAIN = 1.0, 3.0
"""Gains of the slow and of the fast subsystem, as in the paper."""


@dataclass(frozen=True)
class SmoothConstants(Constants):
    """Constants of the smooth curve."""

    curve_weight: float = constant(1.66, 0.3, 6.0)
    """How much a curve slows the robot down, beta [radius]. The paper's lambda is 2, with which the
    yaw rate falls to 0 in narrow curves; with 1, as here, it tends to v_max / beta."""
    min_distance: float = constant(0.42, 0.1, 2.0)
    """Below this distance the curvature doesn't grow any more [radius]."""


class Smooth(BaselinePolicy):
    """Drives a smooth curve to the goal, slower where it is narrow.

    Park & Kuipers, "A smooth control law for graceful motion of differential wheeled mobile robots
    in 2D environment", ICRA 2011.

    In polar coordinates around the goal, with the distance r, the line of sight's direction theta
    relative to the wanted heading at the goal, and the robot's heading delta relative to the line
    of sight, the path's curvature is (their equation 15)

        kappa = -(k2 (delta - atan(-k1 theta)) + (1 + k1 / (1 + (k1 theta)^2)) sin delta) / r

    and the speed v = v_max / (1 + beta |kappa|^lambda) (equation 16). These goals have no wanted
    heading, so theta = 0; delta is minus the goal's bearing.
    """

    name = "smooth"
    needs = GOAL_NUMBERS
    constants_type = SmoothConstants
    constants: SmoothConstants

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        k, radius = self.constants, self.units.radius
        curvature = curvature_to(max(seen.distance, k.min_distance * radius), seen.bearing)
        speed = self.units.speed / (1.0 + k.curve_weight * radius * abs(curvature))
        return speed, curvature * speed


def curvature_to(distance: float, bearing: float) -> float:
    """Curvature of the smooth path to a point without a wanted heading [1/m].

    Args:
        distance: of the point [m].
        bearing: of the point, positive to the left [rad].
    """
    return (FAST_GAIN * bearing + (1.0 + SLOW_GAIN) * math.sin(bearing)) / distance


@dataclass(frozen=True)
class TurnDriveConstants(Constants):
    """Constants of turn and drive."""

    max_bearing: float = constant(0.35, 0.1, 1.2)
    """It turns on the spot while the goal's bearing is larger than this [rad]."""
    turn_gain: float = constant(2.5, 1.0, 8.0)
    """Yaw rate for a bearing of 1 rad [1/s]."""


class TurnDrive(BaselinePolicy):
    """Turns on the spot until the goal lies ahead, then drives at full speed and keeps it there."""

    name = "turn_drive"
    needs = GOAL_NUMBERS
    constants_type = TurnDriveConstants
    constants: TurnDriveConstants

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        ahead = abs(seen.bearing) <= self.constants.max_bearing
        speed = self.units.speed if ahead else 0.0
        return speed, self.constants.turn_gain * seen.bearing
