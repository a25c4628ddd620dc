"""Laws that follow a path: pure pursuit and the Stanley controller."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.baselines.tuning import Constants, constant
from acsar_gym.tools.policies.policy import PATH_NUMBERS, DecodedObservation


@dataclass(frozen=True)
class PursuitConstants(Constants):
    """Constants of pure pursuit."""

    lookahead: float = constant(0.6, 0.2, 1.5)
    """How far ahead on the path the point is that it heads for [s at top speed], but no farther
    than the path is observed."""
    turn_share: float = constant(0.5, 0.2, 1.0)
    """Curves are driven so slowly that the yaw rate isn't larger [greatest yaw rate]."""


class PathPolicy(BaselinePolicy):
    """Base class of the baselines that follow a path."""

    needs = PATH_NUMBERS
    what = ("a path", "path_follow")


class PurePursuit(PathPolicy):
    """Drives to a point of the path some way ahead, slower in narrow curves.

    Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992. The robot drives
    the arc that leads through that point: its curvature is 2 y / L^2 for a point L away and y to
    the left.
    """

    name = "pure_pursuit"
    constants_type = PursuitConstants
    constants: PursuitConstants

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        x, y = find_carrot(seen, self.constants.lookahead * self.units.speed)
        config, square = self.setting.config, max(x * x + y * y, 1e-6)
        if x <= 0.0:  # the path lies behind: turn on the spot
            return 0.0, math.copysign(config.max_angular, y)
        curvature = 2.0 * y / square
        most = self.constants.turn_share * config.max_angular / max(abs(curvature), 1e-6)
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


@dataclass(frozen=True)
class StanleyConstants(Constants):
    """Constants of the Stanley controller."""

    axle: float = constant(0.83, 0.3, 3.0)
    """From the robot's base to the front axle of the bicycle [radius]."""
    gain: float = constant(1.5, 0.5, 6.0)
    """k [1/s]."""
    soft_speed: float = constant(0.4, 0.1, 1.0)
    """k_soft [top speed]."""
    max_steering: float = constant(1.2, 0.5, 1.5)
    """Greatest steering angle [rad]."""


class Stanley(PathPolicy):
    """Steers by the path's direction and distance at a front axle.

    Hoffmann, Tomlin, Montemerlo & Thrun, "Autonomous automobile trajectory tracking for off-road
    driving", ACC 2007.

    A bicycle steers its front wheel by delta = psi + atan(k e / (k_soft + v)), in which psi is the
    path's direction relative to the heading, and e the distance of the path from the front axle,
    positive to the left. This robot drives the twist of a bicycle whose front axle lies
    `axle` ahead of its base: angular = v tan(delta) / axle.
    """

    name = "stanley"
    constants_type = StanleyConstants
    constants: StanleyConstants

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        config, k = self.setting.config, self.constants
        axle = k.axle * self.units.radius
        bearing, left = path_at_axle(seen, axle)
        speed = max(seen.linear, 0.0)
        wanted = bearing + math.atan2(k.gain * left, k.soft_speed * self.units.speed + speed)
        if abs(wanted) > math.pi / 2.0:
            return 0.0, math.copysign(config.max_angular, wanted)
        tangent = math.tan(min(max(wanted, -k.max_steering), k.max_steering)) / axle
        linear = min(config.max_linear, config.max_angular / max(abs(tangent), 1e-6))
        return linear, linear * tangent


def path_at_axle(seen: DecodedObservation, axle: float) -> tuple[float, float]:
    """Direction of the path nearest to the front axle [rad], and how far left of it it is [m]."""
    line = line_ahead(seen) - (axle, 0.0)
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
