"""Laws that know the goal alone.

Random actions, turn and drive, and Park & Kuipers' smooth curve.
"""

from __future__ import annotations

import math

from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.policies.base import GOAL_NUMBERS, DecodedObservation


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
CURVE_WEIGHT, CURVE_EXPONENT = 0.4, 1.0
"""How much a curve slows the robot down. The paper's lambda is 2, with which the yaw rate falls to
0 in narrow curves; with 1 it tends to v_max / beta."""
MIN_DISTANCE = 0.1
"""Below this distance the curvature doesn't grow any more [m]."""


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

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        curvature = curvature_to(seen.distance, seen.bearing)
        speed = self.setting.config.max_linear / (
            1.0 + CURVE_WEIGHT * abs(curvature) ** CURVE_EXPONENT
        )
        return speed, curvature * speed


def curvature_to(distance: float, bearing: float) -> float:
    """Curvature of the smooth path to a point without a wanted heading [1/m].

    Args:
        distance: of the point [m].
        bearing: of the point, positive to the left [rad].
    """
    return (FAST_GAIN * bearing + (1.0 + SLOW_GAIN) * math.sin(bearing)) / max(
        distance, MIN_DISTANCE
    )


MAX_BEARING = 0.35
"""It turns on the spot while the goal's bearing is larger than this [rad]."""
BEARING_GAIN = 2.5
"""Yaw rate for a bearing of 1 rad [1/s]."""


class TurnDrive(BaselinePolicy):
    """Turns on the spot until the goal lies ahead, then drives at full speed and keeps it there."""

    name = "turn_drive"
    needs = GOAL_NUMBERS

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        top = 0.0 if abs(seen.bearing) > MAX_BEARING else self.setting.config.max_linear
        return top, BEARING_GAIN * seen.bearing
