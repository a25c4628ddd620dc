"""Follow the gap.

Sezer & Gokasan, "A novel obstacle avoidance algorithm: follow the gap method", Robotics and
Autonomous Systems 60 (2012).

Obstacles are circles, enlarged by the robot's radius. Of the gaps between them the robot takes one,
and heads for

    phi = (alpha / d_min phi_gap + phi_goal) / (alpha / d_min + 1)

(their equation 10), between the gap's centre and the goal, nearer to the centre where the nearest
obstacle is near. The paper takes the widest gap; this takes the one whose edge turns least from
the goal, among those that the robot fits through.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.lidar.scan import ray_spec
from acsar_gym.tasks.state import Floats
from acsar_gym.tools.baselines.base import BaselinePolicy
from acsar_gym.tools.baselines.tuning import Constants, constant
from acsar_gym.tools.policies.policy import GOAL_NUMBERS, DecodedObservation, PolicyContext

DIRECTION_BINS = 360
"""Directions that are distinguished."""


@dataclass(frozen=True)
class GapConstants(Constants):
    """Constants of follow the gap."""

    centre_weight: float = constant(1.46, 0.3, 6.0)
    """Weight of the gap's centre [radius]."""
    margin: float = constant(0.166, 0.03, 0.5)
    """How much the robot's radius is enlarged [radius]."""
    reach: float = constant(6.2, 2.0, 20.0)
    """Obstacles farther away than this are no obstacles yet [radius]."""
    max_course: float = constant(0.6, 0.3, 1.5)
    """It turns on the spot while its course is farther off than this [rad]."""
    turn_gain: float = constant(2.5, 1.0, 6.0)
    """Yaw rate for a course of 1 rad [1/s]."""
    slow_share: float = constant(0.3, 0.05, 0.6)
    """Share of the top speed beside an obstacle."""
    slow_distance: float = constant(2.3, 0.5, 6.0)
    """Clearance by which that share grows by 1 [stopping distance]."""


class FollowGap(BaselinePolicy):
    """Heads between the centre of a gap and the goal; knows only the newest scan."""

    name = "follow_gap"
    needs = GOAL_NUMBERS
    lidar = True
    constants_type = GapConstants
    constants: GapConstants

    def equip(self, setting: PolicyContext) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        self._angles = ray_spec(setting.config).angles()
        self._radius = self.units.radius * (1.0 + self.constants.margin)

    def act(self, seen: DecodedObservation) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        config, points = self.setting.config, np.zeros((0, 2))
        units, k = self.units, self.constants
        if seen.ranges is not None:
            met = seen.ranges < config.lidar.max_range - 1e-3
            far, angles = seen.ranges[met], self._angles[met]
            x = config.lidar_x_offset + far * np.cos(angles)
            points = np.column_stack([x, config.lidar_y_offset + far * np.sin(angles)])
        course, nearest = choose_course(
            points,
            self._radius,
            seen.bearing,
            min(k.reach * units.radius, seen.distance),
            k.centre_weight * units.radius,
        )
        free = max(nearest - self._radius, 0.0)
        share = min(1.0, k.slow_share + free / (k.slow_distance * units.stopping))
        speed = units.speed * share * max(math.cos(course), 0.0)
        return (0.0 if abs(course) > k.max_course else speed), k.turn_gain * course


def choose_course(
    points: Floats, radius: float, bearing: float, reach: float, centre_weight: float
) -> tuple[float, float]:
    """Choose a gap and a course.

    Args:
        points: (n, 2), obstacles in the base frame [m].
        radius: of the robot, with a margin [m].
        bearing: of the goal [rad].
        reach: obstacles farther away are no obstacles yet [m].
        centre_weight: of the gap's centre [m].

    Returns:
        The course [rad], and the distance of the nearest obstacle [m].
    """
    far = np.hypot(points[:, 0], points[:, 1])
    near, to = far[far < reach], np.arctan2(points[:, 1], points[:, 0])[far < reach]
    if len(near) == 0:
        return bearing, math.inf
    wide = np.arcsin(np.clip(radius / np.maximum(near, 1e-6), 0.0, 1.0))
    middles: Floats = np.linspace(-math.pi, math.pi, DIRECTION_BINS, endpoint=False)
    apart = np.abs((middles[:, None] - to + math.pi) % (2.0 * math.pi) - math.pi)
    free: NDArray[np.bool_] = np.all(apart > wide, axis=1)
    if not free.any():
        return float(to[near.argmax()]), float(near.min())
    centre, _ = min(  # the gap that the bearing lies least outside of
        find_gaps(free, middles), key=lambda gap: abs(wrap_angle(bearing - gap[0])) - gap[1]
    )
    weight = centre_weight / float(near.min())
    course = centre + wrap_angle(bearing - centre) / (weight + 1.0)
    return wrap_angle(course), float(near.min())


def find_gaps(free: NDArray[np.bool_], middles: Floats) -> list[tuple[float, float]]:
    """Find the runs of free directions around the robot.

    Args:
        free: (n,), whether each direction is free.
        middles: (n,), the directions, evenly around [rad].

    Returns:
        Centre and half the width of each gap [rad].
    """
    if free.all():
        return [(0.0, math.pi)]
    first = int(np.flatnonzero(~free)[0])
    turned = np.roll(free, -first).astype(np.int8)
    edges = np.diff(np.concatenate([turned, [0]]))
    starts, ends = np.flatnonzero(edges > 0) + 1, np.flatnonzero(edges < 0)
    step = float(middles[1] - middles[0])
    begin = float(middles[first])
    return [
        (wrap_angle(begin + step * (start + end) / 2.0), step * (end - start) / 2.0)
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True)
    ]


def wrap_angle(angle: float) -> float:
    """The same angle within [-pi, pi) [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
