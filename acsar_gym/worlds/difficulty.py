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

from acsar_gym.errors import WorldError
from acsar_gym.worlds.geometry import Surroundings, cast_lines, point_clearance
from acsar_gym.worlds.world import Floats, World

PLACE_SPACING = 0.15  # distance between two points of the path that are measured, at most [m]
VISIBILITY_REACH = 5.0  # length of the rays [m]; this is also the distance where nothing is nearer
VISIBILITY_RAYS = 64
"""Rays from each point, the first one along x; published: 8, and 16 for dispersion."""
DISPERSION_RADIUS = 0.75
"""Radius of dispersion: the published 3 cells, and 2 by which the published obstacles
are enlarged [m]."""
MAX_PLACES = 20_000


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Means over the path. In harder worlds the lengths are smaller and the other two larger."""

    closest_obstacle: float
    """Distance to the nearest surface, at least 0 and at most VISIBILITY_REACH [m]."""
    visibility: float
    """Mean length of rays in all directions, each at most VISIBILITY_REACH [m]."""
    dispersion: float
    """How often, in a full turn, the view changes between an obstacle that is near and none."""
    characteristic_dimension: float
    """Length of the shortest straight line through the point from obstacle to obstacle: a ray
    and the opposite one, over 32 axes; at most 2 VISIBILITY_REACH [m]."""
    tortuosity: float
    """Length of the path divided by the distance of its ends; 1 is straight, inf a round trip."""


def measure_difficulty(world: World, path: Floats | None = None) -> Difficulty:
    """Measure the difficulty of a world along a path (points, 2) [m]; None for the world's own.

    WorldError where there is no path, or one that has no length or is longer than 3 km.
    """
    path = World(path=world.path if path is None else path).path
    if path is None:
        raise WorldError(f"world {world.name!r} has no path to measure its difficulty along")
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    if len(path) < 2 or along[-1] <= 0.0:
        raise WorldError("path: must have two points or more, and not all the same")
    count = math.ceil(along[-1] / PLACE_SPACING - 1e-9) + 1
    if count > MAX_PLACES:
        raise WorldError(f"path: is {along[-1]:.0f} m long, too long to measure")
    at = np.linspace(0.0, along[-1], count)
    places = np.column_stack([np.interp(at, along, path[:, axis]) for axis in (0, 1)])

    step = math.tau / VISIBILITY_RAYS
    angles = step * np.arange(VISIBILITY_RAYS)
    around = Surroundings(
        np.array([world.circles]),  # not read-only, as those that the compiled code knows
        np.array([world.segments]),
        np.stack([np.cos(angles), np.sin(angles)], axis=1)[None],
        kinds=np.array([[0.0, step, VISIBILITY_REACH, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]]),
        sides=np.zeros((1, 0, 7)),
    )
    ranges = np.empty((count, VISIBILITY_RAYS))
    origins = np.zeros((VISIBILITY_RAYS, 2))
    for (x, y), row in zip(places.tolist(), ranges, strict=True):
        cast_lines(x, y, 1.0, 0.0, 0, around, origins, row)
    nearest = np.clip(point_clearance(places, world), 0.0, VISIBILITY_REACH)
    near = ranges <= DISPERSION_RADIUS
    across = ranges + np.roll(ranges, VISIBILITY_RAYS // 2, axis=1)
    chord = math.dist(path[0], path[-1])
    return Difficulty(
        closest_obstacle=float(nearest.mean()),
        visibility=float(ranges.mean()),
        dispersion=float((near != np.roll(near, 1, axis=1)).sum(axis=1).mean()),
        characteristic_dimension=float(across.min(axis=1).mean()),
        tortuosity=float(along[-1]) / chord if chord > 0.0 else math.inf,
    )
