"""Laws that follow a path: pure pursuit and the Stanley controller."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.tasks.base import Floats
from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.policies.base import PATH_NUMBERS, DecodedObservation

LOOKAHEAD_DISTANCE = 0.3
"""Distance of the point that it heads for [m]."""
SIDEWAYS_SHARE = 0.5
"""Greatest speed times curvature, as a share of the greatest yaw rate."""


class PathPolicy(BaselinePolicy):
    """Base class of the baselines that follow a path."""

    needs = PATH_NUMBERS
    what = ("a path", "path_follow")


class PurePursuit(PathPolicy):
    """Drives to a point of the path a fixed distance ahead, slower in narrow curves.

    Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992. The robot drives
    the arc that leads through that point: its curvature is 2 y / L^2 for a point L away and y to
    the left.
    """

    name = "pure_pursuit"

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        x, y = find_carrot(seen, LOOKAHEAD_DISTANCE)
        config, square = self.setting.config, max(x * x + y * y, 1e-6)
        if x <= 0.0:  # the path lies behind: turn on the spot
            return 0.0, math.copysign(config.max_angular, y)
        curvature = 2.0 * y / square
        most = SIDEWAYS_SHARE * config.max_angular / max(abs(curvature), 1e-6)
        speed = min(config.max_linear, most)
        return speed, speed * curvature


def line_ahead(seen: DecodedObservation) -> Floats:
    """(5, 2): the nearest point of the path and those that are observed, in the base frame [m]."""
    error, left = seen.heading_error, seen.cross_track
    foot = (-left * math.sin(error), -left * math.cos(error))
    points = np.zeros((0, 2)) if seen.points is None else seen.points
    return np.vstack([foot, points])


def find_carrot(seen: DecodedObservation, lookahead: float) -> tuple[float, float]:
    """The first point of the path ahead that is `lookahead` away from the robot [m].

    Args:
        seen: with the path.
        lookahead: [m].

    Returns:
        The point in the base frame; the path's last observed one where all are nearer.
    """
    line = line_ahead(seen)
    for (ax, ay), (bx, by) in zip(line[:-1].tolist(), line[1:].tolist(), strict=True):
        if math.hypot(bx, by) < lookahead:
            continue
        ex, ey = bx - ax, by - ay
        square, along = ex * ex + ey * ey, ax * ex + ay * ey
        if square < 1e-12:
            continue
        root = along * along - square * (ax * ax + ay * ay - lookahead * lookahead)
        share = (-along + math.sqrt(max(root, 0.0))) / square
        share = min(max(share, 0.0), 1.0)
        return ax + share * ex, ay + share * ey
    x, y = line[-1].tolist()
    return x, y


AXLE_DISTANCE = 0.2
"""From the robot's base to the front axle of the bicycle [m]."""
STEERING_GAIN, SOFT_SPEED = 1.5, 0.2
"""k [1/s] and k_soft [m/s]."""
MAX_STEERING = 1.2
"""Greatest steering angle [rad]."""


class Stanley(PathPolicy):
    """Steers by the path's direction and distance at a front axle.

    Hoffmann, Tomlin, Montemerlo & Thrun, "Autonomous automobile trajectory tracking for off-road
    driving", ACC 2007.

    A bicycle steers its front wheel by delta = psi + atan(k e / (k_soft + v)), in which psi is the
    path's direction relative to the heading, and e the distance of the path from the front axle,
    positive to the left. This robot drives the twist of a bicycle whose front axle lies
    AXLE_DISTANCE ahead of its base: angular = v tan(delta) / AXLE_DISTANCE.
    """

    name = "stanley"

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        config = self.setting.config
        bearing, left = path_at_axle(seen)
        speed = max(seen.linear, 0.0)
        wanted = bearing + math.atan2(STEERING_GAIN * left, SOFT_SPEED + speed)
        if abs(wanted) > math.pi / 2.0:
            return 0.0, math.copysign(config.max_angular, wanted)
        tangent = math.tan(min(max(wanted, -MAX_STEERING), MAX_STEERING)) / AXLE_DISTANCE
        linear = min(config.max_linear, config.max_angular / max(abs(tangent), 1e-6))
        return linear, linear * tangent


def path_at_axle(seen: DecodedObservation) -> tuple[float, float]:
    """Direction of the path nearest to the front axle [rad], and how far left of it it is [m]."""
    line = line_ahead(seen) - (AXLE_DISTANCE, 0.0)
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
