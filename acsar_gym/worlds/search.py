"""Shortest ways for a footprint through a world: its configuration space, searched by scipy.

The footprint counts as the disc around it: a skid-steer robot turns on the spot, so it can follow
any path that the disc can.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, footprint
from acsar_gym.errors import WorldError
from acsar_gym.worlds.clearance import clearance, segment_clearance
from acsar_gym.worlds.grid import (
    MOST_CELLS,
    RESOLUTION,
    SLACK,
    Grid,
    box_around,
    cells_in,
    free_cells,
    leaves,
    near,
    search,
)
from acsar_gym.worlds.world import Floats, Region, World

LEAST_REACH = 10.0
"""Around start and goal, what is searched first in large worlds [m]."""
WIDENING = 4.0
"""How many times as far the search reaches where it has found no way."""
NEAR = 4
"""Cells around an end of a way in which it may enter the grid."""
CUTS = 4
"""How often corners are cut off."""
BISECTIONS = 6
"""Of each cut."""
CULLED = 500
"""Obstacles above which only those near a piece of the way are looked at."""
BLOCK = 64
"""Points of a path that are tried at once for a straight way."""


def footprint_radius(config: RobotConfig) -> float:
    """Radius of the disc around a robot's footprint [m]."""
    return footprint.radius(config.outline)


def shortest_path(
    world: World,
    radius: float,
    start: Region | None = None,
    goal: Region | None = None,
    *,
    cuts: int = CUTS,
) -> Floats:
    """P x 2: a shortest way of a disc of this radius [m] from start to goal, as straight pieces.

    A shortest way over eight-connected cells, pulled straight where obstacles allow it, its corners
    cut off `cuts` times: within 1 % of the shortest one; without cuts it is a little longer. Start
    and goal are the centres of the world's regions unless others are given. Raises WorldError where
    one of the regions isn't free for the disc, or there is no way.
    """
    start, goal = start or world.start, goal or world.goal
    for name, region in (("start", start), ("goal", goal)):
        check_region(world, name, region, radius)
    ends = np.array([[start.x, start.y], [goal.x, goal.y]])
    if segment_clearance(ends[:1], ends[1:], world)[0] >= radius:
        return ends
    way = _way(world, radius, ends)
    if way is None:
        raise WorldError(
            f"{_named(world)}no way from start to goal for a footprint of radius {radius:.2f} m"
        )
    way = _pulled(_pulled(way, world, radius)[::-1], world, radius)[::-1]
    for _ in range(cuts):
        way = _pulled(_cut(way, world, radius), world, radius)
    return way


def _way(world: World, radius: float, ends: Floats) -> Floats | None:
    """P x 2: a shortest way over cells; None where there is none.

    In a world of many cells, as one whose obstacles lie far apart, only what is around the ends is
    searched, until nothing beyond can be on a shorter way: all ways of length L between ends D
    apart lie within sqrt(L^2 - D^2) / 2 of the box around the ends.
    """
    box, apart = box_around(world, ends), math.dist(*ends)
    reach = math.inf if cells_in(box, radius, RESOLUTION) <= MOST_CELLS else max(LEAST_REACH, apart)
    while True:
        grid = free_cells(world, radius, ends, reach)
        whole = reach >= max(*(ends.min(axis=0) - box[:2]), *(box[2:] - ends.max(axis=0)))
        first, last = (_entry(grid, end, world, radius) for end in ends)
        cells = search(grid, first, last)
        if cells is None:
            if whole or not leaves(grid, first, last):
                return None
            reach *= WIDENING
            continue
        way = np.concatenate([ends[:1], grid.centres(cells), ends[1:]])
        needed = math.sqrt(max(path_length(way) ** 2 - apart**2, 0.0)) / 2.0
        if whole or needed <= reach:
            return way
        reach = needed


def check_region(world: World, name: str, region: Region, radius: float) -> None:
    """WorldError unless a disc of this radius is free wherever it stands in the region."""
    free = clearance(np.array([[region.x, region.y]]), world)[0]
    if free < radius + region.radius - SLACK:
        raise WorldError(
            f"{_named(world)}the {name} ({region.x:g}, {region.y:g}) lies {max(free, 0.0):.2f} m "
            f"from an obstacle, a footprint of radius {radius:.2f} m needs "
            f"{radius + region.radius:.2f} m"
        )


def check_path(world: World, radius: float) -> None:
    """WorldError where a disc of this radius [m] can't follow the world's own path."""
    path = np.zeros((0, 2)) if world.path is None else world.path
    if len(path) < 2:
        raise WorldError(f"{_named(world)}the path must have at least two points")
    free = float(segment_clearance(path[:-1], path[1:], world).min())
    if free < radius - SLACK:
        raise WorldError(
            f"{_named(world)}the path passes {max(free, 0.0):.2f} m from an obstacle, a footprint "
            f"of radius {radius:.2f} m needs {radius:.2f} m"
        )


def _named(world: World) -> str:
    return f"{world.name}: " if world.name else ""


def _entry(grid: Grid, end: Floats, world: World, radius: float) -> int:
    """The free cell next to an end of the way that can be reached straight from there.

    The end's own cell where there is none: the way may come a little nearer to an obstacle then.
    """
    own = grid.cell(float(end[0]), float(end[1]))
    i, j = divmod(own, grid.free.shape[1])
    low_i, low_j = max(i - NEAR, 0), max(j - NEAR, 0)
    near = np.argwhere(grid.free[low_i : i + NEAR + 1, low_j : j + NEAR + 1])
    cells = (near[:, 0] + low_i) * grid.free.shape[1] + near[:, 1] + low_j
    centres = grid.centres(cells)
    open_ways = segment_clearance(np.broadcast_to(end, centres.shape), centres, world) >= (
        radius - SLACK
    )
    if not open_ways.any():
        grid.free.flat[own] = True
        return own
    away = np.hypot(*(centres - end).T)
    return int(cells[np.where(open_ways, away, np.inf).argmin()])


def _cut(way: Floats, world: World, radius: float) -> Floats:
    """The way with its corners cut off as far as obstacles allow it."""
    if len(way) < 3:
        return way
    before, corner, behind = way[:-2], way[1:-1], way[2:]
    share, step = np.zeros(len(corner)), 0.25
    for _ in range(BISECTIONS):
        more = (share + step)[:, None]
        ends = corner + more * (before - corner), corner + more * (behind - corner)
        share += np.where(_blocked(*ends, world, radius - SLACK / 2.0), 0.0, step)
        step /= 2.0
    one = corner + share[:, None] * (before - corner)
    other = corner + share[:, None] * (behind - corner)
    return np.concatenate([way[:1], np.stack([one, other], axis=1).reshape(-1, 2), way[-1:]])


def _blocked(starts: Floats, ends: Floats, world: World, radius: float) -> NDArray[np.bool_]:
    """Whether straight pieces come nearer than `radius` to an obstacle."""
    if world.obstacles > CULLED:
        both = np.concatenate([starts, ends])
        box = np.concatenate([both.min(axis=0) - radius, both.max(axis=0) + radius])
        world = near(world, box)
    blocked: NDArray[np.bool_] = segment_clearance(starts, ends, world) < radius
    return blocked


def _pulled(way: Floats, world: World, radius: float) -> Floats:
    """The way without the points that a straight piece can leave out."""
    kept, here = [0], 0
    while here < len(way) - 1:
        here = _farthest(way, here, world, radius)
        kept.append(here)
    return way[kept]


def _farthest(way: Floats, here: int, world: World, radius: float) -> int:
    """The point before the first one on the way that can't be reached straight."""
    last = here + 1
    for first in range(here + 2, len(way), BLOCK):
        ends = way[first : first + BLOCK]
        starts = np.broadcast_to(way[here], ends.shape)
        blocked = _blocked(starts, ends, world, radius - SLACK)
        if blocked.any():
            return max(last, first + int(blocked.argmax()) - 1)
        last = first + len(ends) - 1
    return last


def path_length(path: Floats) -> float:
    """Length of a polyline [m]."""
    return sum(math.dist(a, b) for a, b in pairwise(path.tolist()))


def way_left(world: World, radius: float, place: Region, goal: Region) -> float:
    """Length of a shortest way from a place to the goal [m], for a robot that may have collided.

    For the disc of this radius [m], or the largest one that is free where the robot stands; inf
    where there is no way.
    """
    ends = np.array([[place.x, place.y], [goal.x, goal.y]])
    fitting = min(radius, *(clearance(ends, world) - SLACK).tolist())
    try:
        return path_length(shortest_path(world, max(fitting, 0.0), place, goal))
    except WorldError:
        return math.inf
