"""A smooth law to a point.

Park & Kuipers, "A smooth control law for graceful motion of differential wheeled mobile robots in
2D environment", ICRA 2011.

In polar coordinates around the goal, with the distance r, the line of sight's direction theta
relative to the wanted heading at the goal, and the robot's heading delta relative to the line of
sight, the path's curvature is (their equation 15)

    kappa = -(k2 (delta - atan(-k1 theta)) + (1 + k1 / (1 + (k1 theta)^2)) sin delta) / r

and the speed v = v_max / (1 + beta |kappa|^lambda) (equation 16). These goals have no wanted
heading, so theta = 0; delta is minus the goal's bearing.
"""

from __future__ import annotations

import math

from acsar_gym.baselines.base import BaselinePolicy
from acsar_gym.policies.setting import GOAL, Seen

K1, K2 = 1.0, 3.0
"""Gains of the slow and of the fast subsystem, as in the paper."""
BETA, LAMBDA = 0.4, 1.0
"""How much a curve slows the robot down. The paper's lambda is 2, with which the yaw rate falls to
0 in narrow curves; with 1 it tends to v_max / beta."""
NEAREST = 0.1
"""Below this distance the curvature doesn't grow any more [m]."""


class Smooth(BaselinePolicy):
    """Drives a smooth curve to the goal, slower where it is narrow."""

    name = "smooth"
    needs = GOAL

    def act(self, seen: Seen) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        curvature = curvature_to(seen.distance, seen.bearing)
        speed = self.setting.config.max_linear / (1.0 + BETA * abs(curvature) ** LAMBDA)
        return speed, curvature * speed


def curvature_to(distance: float, bearing: float) -> float:
    """Curvature of the smooth path to a point without a wanted heading [1/m].

    Args:
        distance: of the point [m].
        bearing: of the point, positive to the left [rad].
    """
    return (K2 * bearing + (1.0 + K1) * math.sin(bearing)) / max(distance, NEAREST)
