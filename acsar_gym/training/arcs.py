"""How far a robot can drive along some arcs before its footprint touches what a LiDAR sees.

A ray that ends at some range stops each arc at a place that depends on nothing else, so it is
looked up in a table. The way that is free of all rays is the least of theirs.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, footprint
from acsar_gym.config.footprint import Outline
from acsar_gym.lidars.base import ray_spec
from acsar_gym.worlds.geometry import RaySpec

Floats = NDArray[np.float64]
Arc = tuple[int, float]
FORWARD, TURN, BACK = 1, 0, -1

CURVATURES = (-0.96, -0.48, -0.24, -0.12, 0.0, 0.12, 0.24, 0.48, 0.96)
"""Of the arcs ahead, times the footprint's radius; positive to the left."""
ARCS: tuple[Arc, ...] = (
    *((FORWARD, curvature) for curvature in CURVATURES),
    (TURN, -1.0),
    (TURN, 1.0),
    (BACK, 0.0),
)
"""Direction and curvature of each arc; TURN is on the spot, to the right and to the left."""
IMAGES = tuple(ARCS.index((direction, -curvature)) for direction, curvature in ARCS)
"""Number of each arc's mirror image."""
LENGTH = {FORWARD: 4.0, TURN: math.pi / 2.0, BACK: 2.0}
"""Length of an arc in radii of the footprint, or angle of a turn [rad]."""
POSES = 50
"""Poses that are tried along an arc."""
MARGIN = 0.125
"""Distance within which the footprint counts as touched, in radii of it."""
CELL = 1.0 / 12.0
"""Length of a cell of the table, in radii of the footprint."""
CELLS = 100


def cell(config: RobotConfig) -> float:
    """Length of a cell of the table [m]."""
    return CELL * footprint.radius(config.outline)


def free_ways(config: RobotConfig) -> Floats:
    """Make the table of free ways of a robot.

    Args:
        config: has footprint and LiDAR.

    Returns:
        Shape (rays, CELLS, arcs): the share of each arc that is free where a ray ends in a cell,
        0 to 1. The last cell stands for all that is farther.
    """
    return _table(config.outline, ray_spec(config), config.lidar_x_offset, config.lidar_y_offset)


@lru_cache(maxsize=16)
def _table(outline: Outline, rays: RaySpec, x: float, y: float) -> Floats:
    """As `free_ways`."""
    radius, angles = footprint.radius(outline), rays.angles()
    ranges = (np.arange(CELLS) + 0.5) * CELL * radius
    points = np.stack((np.outer(np.cos(angles), ranges) + x, np.outer(np.sin(angles), ranges) + y))
    table = np.stack([_free(outline, points, arc, radius) for arc in ARCS], axis=-1)
    table[:, -1] = 1.0
    return table


def _free(outline: Outline, points: Floats, arc: Arc, radius: float) -> Floats:
    """The share of an arc that is free of each of the points (2, rays, cells)."""
    free = np.ones(points.shape[1:])
    for share in np.linspace(1.0, 0.0, POSES, endpoint=False):  # from the end: the first touch wins
        px, py, heading = _pose(arc, share, radius)
        cos, sin = math.cos(heading), math.sin(heading)
        dx, dy = points[0] - px, points[1] - py
        touched = _within(outline, cos * dx + sin * dy, cos * dy - sin * dx, MARGIN * radius)
        free[touched] = share - 1.0 / POSES
    return free


def _pose(arc: Arc, share: float, radius: float) -> tuple[float, float, float]:
    """Pose (x [m], y [m], heading [rad]) after a share of an arc."""
    direction, curvature = arc
    way = share * LENGTH[direction]
    if direction == TURN:
        return 0.0, 0.0, math.copysign(way, curvature)
    if curvature == 0.0:
        return direction * way * radius, 0.0, 0.0
    angle = curvature * way
    return (
        radius * math.sin(angle) / curvature,
        radius * (1.0 - math.cos(angle)) / curvature,
        angle,
    )


def _within(outline: Outline, x: Floats, y: Floats, margin: float) -> NDArray[np.bool_]:
    """Whether points in the base frame are inside of the footprint, or within a margin of it."""
    inside, near = np.zeros(x.shape, np.bool_), np.zeros(x.shape, np.bool_)
    for (ax, ay), (bx, by) in footprint.sides(outline):
        ex, ey = bx - ax, by - ay
        along = np.clip(((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey), 0.0, 1.0)
        near |= np.hypot(x - ax - along * ex, y - ay - along * ey) < margin
        if ay != by:
            crossed = (ay > y) != (by > y)
            inside ^= crossed & (x < ax + (y - ay) * ex / ey)
    return inside | near
