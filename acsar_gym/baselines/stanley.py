"""The Stanley controller.

Hoffmann, Tomlin, Montemerlo & Thrun, "Autonomous automobile trajectory tracking for off-road
driving", ACC 2007.

A bicycle steers its front wheel by delta = psi + atan(k e / (k_soft + v)), in which psi is the
path's direction relative to the heading, and e the distance of the path from the front axle,
positive to the left. This robot drives the twist of a bicycle whose front axle lies AXLE ahead of
its base: angular = v tan(delta) / AXLE.
"""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.baselines.pure_pursuit import PathPolicy, line_ahead
from acsar_gym.policies.setting import Seen

AXLE = 0.2
"""From the robot's base to the front axle of the bicycle [m]."""
GAIN, SOFT = 1.5, 0.2
"""k [1/s] and k_soft [m/s]."""
STEERING = 1.2
"""Greatest steering angle [rad]."""


class Stanley(PathPolicy):
    """Steers by the path's direction and distance at a front axle."""

    name = "stanley"

    def act(self, seen: Seen) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        config = self.setting.config
        bearing, left = at_axle(seen)
        speed = max(seen.linear, 0.0)
        wanted = bearing + math.atan2(GAIN * left, SOFT + speed)
        if abs(wanted) > math.pi / 2.0:
            return 0.0, math.copysign(config.max_angular, wanted)
        tangent = math.tan(min(max(wanted, -STEERING), STEERING)) / AXLE
        linear = min(config.max_linear, config.max_angular / max(abs(tangent), 1e-6))
        return linear, linear * tangent


def at_axle(seen: Seen) -> tuple[float, float]:
    """Direction of the path nearest to the front axle [rad], and how far left of it it is [m]."""
    line = line_ahead(seen) - (AXLE, 0.0)
    best = (math.inf, 0.0, 0.0)
    for (ax, ay), (bx, by) in zip(line[:-1].tolist(), line[1:].tolist(), strict=True):
        ex, ey = bx - ax, by - ay
        square = ex * ex + ey * ey
        if square < 1e-9:
            continue
        share = float(np.clip(-(ax * ex + ay * ey) / square, 0.0, 1.0))
        x, y = ax + share * ex, ay + share * ey
        bearing = math.atan2(ey, ex)
        left = y * math.cos(bearing) - x * math.sin(bearing)
        best = min(best, (math.hypot(x, y), bearing, left))
    return best[1], best[2]
