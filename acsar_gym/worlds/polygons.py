"""Whether an obstacle meets a footprint that is a polygon, compiled where numba is installed.

Everything is in the base frame: x ahead, y to the left [m].
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, footprint
from acsar_gym.jit import jit, loop

Floats = NDArray[np.float64]


def sides(config: RobotConfig) -> Floats:
    """N x 4: the sides (x1, y1, x2, y2) of a robot's polygon; none where its footprint is a box."""
    if config.footprint is None:
        return np.zeros((0, 4))
    return np.array([(*a, *b) for a, b in footprint.sides(config.footprint)])


@loop
def inside(x: float, y: float, polygon: Floats) -> bool:
    """Whether a point lies within the sides of a polygon."""
    found = False
    for n in range(len(polygon)):
        ax, ay, bx, by = polygon[n, 0], polygon[n, 1], polygon[n, 2], polygon[n, 3]
        if (ay > y) != (by > y) and x < ax + (bx - ax) * (y - ay) / (by - ay):
            found = not found
    return found


@loop
def circle_meets_polygon(x: float, y: float, radius: float, polygon: Floats) -> bool:
    """Whether a circle at (x, y) overlaps a polygon."""
    for n in range(len(polygon)):
        ax, ay = polygon[n, 0], polygon[n, 1]
        ex, ey = polygon[n, 2] - ax, polygon[n, 3] - ay
        share = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
        share = min(max(share, 0.0), 1.0)
        dx, dy = x - ax - share * ex, y - ay - share * ey
        if dx * dx + dy * dy <= radius * radius:
            return True
    return inside(x, y, polygon)


@loop
def segment_meets_polygon(ax: float, ay: float, bx: float, by: float, polygon: Floats) -> bool:
    """Whether a segment from a to b touches a polygon, or lies within it."""
    for n in range(len(polygon)):
        if segments_meet(
            ax, ay, bx, by, polygon[n, 0], polygon[n, 1], polygon[n, 2], polygon[n, 3]
        ):
            return True
    return inside(ax, ay, polygon)


@jit
def segments_meet(
    ax: float, ay: float, bx: float, by: float, cx: float, cy: float, dx: float, dy: float
) -> bool:
    """Whether the segments a-b and c-d have a point in common."""
    if max(ax, bx) < min(cx, dx) or max(cx, dx) < min(ax, bx):
        return False
    if max(ay, by) < min(cy, dy) or max(cy, dy) < min(ay, by):
        return False
    ex, ey, fx, fy = bx - ax, by - ay, dx - cx, dy - cy
    c_side = ex * (cy - ay) - ey * (cx - ax)
    d_side = ex * (dy - ay) - ey * (dx - ax)
    a_side = fx * (ay - cy) - fy * (ax - cx)
    b_side = fx * (by - cy) - fy * (bx - cx)
    return c_side * d_side <= 0.0 and a_side * b_side <= 0.0
