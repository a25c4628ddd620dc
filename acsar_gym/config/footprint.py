"""Footprint polygons: validation, point tests, and decomposition into convex pieces.

An outline is a tuple of corners (x, y) in the base frame [m]. This is plain Python for a few
corners; the compiled collision test is in `worlds.geometry`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, BeforeValidator

from acsar_gym import reading
from acsar_gym.config.section import Offset
from acsar_gym.errors import ConfigError

Point = tuple[float, float]
Outline = tuple[Point, ...]
MAX_CORNERS = 100
CIRCLE_CORNERS = 16  # corners of a round footprint, as nav2 draws it
MIN_BORDER_DISTANCE = 1e-3  # smallest allowed distance of an outline from the origin [m]
MIN_AREA = 1e-9  # three points are collinear if twice their area is below this [m^2]


def make_rectangle(length: float, width: float) -> Outline:
    """Return a rectangle around the origin, `length` along x, `width` along y [m]."""
    x, y = length / 2.0, width / 2.0
    return ((x, y), (-x, y), (-x, -y), (x, -y))


def make_circle(radius: float) -> Outline:
    """Return corners of a circle: the first at exactly this radius, others a hair nearer."""
    angles = [math.tau * k / CIRCLE_CORNERS for k in range(1, CIRCLE_CORNERS)]
    near = radius - 2e-6
    others = [
        (round(near * math.cos(a), 6) + 0.0, round(near * math.sin(a), 6) + 0.0) for a in angles
    ]
    return ((radius, 0.0), *others)


def validate_outline(corners: Sequence[Point]) -> Outline:
    """Return an outline counter-clockwise, without the first corner repeated at the end.

    ValueError for fewer than three corners or more than 100, sides that cross or touch each other,
    and an origin that isn't inside.
    """
    outline = tuple(corners[:-1] if len(corners) > 1 and corners[0] == corners[-1] else corners)
    if not 3 <= len(outline) <= MAX_CORNERS:
        raise ValueError(f"must be 3 to {MAX_CORNERS} corners (x, y)")
    if not _is_simple(outline):
        raise ValueError("must be the corners in order around it: its sides cross or touch")
    if (
        not contains_point(outline, 0.0, 0.0)
        or border_distance(outline, 0.0, 0.0) < MIN_BORDER_DISTANCE
    ):
        raise ValueError("must have the origin of the base frame (0, 0) inside")
    return outline if _twice_area(outline) > 0.0 else outline[::-1]


def _listed(given: Any) -> Any:
    """Parse a list of pairs, or a string such as nav2's parameter; ValueError for others."""
    try:
        listed = reading.parse_json(given) if isinstance(given, str) else given
        return [(x, y) for x, y in listed]
    except (ConfigError, TypeError, ValueError) as error:
        raise ValueError(
            "must be a list of corners (x, y), such as [[0.2, 0.1], [-0.2, 0.1], [0.0, -0.2]]"
        ) from error


Corners = Annotated[
    tuple[tuple[Offset, Offset], ...], BeforeValidator(_listed), AfterValidator(validate_outline)
]
"""Type of a field that holds an outline."""


def outline_sides(outline: Outline) -> Iterator[tuple[Point, Point]]:
    """Yield the sides as pairs of corners, the closing side last."""
    return zip(outline, (*outline[1:], outline[0]), strict=True)


def outline_radius(outline: Outline) -> float:
    """Return the radius of the disc around the origin that contains the outline [m]."""
    return max(math.hypot(x, y) for x, y in outline)


def contains_point(outline: Outline, x: float, y: float) -> bool:
    """Return whether a point [m] is inside; on the border, either result is possible."""
    inside = False
    for (ax, ay), (bx, by) in outline_sides(outline):
        if (ay > y) != (by > y) and x < ax + (bx - ax) * (y - ay) / (by - ay):
            inside = not inside
    return inside


def border_distance(outline: Outline, x: float, y: float) -> float:
    """Return the distance from a point [m] to the nearest side [m]."""
    return min(_distance((x, y), a, b) for a, b in outline_sides(outline))


def outline_reach(outline: Outline, place: Point, bearings: ArrayLike) -> NDArray[np.float64]:
    """Return how far an outline reaches from a place along bearings; 0 where it isn't met."""
    reaches = np.zeros(np.shape(bearings))
    (x, y), cos, sin = place, np.cos(bearings), np.sin(bearings)
    for (ax, ay), (bx, by) in outline_sides(outline):
        a, b = cos * (ax - x) + sin * (ay - y), cos * (bx - x) + sin * (by - y)  # along the ray
        c, d = cos * (ay - y) - sin * (ax - x), cos * (by - y) - sin * (bx - x)  # across
        met = (c > 0.0) != (d > 0.0)
        reach = a + (b - a) * c / np.where(met, c - d, 1.0)
        reaches = np.where(met, np.maximum(reaches, reach), reaches)
    return reaches


def convex_pieces(outline: Outline) -> list[Outline]:
    """Decompose an outline: itself if it is convex, otherwise triangles (ear clipping)."""
    corners = list(outline)
    turns = zip(corners[-1:] + corners, corners, corners[1:] + corners[:1], strict=False)
    if all(_turn(a, b, c) >= 0.0 for a, b, c in turns):
        return [outline]
    pieces: list[Outline] = []
    while len(corners) > 3:
        ears = [(corners[n - 1], b, corners[n + 1 - len(corners)]) for n, b in enumerate(corners)]
        ear = next((n for n, piece in enumerate(ears) if _is_ear(piece, corners)), 0)
        pieces.append(ears[ear])
        del corners[ear]
    return [piece for piece in (*pieces, tuple(corners)) if _twice_area(piece) > MIN_AREA]


def _is_ear(piece: tuple[Point, Point, Point], corners: Sequence[Point]) -> bool:
    """Whether a triangle of neighbours is convex and contains no other corner."""
    a, b, c = piece
    return _turn(a, b, c) >= 0.0 and not any(
        _turn(a, b, p) >= 0.0 and _turn(b, c, p) >= 0.0 and _turn(c, a, p) >= 0.0
        for p in corners
        if p not in piece
    )


def _is_simple(outline: Outline) -> bool:
    """Whether the sides don't cross or touch, except neighbours, and the area isn't 0."""
    every = list(outline_sides(outline))
    last = len(every) - 1
    for n, (a, b) in enumerate(every):
        c = every[n - last][1]  # the end of the next side
        if a == b or _distance(c, a, b) == 0.0 or _distance(a, b, c) == 0.0:
            return False
        far = every[n + 2 : last if n == 0 else None]
        if any(_do_meet(a, b, *other) for other in far):
            return False
    return abs(_twice_area(outline)) > MIN_AREA


def _do_meet(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the segments a-b and c-d have a common point."""
    for axis in (0, 1):
        first, second = sorted((a[axis], b[axis])), sorted((c[axis], d[axis]))
        if first[1] < second[0] or second[1] < first[0]:
            return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0.0 and _turn(c, d, a) * _turn(c, d, b) <= 0.0


def _turn(a: Point, b: Point, c: Point) -> float:
    """Twice the signed area of a triangle, positive if counter-clockwise [m^2]."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _twice_area(outline: Outline) -> float:
    """Twice the signed area of an outline, positive if counter-clockwise [m^2]."""
    return sum(ax * by - ay * bx for (ax, ay), (bx, by) in outline_sides(outline))


def _distance(p: Point, a: Point, b: Point) -> float:
    """Distance from a point to the segment a-b [m]."""
    ex, ey = b[0] - a[0], b[1] - a[1]
    square = ex * ex + ey * ey
    share = ((p[0] - a[0]) * ex + (p[1] - a[1]) * ey) / square if square > 0.0 else 0.0
    share = min(max(share, 0.0), 1.0)
    return math.hypot(p[0] - a[0] - share * ex, p[1] - a[1] - share * ey)
