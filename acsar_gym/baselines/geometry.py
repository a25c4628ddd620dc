"""Scans as points in the base frame, and how far a footprint is from them."""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.jit import loop
from acsar_gym.tasks.base import Floats
from acsar_gym.worlds.collisions import inside


def scan_points(ranges: Floats | None, angles: Floats, config: RobotConfig) -> Floats:
    """Convert a scan to points.

    Args:
        ranges: (rays,) [m]; None is no scan.
        angles: (rays,), directions of the rays in the base frame [rad].
        config: of the robot.

    Returns:
        (n, 2): what the rays met, in the base frame [m]; rays that met nothing give none.
    """
    if ranges is None:
        return np.zeros((0, 2))
    met = ranges < config.lidar.max_range - 1e-3
    far, angle = ranges[met], angles[met]
    x = config.lidar_x_offset + far * np.cos(angle)
    return np.column_stack([x, config.lidar_y_offset + far * np.sin(angle)])


def sides_of(config: RobotConfig) -> Floats:
    """(sides, 4): the footprint's sides, from (x, y) to (x, y) in the base frame [m]."""
    corners = np.array(config.outline)
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


@loop
def gap_to(x: float, y: float, sides: Floats) -> float:
    """Distance of a point from a polygon, (sides, 4); 0 inside [m]."""
    best = np.inf
    for n in range(len(sides)):
        ax, ay = sides[n, 0], sides[n, 1]
        ex, ey = sides[n, 2] - ax, sides[n, 3] - ay
        share = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
        share = min(max(share, 0.0), 1.0)
        dx, dy = x - ax - share * ex, y - ay - share * ey
        best = min(best, dx * dx + dy * dy)
    return 0.0 if inside(x, y, sides) else math.sqrt(best)


@loop
def clearance(
    x: float, y: float, theta: float, points: Floats, sides: Floats, outer: float, most: float
) -> float:
    """Distance of the footprint at a pose from the nearest point.

    Args:
        x: of the pose [m].
        y: of the pose [m].
        theta: of the pose [rad].
        points: (n, 2), in the same frame as the pose [m].
        sides: of the footprint, (sides, 4), in the base frame [m].
        outer: radius of the disc around the footprint [m].
        most: farther points don't count [m].

    Returns:
        The distance, at most `most`; 0 where a point lies within the footprint [m].
    """
    cos, sin, best = math.cos(theta), math.sin(theta), most
    for n in range(len(points)):
        dx, dy = points[n, 0] - x, points[n, 1] - y
        reach = outer + best
        if dx * dx + dy * dy < reach * reach:
            gap = gap_to(dx * cos + dy * sin, dy * cos - dx * sin, sides)
            best = min(best, gap)
    return best
