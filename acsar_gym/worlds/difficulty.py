"""How hard a world is along its path: the five measures of BARN.

D. Perille, A. Truong, X. Xiao, P. Stone: Benchmarking Metric Ground Navigation, SSRR 2020
(arXiv:2008.13315), and its code, difficulty_quant.py of dperille/jackal-map-creation. The published
measures are means over the cells of a path on an occupancy grid of 0.15 m, with obstacles enlarged
by the robot. Here they are means over points every 0.15 m along the path, so that they don't depend
on how many points it has, and are taken on the exact obstacles, not enlarged, in m. So they compare
worlds of this project with each other, not with the published figures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import WorldError
from acsar_gym.worlds.geometry import point_clearance
from acsar_gym.worlds.world import World

Floats = NDArray[np.float64]
PLACE_SPACING = 0.15
"""Distance between two points of the path that are measured, at most [m]."""
VISIBILITY_RAYS = 64
"""Rays from each point, the first one along x; published: 8, and 16 for dispersion."""
VISIBILITY_REACH = 5.0
"""Length of the rays [m]; this is also the distance where nothing is nearer."""
DISPERSION_RADIUS = 0.75
"""Default radius of dispersion: the published 3 cells, and 2 by which the published obstacles
are enlarged [m]."""
MAX_PLACES = 20_000
RAY_CHUNK = 2**16
"""Distances that are computed at a time."""


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Means over the path. In harder worlds the lengths are smaller and the other two larger."""

    closest_obstacle: float
    """Distance to the nearest surface, at least 0 and at most REACH [m]."""
    visibility: float
    """Mean length of rays in all directions, each at most REACH [m]."""
    dispersion: float
    """How often, in a full turn, the view changes between an obstacle within `radius` and none."""
    characteristic_dimension: float
    """Length of the shortest straight line through the point from obstacle to obstacle: a ray
    and the opposite one, over 32 axes; at most 2 REACH [m]."""
    tortuosity: float
    """Length of the path divided by the distance of its ends; 1 is straight, inf a round trip."""


def measure_difficulty(
    world: World, path: Floats | None = None, radius: float = DISPERSION_RADIUS
) -> Difficulty:
    """Measure the difficulty of a world.

    Args:
        world: with the obstacles.
        path: (points, 2) [m]; None for the world's own.
        radius: of dispersion, at most REACH [m].

    Raises:
        WorldError: there is no path, or it isn't of finite numbers, has no length, or is longer
            than 3 km.
    """
    if not 0.0 < radius <= VISIBILITY_REACH:
        raise WorldError(f"radius = {radius}: must be within (0, {VISIBILITY_REACH:g}] m")
    way = _way(world, path)
    places = _places(way)
    ranges = _ranges(places, world)
    near = ranges <= radius
    across = ranges + np.roll(ranges, VISIBILITY_RAYS // 2, axis=1)
    return Difficulty(
        closest_obstacle=float(
            np.clip(point_clearance(places, world), 0.0, VISIBILITY_REACH).mean()
        ),
        visibility=float(ranges.mean()),
        dispersion=float((near != np.roll(near, 1, axis=1)).sum(axis=1).mean()),
        characteristic_dimension=float(across.min(axis=1).mean()),
        tortuosity=_tortuosity(way),
    )


def _way(world: World, path: Floats | None) -> Floats:
    """The path to measure along, checked."""
    chosen = world.path if path is None else path
    if chosen is None:
        raise WorldError(f"world {world.name!r} has no path to measure its difficulty along")
    way = World(path=chosen).path
    if way is None or _lengths(way).sum() <= 0.0:
        raise WorldError("path: must have two points or more, and not all the same")
    return way


def _lengths(way: Floats) -> Floats:
    """Lengths of the lines of a path [m]."""
    lengths: Floats = np.hypot(*np.diff(way, axis=0).T)
    return lengths


def _tortuosity(way: Floats) -> float:
    """Length of the path divided by the distance of its ends."""
    chord = math.dist(way[0], way[-1])
    return float(_lengths(way).sum()) / chord if chord > 0.0 else math.inf


def _places(way: Floats) -> Floats:
    """Points at even steps along a path, including both ends."""
    along = np.concatenate([[0.0], np.cumsum(_lengths(way))])
    count = math.ceil(along[-1] / PLACE_SPACING - 1e-9) + 1
    if count > MAX_PLACES:
        raise WorldError(f"path: is {along[-1]:.0f} m long, too long to measure")
    at = np.linspace(0.0, along[-1], count)
    return np.column_stack([np.interp(at, along, way[:, axis]) for axis in (0, 1)])


def _ranges(places: Floats, world: World) -> Floats:
    """Lengths of rays (points, RAYS), counter-clockwise from the x axis [m]; 0 inside a circle."""
    rows = max(1, RAY_CHUNK // (VISIBILITY_RAYS * max(1, world.obstacles)))
    chunks = (places[first : first + rows] for first in range(0, len(places), rows))
    return np.concatenate([_some_ranges(chunk, world) for chunk in chunks])


def _some_ranges(places: Floats, world: World) -> Floats:
    """`_ranges` of one chunk."""
    low, high = places.min(axis=0) - VISIBILITY_REACH, places.max(axis=0) + VISIBILITY_REACH
    circles, segments = world.circles, world.segments
    centres, radii = circles[:, :2], circles[:, 2:]
    circles = circles[((centres + radii >= low) & (centres - radii <= high)).all(axis=1)]
    ends = (
        np.minimum(segments[:, :2], segments[:, 2:]),
        np.maximum(segments[:, :2], segments[:, 2:]),
    )
    segments = segments[((ends[1] >= low) & (ends[0] <= high)).all(axis=1)]
    nearest = np.minimum(_to_circles(places, circles), _to_segments(places, segments))
    return np.minimum(nearest, VISIBILITY_REACH)


def _directions() -> tuple[Floats, Floats]:
    """Cosine and sine of the rays, (RAYS, 1)."""
    angles = np.arange(VISIBILITY_RAYS) * (2.0 * math.pi / VISIBILITY_RAYS)
    return np.cos(angles)[:, None], np.sin(angles)[:, None]


def _to_circles(places: Floats, circles: Floats) -> Floats:
    """Ray lengths (points, RAYS), inf where no circle is hit."""
    cos, sin = _directions()
    x, y = (circles[:, axis] - places[:, axis, None, None] for axis in (0, 1))
    along, off = x * cos + y * sin, x * sin - y * cos
    inside = circles[:, 2] ** 2 - off**2
    lengths = along - np.sqrt(np.maximum(inside, 0.0))
    within = x**2 + y**2 <= circles[:, 2] ** 2
    lengths = np.where((inside >= 0.0) & (along > 0.0), lengths, np.inf)
    ranges: Floats = np.where(within, 0.0, lengths).min(axis=2, initial=np.inf)
    return ranges


def _to_segments(places: Floats, segments: Floats) -> Floats:
    """Ray lengths (points, RAYS), inf where no segment is hit."""
    cos, sin = _directions()
    x, y = (segments[:, axis] - places[:, axis, None, None] for axis in (0, 1))
    along_x, along_y = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    across = cos * along_y - sin * along_x
    slope = np.where(np.abs(across) > 1e-12, across, np.nan)
    lengths, shares = (x * along_y - y * along_x) / slope, (x * sin - y * cos) / slope
    met = (lengths >= 0.0) & (shares >= 0.0) & (shares <= 1.0)
    ranges: Floats = np.where(met, lengths, np.inf).min(axis=2, initial=np.inf)
    return ranges
