"""What a ROS 2 user has: a costmap, a global plan on it, and regulated pure pursuit.

The plan is the way of the robot's map. The tracker is Macenski, Singh, Martin & Gines, "Regulated
pure pursuit for robot path tracking", Autonomous Robots 47 (2023): pure pursuit whose speed is
regulated by curvature and by the nearness of obstacles, which turns in place if the path
starts elsewhere, and stops before a predicted collision.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import Radii, Speeds, YawRates
from acsar_gym.tools.baselines.mapped import MappedPolicy, Pose, footprint_clearance
from acsar_gym.tools.policies.policy import DecodedObservation


class NavfnConstants(NamedTuple):
    """Constants of regulated pure pursuit. `constants.yaml` has those of the presets."""

    carrot_time: float = 0.9
    """The carrot is this much time ahead at the present speed [s]."""
    min_carrot: Radii = 0.83
    """Its least distance [radius]."""
    turn_share: YawRates = 0.67
    """Largest yaw rate in curves [greatest yaw rate]."""
    slow_clearance: Radii = 0.62
    """Nearer to an obstacle the robot drives slower, in proportion [radius]."""
    slow_share: float = 0.3
    """What remains of the speed without any clearance."""
    min_speed: Speeds = 0.16
    """Least regulated speed [top speed]."""
    turn_bearing: float = 0.7
    """The robot turns on the spot while the carrot's bearing is larger [rad]."""
    turn_gain: float = 2.5
    """Yaw rate of that turn for a bearing of 1 rad [1/s]."""
    arc_time: float = 1.0
    """How far ahead predicted arcs are checked for collisions [s]."""
    arc_clearance: Radii = 0.083
    """Least clearance on a predicted arc [radius]."""


SPEED_SHARES = (1.0, 0.7, 0.5, 0.35, 0.2)
"""Speeds that are tried if the regulated speed leads to a collision, as shares of it."""
CHECK_SPACING = 0.4
"""Greatest distance between two checked poses of an arc [radius]."""


class Navfn(MappedPolicy):
    """Follows the way of the map by regulated pure pursuit."""

    name = "navfn"
    constants = NavfnConstants()

    def decide(self, pose: Pose, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        # A carrot far to the side means that the path starts elsewhere: turn on the spot.
        units = self.units
        k = self.constants
        x, y = self.carrot(pose, max(k.carrot_time * seen.linear, k.min_carrot))
        bearing = math.atan2(y, x)
        turn = math.copysign(min(k.turn_gain * abs(bearing), units.turning), bearing)
        reach = units.speed * k.arc_time + 2.0 * units.radius + k.slow_clearance
        near = self.obstacles(pose, seen, reach)
        if abs(bearing) > k.turn_bearing:
            return 0.0, turn

        # The speed, regulated by clearance and curvature.
        distance = max(math.hypot(x, y), 0.2 * units.radius)
        curvature = 2.0 * y / distance**2
        free = footprint_clearance(pose, near, self.footprint, k.slow_clearance)
        speed = min(
            units.speed * (k.slow_share + (1.0 - k.slow_share) * free / k.slow_clearance),
            k.turn_share / max(abs(curvature), 1e-6),
        )
        speed = max(speed, k.min_speed)

        # The fastest speed at which the arc is free. The robot turns if there is none.
        for share in SPEED_SHARES:
            if self._is_free(pose, share * speed, share * speed * curvature, near):
                return share * speed, share * speed * curvature
        return 0.0, turn

    def _is_free(self, pose: Pose, linear: float, angular: float, near: Floats) -> bool:
        """Whether a predicted arc keeps its clearance, or comes no nearer than it is."""
        x, y, theta = pose
        time = self.constants.arc_time
        wanted = self.constants.arc_clearance
        # If the robot is too near already, it may drive away.
        enough = footprint_clearance(pose, near, self.footprint, wanted) - 2e-3
        checks = math.ceil(self.units.speed * time / (CHECK_SPACING * self.units.radius))
        for _ in range(checks):
            theta += angular * time / checks
            x += linear * math.cos(theta) * time / checks
            y += linear * math.sin(theta) * time / checks
            if footprint_clearance((x, y, theta), near, self.footprint, wanted) < enough:
                return False
        return True
