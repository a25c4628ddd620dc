"""Pure pursuit: Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992.

The robot drives the arc that leads through a point of the path ahead: its curvature is
2 y / L^2 for a point L away and y to the left.
"""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.baselines.base import BaselinePolicy
from acsar_gym.policies.setting import PATH, Seen
from acsar_gym.tasks.base import Floats

LOOKAHEAD = 0.3
"""Distance of the point that it heads for [m]."""
SIDEWAYS = 0.5
"""Greatest speed times curvature, as a share of the greatest yaw rate."""


class PathPolicy(BaselinePolicy):
    """Base class of the baselines that follow a path."""

    needs = PATH
    what = ("a path", "path_follow")


class PurePursuit(PathPolicy):
    """Drives to a point of the path a fixed distance ahead, slower in narrow curves."""

    name = "pure_pursuit"

    def act(self, seen: Seen) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        x, y = carrot(seen, LOOKAHEAD)
        config, square = self.setting.config, max(x * x + y * y, 1e-6)
        if x <= 0.0:  # the path lies behind: turn on the spot
            return 0.0, math.copysign(config.max_angular, y)
        curvature = 2.0 * y / square
        most = SIDEWAYS * config.max_angular / max(abs(curvature), 1e-6)
        speed = min(config.max_linear, most)
        return speed, speed * curvature


def line_ahead(seen: Seen) -> Floats:
    """(5, 2): the nearest point of the path and those that are observed, in the base frame [m]."""
    error, left = seen.heading_error, seen.cross_track
    foot = (-left * math.sin(error), -left * math.cos(error))
    points = np.zeros((0, 2)) if seen.points is None else seen.points
    return np.vstack([foot, points])


def carrot(seen: Seen, lookahead: float) -> tuple[float, float]:
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
