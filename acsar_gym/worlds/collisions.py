"""Exact collisions of footprints, boxes and polygons, with circles and segments.

Scalar functions and loops over obstacles, compiled where numba is installed. Footprints are in the
base frame: x ahead, y to the left [m]. Obstacles out of reach are skipped early.
"""

from __future__ import annotations

import math

from acsar_gym.jit import jit, loop
from acsar_gym.worlds.geometry import Floats, Surroundings


@loop
def collides(x: float, y: float, cos: float, sin: float, which: int, around: Surroundings) -> bool:
    """Whether the footprint touches an obstacle.

    Args:
        x: of the base in the frame of the world [m].
        y: of the base in the frame of the world [m].
        cos: of the heading.
        sin: of the heading.
        which: index of the set of obstacles.
        around: obstacles and footprint.
    """
    half_x, half_y = around.half_length, around.half_width
    outer = math.sqrt(half_x * half_x + half_y * half_y)
    circles, segments, is_box = around.circles, around.segments, len(around.sides) == 0
    for n in range(circles.shape[1]):
        dx, dy, radius = circles[which, n, 0] - x, circles[which, n, 1] - y, circles[which, n, 2]
        near = outer + radius
        if dx * dx + dy * dy <= near * near:
            ahead, left = dx * cos + dy * sin, dy * cos - dx * sin
            if circle_meets_box(ahead, left, radius, half_x, half_y) and (
                is_box or circle_meets_polygon(ahead, left, radius, around.sides)
            ):
                return True
    for n in range(segments.shape[1]):
        ax, ay = segments[which, n, 0] - x, segments[which, n, 1] - y
        bx, by = segments[which, n, 2] - x, segments[which, n, 3] - y
        if min(ax, bx) <= outer and max(ax, bx) >= -outer and min(ay, by) <= outer:
            a_x, a_y = ax * cos + ay * sin, ay * cos - ax * sin
            b_x, b_y = bx * cos + by * sin, by * cos - bx * sin
            if segment_meets_box(a_x, a_y, b_x, b_y, half_x, half_y) and (
                is_box or segment_meets_polygon(a_x, a_y, b_x, b_y, around.sides)
            ):
                return True
    return False


@jit
def circle_meets_box(x: float, y: float, radius: float, half_x: float, half_y: float) -> bool:
    """Whether a circle at (x, y) overlaps the box of these half sizes around the origin."""
    dx = x - min(max(x, -half_x), half_x)
    dy = y - min(max(y, -half_y), half_y)
    return dx * dx + dy * dy <= radius * radius


@jit
def segment_meets_box(
    ax: float, ay: float, bx: float, by: float, half_x: float, half_y: float
) -> bool:
    """Whether a segment touches the box of these half sizes around the origin.

    By the algorithm of Liang and Barsky (1984).
    """
    near, far = 0.0, 1.0
    for start, along, half in ((ax, bx - ax, half_x), (ay, by - ay, half_y)):
        if abs(along) < 1e-15:
            if abs(start) > half:
                return False
        else:
            one, two = (-half - start) / along, (half - start) / along
            near, far = max(near, min(one, two)), min(far, max(one, two))
    return near <= far


@loop
def inside(x: float, y: float, polygon: Floats) -> bool:
    """Whether a point lies within a polygon, (sides, 4)."""
    found = False
    for n in range(len(polygon)):
        ax, ay, bx, by = polygon[n, 0], polygon[n, 1], polygon[n, 2], polygon[n, 3]
        if (ay > y) != (by > y) and x < ax + (bx - ax) * (y - ay) / (by - ay):
            found = not found
    return found


@loop
def circle_meets_polygon(x: float, y: float, radius: float, polygon: Floats) -> bool:
    """Whether a circle at (x, y) overlaps a polygon, (sides, 4)."""
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
    """Whether a segment from a to b touches a polygon, (sides, 4), or lies within it."""
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
