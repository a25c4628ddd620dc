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

import numpy as np
from numpy.typing import NDArray

from acsar_gym.baselines.base import BaselinePolicy
from acsar_gym.baselines.geometry import scan_points
from acsar_gym.config import footprint
from acsar_gym.lidars.base import ray_spec
from acsar_gym.policies.setting import GOAL, Seen, Setting
from acsar_gym.tasks.base import Floats

ALPHA = 0.35
"""Weight of the gap's centre [m]."""
MARGIN = 0.04
"""How much the robot's radius is enlarged [m]."""
REACH = 1.5
"""Obstacles farther away than this are no obstacles yet [m]."""
BINS = 360
"""Directions that are distinguished."""
AIMED = 0.6
"""It turns on the spot while its course is farther off than this [rad]."""


class FollowGap(BaselinePolicy):
    """Heads between the centre of a gap and the goal; knows only the newest scan."""

    name = "follow_gap"
    needs = GOAL
    lidar = True

    def equip(self, setting: Setting) -> None:
        """Prepare for a robot and a task."""
        super().equip(setting)
        self._angles = ray_spec(setting.config).angles()
        self._radius = footprint.radius(setting.config.outline) + MARGIN

    def act(self, seen: Seen) -> tuple[float, float]:
        """Return the velocity command [m/s, rad/s]."""
        points = scan_points(seen.ranges, self._angles, self.setting.config)
        course, nearest = course_of(points, self._radius, seen.bearing, seen.distance)
        config = self.setting.config
        free = max(nearest - self._radius, 0.0)
        speed = config.max_linear * min(1.0, 0.3 + free / 0.3) * max(math.cos(course), 0.0)
        return (0.0 if abs(course) > AIMED else speed), 2.5 * course


def course_of(
    points: Floats, radius: float, bearing: float, distance: float
) -> tuple[float, float]:
    """Choose a gap and a course.

    Args:
        points: (n, 2), obstacles in the base frame [m].
        radius: of the robot, with a margin [m].
        bearing: of the goal [rad].
        distance: of the goal [m].

    Returns:
        The course [rad], and the distance of the nearest obstacle [m].
    """
    far = np.hypot(points[:, 0], points[:, 1])
    reach = min(REACH, distance)
    near, to = far[far < reach], np.arctan2(points[:, 1], points[:, 0])[far < reach]
    if len(near) == 0:
        return bearing, math.inf
    wide = np.arcsin(np.clip(radius / np.maximum(near, 1e-6), 0.0, 1.0))
    middles: Floats = np.linspace(-math.pi, math.pi, BINS, endpoint=False)
    apart = np.abs((middles[:, None] - to + math.pi) % (2.0 * math.pi) - math.pi)
    free: NDArray[np.bool_] = np.all(apart > wide, axis=1)
    if not free.any():
        return float(to[near.argmax()]), float(near.min())
    centre = min(gaps(free, middles), key=lambda gap: off_gap(gap, bearing))[0]
    weight = ALPHA / float(near.min())
    course = centre + wrapped(bearing - centre) / (weight + 1.0)
    return wrapped(course), float(near.min())


def gaps(free: NDArray[np.bool_], middles: Floats) -> list[tuple[float, float]]:
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
        (wrapped(begin + step * (start + end) / 2.0), step * (end - start) / 2.0)
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True)
    ]


def off_gap(gap: tuple[float, float], bearing: float) -> float:
    """How far a bearing lies outside a gap; negative within it [rad]."""
    return abs(wrapped(bearing - gap[0])) - gap[1]


def wrapped(angle: float) -> float:
    """The same angle within [-pi, pi) [rad]."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi
