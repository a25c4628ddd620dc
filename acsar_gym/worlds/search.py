"""Shortest paths for a footprint through a world: its configuration space, searched by scipy.

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
"""In large worlds, at least this distance around start and goal is searched first [m]."""
WIDENING = 4.0
"""Factor by which this distance grows where no path was found."""
NEAR = 4
"""Distance to an end of a path within which the path may enter the grid [cells]."""
CUTS = 4
"""How often corners are cut off."""
BISECTIONS = 6
"""Bisections that find the size of each cut."""
CULLED = 500
"""With more obstacles than this, only those near a part of the path are considered."""
BLOCK = 64
"""Points of a path that are checked at once for a straight line to them."""


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
    """Find a shortest path of a disc of this radius [m] from start to goal, (points, 2) [m].

    A shortest path over eight-connected cells is straightened where obstacles allow it, and its
    corners are cut off `cuts` times: within 1 % of the shortest one; without cuts a little longer.
    Start and goal are the centres of the world's regions unless others are given. Raises WorldError
    where one of the regions isn't free for the disc, or there is no path.
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
    """Find a shortest path over cells, (points, 2); None where there is none.

    In a large world, such as one whose obstacles are far apart, only the area around the ends is
    searched, and enlarged until nothing outside can be on a shorter path: all paths of length L
    between ends D apart lie within sqrt(L^2 - D^2) / 2 of the box around the ends.
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
    """Raise WorldError unless a disc is free everywhere in a region.

    Args:
        world: with the obstacles.
        name: of the region, for the message.
        region: for the centre of the disc.
        radius: of the disc [m].
    """
    free = clearance(np.array([[region.x, region.y]]), world)[0]
    if free < radius + region.radius - SLACK:
        raise WorldError(
            f"{_named(world)}the {name} ({region.x:g}, {region.y:g}) lies {max(free, 0.0):.2f} m "
            f"from an obstacle, a footprint of radius {radius:.2f} m needs "
            f"{radius + region.radius:.2f} m"
        )


def check_path(world: World, radius: float) -> None:
    """Raise WorldError where a disc of this radius [m] can't follow the world's own path."""
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
    """The world's name as the beginning of a message."""
    return f"{world.name}: " if world.name else ""


def _entry(grid: Grid, end: Floats, world: World, radius: float) -> int:
    """The nearest free cell that can be reached in a straight line from an end of the path.

    The end's own cell where there is none; the path may be a little too near to an obstacle then.
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
    """Cut off the corners of a path as far as obstacles allow it."""
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
    """Whether straight lines are nearer than `radius` to an obstacle."""
    if world.obstacles > CULLED:
        both = np.concatenate([starts, ends])
        box = np.concatenate([both.min(axis=0) - radius, both.max(axis=0) + radius])
        world = near(world, box)
    blocked: NDArray[np.bool_] = segment_clearance(starts, ends, world) < radius
    return blocked


def _pulled(way: Floats, world: World, radius: float) -> Floats:
    """Remove points of a path that a straight line can replace."""
    kept, here = [0], 0
    while here < len(way) - 1:
        here = _farthest(way, here, world, radius)
        kept.append(here)
    return way[kept]


def _farthest(way: Floats, here: int, world: World, radius: float) -> int:
    """The last point of the path that can be reached in a straight line, and all before it, too."""
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
    """Length of a path [m]."""
    return sum(math.dist(a, b) for a, b in pairwise(path.tolist()))


def way_left(world: World, radius: float, place: Region, goal: Region) -> float:
    """Length of a shortest path to the goal [m], for a robot that may have collided.

    Args:
        world: with the obstacles.
        radius: of the disc [m]; a smaller one is used if only that is free where the robot is.
        place: of the robot.
        goal: its centre is used.

    Returns:
        inf where there is no path.
    """
    ends = np.array([[place.x, place.y], [goal.x, goal.y]])
    fitting = min(radius, *(clearance(ends, world) - SLACK).tolist())
    try:
        return path_length(shortest_path(world, max(fitting, 0.0), place, goal))
    except WorldError:
        return math.inf
