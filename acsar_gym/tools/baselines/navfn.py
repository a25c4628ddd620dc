"""What a ROS 2 user has: a costmap, a global plan on it, and regulated pure pursuit.

The plan is that of Nav2's NavFn planner, the way down a potential; the tracker is Macenski, Singh,
Martin & Gines, "Regulated pure pursuit for robot path tracking", Autonomous Robots 47 (2023): pure
pursuit whose speed is regulated by curvature and by the nearness of obstacles, which turns on the
spot where the path begins elsewhere, and stops before a predicted collision.
"""

from __future__ import annotations

import math

from acsar_gym.tasks.base import Floats
from acsar_gym.tools.baselines.mapping import MappedPolicy, Pose, points_clearance
from acsar_gym.tools.policies.base import DecodedObservation

CARROT_TIME, MIN_CARROT, MAX_CARROT = 0.9, 0.2, 0.45
"""The carrot is this much time ahead at the present speed, within these distances [s, m, m]."""
SLOW_RADIUS = 0.5
"""Curves narrower than this are driven slower, in proportion [m]."""
SLOW_CLEARANCE = 0.15
"""Nearer than this to an obstacle, the footprint is driven slower, in proportion [m]."""
MIN_SPEED = 0.08
"""Least regulated speed [m/s]."""
TURN_BEARING = 0.7
"""Turns on the spot while the carrot's bearing is larger than this [rad]."""
ARC_TIME = 1.0
"""Predicted arcs are checked for collisions so far ahead [s]."""
ARC_CLEARANCE = 0.02
"""Least clearance on a predicted arc [m]."""


class Navfn(MappedPolicy):
    """Plans on its map like NavFn, and follows the plan by regulated pure pursuit."""

    name = "navfn"

    def decide(
        self, pose: Pose, goal: tuple[float, float], seen: DecodedObservation
    ) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        config = self.setting.config
        lookahead = min(max(CARROT_TIME * seen.linear, MIN_CARROT), MAX_CARROT)
        x, y = self.carrot(pose, goal, lookahead)
        bearing, distance = math.atan2(y, x), max(math.hypot(x, y), 0.05)
        near = self.obstacles(pose, config.max_linear * ARC_TIME + self.outer + 0.3)
        turn = math.copysign(min(2.5 * abs(bearing), config.max_angular), bearing)
        if abs(bearing) > TURN_BEARING:
            return 0.0, turn
        curvature = 2.0 * y / distance**2
        free = points_clearance(*pose, near, self.sides, self.outer, SLOW_CLEARANCE)
        speed = config.max_linear * min(
            1.0, 1.0 / max(abs(curvature) * SLOW_RADIUS, 1e-6), 0.3 + 0.7 * free / SLOW_CLEARANCE
        )
        speed = max(speed, MIN_SPEED)
        for share in (1.0, 0.5, 0.2):
            if self._free(pose, share * speed, share * speed * curvature, near):
                return share * speed, share * speed * curvature
        return 0.0, turn

    def _free(self, pose: Pose, linear: float, angular: float, near: Floats) -> bool:
        """Whether a predicted arc keeps its clearance, or comes no nearer than it is."""
        x, y, theta = pose
        least = (
            min(
                points_clearance(x, y, theta, near, self.sides, self.outer, ARC_CLEARANCE),
                ARC_CLEARANCE,
            )
            - 2e-3
        )
        for _ in range(5):
            theta += angular * ARC_TIME / 5.0
            x += linear * math.cos(theta) * ARC_TIME / 5.0
            y += linear * math.sin(theta) * ARC_TIME / 5.0
            if points_clearance(x, y, theta, near, self.sides, self.outer, ARC_CLEARANCE) < least:
                return False
        return True
