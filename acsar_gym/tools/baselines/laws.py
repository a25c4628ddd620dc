"""Laws without a map: turn to a goal and drive, and follow a path by pure pursuit."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.policies.policy import GOAL_NUMBERS, PATH_NUMBERS, DecodedObservation

MAX_BEARING = 0.35
"""TurnDrive turns on the spot while the goal's bearing is larger than this [rad]."""
TURN_GAIN = 2.5
"""Its yaw rate for a bearing of 1 rad [1/s]."""
LOOKAHEAD = 0.6
"""How far ahead on the path the point is that PurePursuit heads for [s at top speed], but no
farther than the path is observed."""
TURN_SHARE = 0.5
"""It drives curves so slowly that the yaw rate isn't larger [greatest yaw rate]."""


class TurnDrive(BaselinePolicy):
    """Turns on the spot until the goal lies ahead, then drives at full speed and keeps it there."""

    name = "turn_drive"
    needs = GOAL_NUMBERS

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        speed = self.units.speed if abs(seen.bearing) <= MAX_BEARING else 0.0
        return speed, TURN_GAIN * seen.bearing


class PurePursuit(BaselinePolicy):
    """Drives to a point of the path some way ahead, slower in narrow curves.

    Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992. The robot drives
    the arc that leads through that point: its curvature is 2 y / L^2 for a point L away and y to
    the left.
    """

    name = "pure_pursuit"
    needs = PATH_NUMBERS
    needs_in_words = ("a path", "path_follow")

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        x, y = find_carrot(seen, LOOKAHEAD * self.units.speed)
        config = self.setting.config
        if x <= 0.0:  # the path lies behind: turn on the spot
            return 0.0, math.copysign(config.max_angular, y)

        # Slow enough for the curve.
        curvature = 2.0 * y / max(x * x + y * y, 1e-6)
        turning_speed = TURN_SHARE * config.max_angular / max(abs(curvature), 1e-6)
        speed = min(config.max_linear, turning_speed)
        return speed, speed * curvature


def find_carrot(seen: DecodedObservation, lookahead: float) -> tuple[float, float]:
    """The first point of the path ahead that is `lookahead` away from the robot [m].

    Returns:
        The point in the base frame. The path's last observed point if all are nearer.
    """
    error = seen.heading_error
    offset = seen.cross_track
    foot = (-offset * math.sin(error), -offset * math.cos(error))  # the nearest point of the path

    # The first segment that leaves the circle of the lookahead, and where it does.
    line = np.vstack([foot, np.zeros((0, 2)) if seen.points is None else seen.points])
    for (ax, ay), (bx, by) in zip(line[:-1].tolist(), line[1:].tolist(), strict=True):
        if math.hypot(bx, by) < lookahead:
            continue

        # a + share e is on the circle: a quadratic equation, whose larger root is that ahead.
        ex = bx - ax
        ey = by - ay
        square = ex * ex + ey * ey
        along = ax * ex + ay * ey
        if square < 1e-12:
            continue

        # A path that starts outside never crosses it from within.
        root = along * along - square * (ax * ax + ay * ay - lookahead * lookahead)
        share = (-along + math.sqrt(max(root, 0.0))) / square
        share = min(max(share, 0.0), 1.0)
        return ax + share * ex, ay + share * ey
    x, y = line[-1].tolist()
    return x, y
