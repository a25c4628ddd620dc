"""What a ROS 2 user has: a costmap, a global plan on it, and regulated pure pursuit.

The plan is that of Nav2's NavFn planner, the way down a potential; the tracker is Macenski, Singh,
Martin & Gines, "Regulated pure pursuit for robot path tracking", Autonomous Robots 47 (2023): pure
pursuit whose speed is regulated by curvature and by the nearness of obstacles, which turns on the
spot where the path begins elsewhere, and stops before a predicted collision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.mapping import (
    MapConstants,
    MappedPolicy,
    Pose,
    points_clearance,
)
from acsar_gym.tools.baselines.tuning import constant
from acsar_gym.tools.policies.policy import DecodedObservation


@dataclass(frozen=True)
class NavfnConstants(MapConstants):
    """Constants of regulated pure pursuit."""

    carrot_time: float = constant(0.9, 0.2, 1.5)
    """The carrot is this much time ahead at the present speed [s]."""
    min_carrot: float = constant(0.83, 0.4, 3.0)
    """Least distance of the carrot [radius]."""
    turn_share: float = constant(0.67, 0.2, 1.0)
    """Curves are driven so slowly that the yaw rate isn't larger [greatest yaw rate]."""
    slow_clearance: float = constant(0.62, 0.1, 2.0)
    """Nearer than this to an obstacle, the footprint is driven slower, in proportion [radius]."""
    slow_share: float = constant(0.3, 0.1, 0.9)
    """What is left of the speed without any clearance."""
    min_speed: float = constant(0.16, 0.05, 0.4)
    """Least regulated speed [top speed]."""
    turn_bearing: float = constant(0.7, 0.4, 1.5)
    """Turns on the spot while the carrot's bearing is larger than this [rad]."""
    turn_gain: float = constant(2.5, 1.0, 6.0)
    """Yaw rate of that turn for a bearing of 1 rad [1/s]."""
    arc_time: float = constant(1.0, 0.3, 1.5)
    """Predicted arcs are checked for collisions so far ahead [s]."""
    arc_clearance: float = constant(0.083, 0.02, 0.3)
    """Least clearance on a predicted arc [radius]."""


SPEED_SHARES = (1.0, 0.7, 0.5, 0.35, 0.2)
"""Speeds that are tried where the regulated one leads to a collision, as shares of it."""
CHECK_SPACING = 0.4
"""Greatest distance between two checked poses of an arc [radius]."""


class Navfn(MappedPolicy):
    """Plans on its map like NavFn, and follows the plan by regulated pure pursuit."""

    name = "navfn"
    constants_type = NavfnConstants
    constants: NavfnConstants

    def decide(
        self, pose: Pose, goal: tuple[float, float], seen: DecodedObservation
    ) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        units, k = self.units, self.constants
        lookahead = max(k.carrot_time * seen.linear, k.min_carrot * units.radius)
        x, y = self.carrot(pose, goal, lookahead)
        bearing, distance = math.atan2(y, x), max(math.hypot(x, y), 0.2 * units.radius)
        slow = k.slow_clearance * units.radius
        near = self.obstacles(pose, units.speed * k.arc_time + 2.0 * units.radius + slow)
        turn = math.copysign(min(k.turn_gain * abs(bearing), units.turning), bearing)
        if abs(bearing) > k.turn_bearing:
            return 0.0, turn
        curvature = 2.0 * y / distance**2
        free = points_clearance(*pose, near, self.sides, self.outer, slow)
        speed = min(
            units.speed * (k.slow_share + (1.0 - k.slow_share) * free / slow),
            k.turn_share * units.turning / max(abs(curvature), 1e-6),
        )
        speed = max(speed, k.min_speed * units.speed)
        for share in SPEED_SHARES:
            if self._is_free(pose, share * speed, share * speed * curvature, near):
                return share * speed, share * speed * curvature
        return 0.0, turn

    def _is_free(self, pose: Pose, linear: float, angular: float, near: Floats) -> bool:
        """Whether a predicted arc keeps its clearance, or comes no nearer than it is."""
        (x, y, theta), time = pose, self.constants.arc_time
        wanted = self.constants.arc_clearance * self.outer
        least = points_clearance(x, y, theta, near, self.sides, self.outer, wanted) - 2e-3
        checks = math.ceil(self.units.speed * time / (CHECK_SPACING * self.outer))
        for _ in range(checks):
            theta += angular * time / checks
            x += linear * math.cos(theta) * time / checks
            y += linear * math.sin(theta) * time / checks
            if points_clearance(x, y, theta, near, self.sides, self.outer, wanted) < least:
                return False
        return True
