"""Footprints of robots: convex polygons, their validation, and distances to them.

An outline is a tuple of corners (x, y) in the base frame [m], counter-clockwise. The functions here
are plain Python for a few corners. The compiled collision test is in `worlds.geometry`.
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
CIRCLE_CORNERS = 16
"""Corners of a round footprint, as many as Nav2 draws."""
MIN_BORDER_DISTANCE = 1e-3
"""Smallest allowed distance of an outline from the origin [m]."""
ROUNDING = 1e-9
"""Corners of a straight side may turn to the right by this angle, as digits are rounded [rad]."""


def make_rectangle(length: float, width: float) -> Outline:
    """Return a rectangle around the origin, `length` along x, `width` along y [m]."""
    x = length / 2.0
    y = width / 2.0
    return ((x, y), (-x, y), (-x, -y), (x, -y))


def make_circle(radius: float) -> Outline:
    """Return corners of a circle: the first at exactly this radius [m], the rest 2 um nearer."""
    angles = [math.tau * k / CIRCLE_CORNERS for k in range(1, CIRCLE_CORNERS)]
    # Rounding to micrometres must not move a corner beyond the first.
    near = radius - 2e-6
    corners = [
        (round(near * math.cos(a), 6) + 0.0, round(near * math.sin(a), 6) + 0.0) for a in angles
    ]
    return ((radius, 0.0), *corners)


def validate_outline(corners: Sequence[Point]) -> Outline:
    """Return an outline counter-clockwise, without the first corner repeated at the end.

    Raises:
        ValueError: There are fewer than 3 or more than 100 corners, the polygon isn't convex, or
            the origin isn't inside.
    """
    outline = tuple(corners[:-1] if len(corners) > 1 and corners[0] == corners[-1] else corners)
    if not 3 <= len(outline) <= MAX_CORNERS:
        raise ValueError(f"must be 3 to {MAX_CORNERS} corners (x, y)")

    # The sum of turns is a full circle, to the left if corners are counter-clockwise.
    turns = _find_turns(outline)
    if turns.sum() < 0.0:
        outline = outline[::-1]
        turns = -turns
    if not (turns.min() > -ROUNDING and turns.sum() < 3.0 * math.pi):
        raise ValueError("must be a convex polygon with its corners in order around it")

    # Rays and collisions start from the origin.
    is_inside = contains_point(outline, 0.0, 0.0)
    if not is_inside or border_distance(outline, 0.0, 0.0) < MIN_BORDER_DISTANCE:
        raise ValueError("must have the origin of the base frame (0, 0) inside")
    return outline


def _find_turns(outline: Outline) -> NDArray[np.float64]:
    """Angles to the left from each side to the next [rad], NaN if corners are equal."""
    corners = np.array(outline) @ (1.0, 1.0j)
    # Complex numbers turn by multiplication.
    sides = np.roll(corners, -1) - corners
    turns = np.angle(np.roll(sides, -1) * sides.conj())
    return np.where(sides == 0.0, math.nan, turns)


def _parse_corners(value: Any) -> Any:
    """Parse a list of pairs, or a string such as Nav2's parameter."""
    try:
        corners = reading.parse_json(value) if isinstance(value, str) else value
        return [(x, y) for x, y in corners]
    except (ConfigError, TypeError, ValueError) as error:
        raise ValueError(
            "must be a list of corners (x, y), such as [[0.2, 0.1], [-0.2, 0.1], [0.0, -0.2]]"
        ) from error


Corners = Annotated[
    tuple[tuple[Offset, Offset], ...],
    BeforeValidator(_parse_corners),
    AfterValidator(validate_outline),
]
"""Type of a field that holds an outline."""


def outline_sides(outline: Outline) -> Iterator[tuple[Point, Point]]:
    """Yield the sides as pairs of corners, the closing side last."""
    return zip(outline, (*outline[1:], outline[0]), strict=True)


def outline_radius(outline: Outline) -> float:
    """Return the radius of the disc around the origin that contains the outline [m]."""
    return max(math.hypot(x, y) for x, y in outline)


def contains_point(outline: Outline, x: float, y: float) -> bool:
    """Return whether a point [m] is inside a convex outline."""
    return all(
        (bx - ax) * (y - ay) > (by - ay) * (x - ax) for (ax, ay), (bx, by) in outline_sides(outline)
    )


def border_distance(outline: Outline, x: float, y: float) -> float:
    """Return the distance from a point [m] to the nearest side [m]."""
    return min(_distance((x, y), a, b) for a, b in outline_sides(outline))


def outline_reach(outline: Outline, place: Point, bearings: ArrayLike) -> NDArray[np.float64]:
    """Return how far an outline reaches from a place along bearings.

    Args:
        outline: Corners [m].
        place: Start of the rays [m].
        bearings: Directions of the rays [rad].

    Returns:
        The distance to the farthest side that a ray meets [m], 0 if it meets none.
    """
    # One row for each corner, in the frame of each ray: along it, and to its left.
    cos = np.cos(bearings)
    sin = np.sin(bearings)
    corners = np.array(outline) - place
    along = np.array([cos * x + sin * y for x, y in corners])
    across = np.array([cos * y - sin * x for x, y in corners])

    # A side is met if its ends are on different sides of the ray.
    along_before = np.roll(along, 1, axis=0)
    across_before = np.roll(across, 1, axis=0)
    is_met = (across_before > 0.0) != (across > 0.0)
    height = np.where(is_met, across_before - across, 1.0)
    reaches = along_before + (along - along_before) * across_before / height
    farthest: NDArray[np.float64] = np.where(is_met, reaches, 0.0).max(axis=0, initial=0.0)
    return farthest


def _distance(p: Point, a: Point, b: Point) -> float:
    """Distance from a point to the segment a-b [m]."""
    ex = b[0] - a[0]
    ey = b[1] - a[1]
    square = ex * ex + ey * ey
    share = ((p[0] - a[0]) * ex + (p[1] - a[1]) * ey) / square if square > 0.0 else 0.0
    # Beyond an end of the segment, the end is nearest.
    share = min(max(share, 0.0), 1.0)
    return math.hypot(p[0] - a[0] - share * ex, p[1] - a[1] - share * ey)
