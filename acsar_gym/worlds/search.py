"""Shortest paths for a footprint, and paths to follow.

In shortest paths the footprint counts as the disc around it: a skid-steer robot turns on the spot,
so it can follow any path that the disc can.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np

from acsar_gym.config import RobotConfig, footprint
from acsar_gym.errors import WorldError
from acsar_gym.jit import loop
from acsar_gym.worlds.geometry import is_free, point_clearance, segment_clearance
from acsar_gym.worlds.grid import (
    CELL_SIDE,
    MAX_CELLS,
    PATH_SLACK,
    Grid,
    bounds_with,
    free_cells,
    search_cells,
)
from acsar_gym.worlds.sdf import LIDAR_HEIGHT, STEP_HEIGHT
from acsar_gym.worlds.world import Floats, Region, World, X, Y

LEAST_REACH = 10.0
"""In large worlds, at least this distance around start and goal is searched first [m]."""
REACH_FACTOR = 4.0
"""Factor by which this distance grows if no path was found."""
ENTRY_CELLS = 4
"""Distance to an end of a path within which the path may enter the grid [cells]."""
CORNER_CUTS = 4
"""How often corners are cut off."""
CUT_BISECTIONS = 6
"""Bisections that find the size of each cut."""
PATH_SPACING = 0.05
"""Distance between the points of a sampled path [m]."""


def footprint_radius(config: RobotConfig) -> float:
    """Radius of the disc around a robot's footprint [m]."""
    return footprint.outline_radius(config.outline)


def lidar_height(config: RobotConfig) -> float:
    """Height at which a robot's LiDAR sees the bodies of a file [m]."""
    return config.lidar_z_offset if config.lidar_z_offset > STEP_HEIGHT else LIDAR_HEIGHT


def path_length(path: Floats) -> float:
    """Length of a path [m]."""
    return sum(math.dist(a, b) for a, b in pairwise(path.tolist()))


def shortest_path(
    world: World,
    radius: float,
    start: Region | None = None,
    goal: Region | None = None,
    *,
    cuts: int = CORNER_CUTS,
) -> Floats:
    """Find a shortest path of a disc of this radius [m] from start to goal, (points, 2) [m].

    A shortest path over eight-connected cells is straightened if obstacles allow it, and its
    corners are cut off `cuts` times: within 1 % of the shortest path. Without cuts it is a little
    longer.

    Args:
        world: World with the obstacles.
        radius: Radius of the disc [m].
        start: Region whose centre is the start. None: the start of the world.
        goal: Region whose centre is the goal. None: the goal of the world.
        cuts: How often corners are cut off.

    Raises:
        WorldError: One of the regions isn't free for the disc, or there is no path.
    """
    start = start or world.start
    goal = goal or world.goal
    check_region(world, "start", start, radius)
    check_region(world, "goal", goal, radius)
    # If nothing is in between, the straight line is the path.
    ends = np.array([[start.x, start.y], [goal.x, goal.y]])
    if segment_clearance(ends[:1], ends[1:], world)[0] >= radius:
        return ends

    path = _search_path(world, radius, ends)
    if path is None:
        raise WorldError(
            f"{_prefix(world)}no way from start to goal for a footprint of radius {radius:.2f} m"
        )

    # From both ends, because points are only removed ahead of the last corner that stays.
    path = _straighten(_straighten(path, world, radius)[::-1], world, radius)[::-1]
    for _ in range(cuts):
        path = _straighten(_cut_corners(path, world, radius), world, radius)
    return path


def check_region(world: World, name: str, region: Region, radius: float) -> None:
    """Raise WorldError unless a disc is free everywhere in a region."""
    free = point_clearance(np.array([[region.x, region.y]]), world)[0]
    if free < radius + region.radius - PATH_SLACK:
        raise WorldError(
            f"{_prefix(world)}the {name} ({region.x:g}, {region.y:g}) lies {max(free, 0.0):.2f} m "
            f"from an obstacle, a footprint of radius {radius:.2f} m needs "
            f"{radius + region.radius:.2f} m"
        )


def check_path(world: World, radius: float) -> None:
    """Raise WorldError if a disc of this radius [m] can't follow the world's own path."""
    path = np.zeros((0, 2)) if world.path is None else world.path
    if len(path) < 2:
        raise WorldError(f"{_prefix(world)}the path must have at least two points")
    free = float(segment_clearance(path[:-1], path[1:], world).min())
    if free < radius - PATH_SLACK:
        raise WorldError(
            f"{_prefix(world)}the path passes {max(free, 0.0):.2f} m from an obstacle, a footprint "
            f"of radius {radius:.2f} m needs {radius:.2f} m"
        )


def remaining_distance(world: World, radius: float, place: Region, goal: Region) -> float:
    """Length of a shortest path to the goal [m], for a robot that may have collided.

    Returns:
        The length, inf if there is no path.
    """
    ends = np.array([[place.x, place.y], [goal.x, goal.y]])
    # A robot that has collided is nearer to an obstacle than its radius: take what fits.
    fitting = min(radius, *(point_clearance(ends, world) - PATH_SLACK).tolist())
    try:
        return path_length(shortest_path(world, max(fitting, 0.0), place, goal))
    except WorldError:
        return math.inf


def _prefix(world: World) -> str:
    """The world's name as the start of a message."""
    return f"{world.name}: " if world.name else ""


def _search_path(world: World, radius: float, ends: Floats) -> Floats | None:
    """Find a shortest path over cells, (points, 2), or None if there is none.

    In a large world, only the area around the ends is searched first, and then as much as may
    contain a shorter path: all paths of length L between ends D apart lie within
    sqrt(L^2 - D^2) / 2 of the box around the ends.
    """
    # Farther than this from the ends there is nothing to search.
    box = bounds_with(world, ends)
    farthest = max(*(ends.min(axis=0) - box[0]), *(box[1] - ends.max(axis=0)))
    distance = math.dist(*ends)
    is_large = np.ptp(box, axis=0).prod() > MAX_CELLS * CELL_SIDE**2
    reach = max(LEAST_REACH, distance) if is_large else math.inf

    while True:
        grid = free_cells(world, radius, ends, reach)
        # Ends of a path lie anywhere in their cells.
        first, last = (_entry_cell(grid, end, world, radius) for end in ends)
        way = search_cells(grid, first, last)
        path = None
        needed = math.inf
        if way is not None:
            path = np.concatenate([ends[:1], grid.centres(way), ends[1:]])
            needed = math.sqrt(max(path_length(path) ** 2 - distance**2, 0.0)) / 2.0
        if reach >= min(farthest, needed):
            return path
        # Step by step: cells of a grid of the whole world may be too large for its doors.
        reach = REACH_FACTOR * reach if path is None else needed


def _entry_cell(grid: Grid, end: Floats, world: World, radius: float) -> int:
    """The nearest free cell that can be reached in a straight line from an end of the path.

    The end's own cell if there is none. The path may be a little too near to an obstacle then.
    """
    number = grid.cell(*end.tolist())
    row, column = divmod(number, grid.free.shape[1])
    near = np.zeros_like(grid.free)
    rows = slice(max(row - ENTRY_CELLS, 0), row + ENTRY_CELLS + 1)
    near[rows, max(column - ENTRY_CELLS, 0) : column + ENTRY_CELLS + 1] = True
    cells = np.flatnonzero(near & grid.free)

    centres = grid.centres(cells)

    # Cells are coarse: only those in sight of the end count as its neighbours.
    clear = segment_clearance(np.broadcast_to(end, centres.shape), centres, world)
    reachable = clear >= radius - PATH_SLACK
    if not reachable.any():
        grid.free.flat[number] = True
        return number
    distances = np.hypot(*(centres - end).T)
    return int(cells[np.where(reachable, distances, np.inf).argmin()])


def _cut_corners(path: Floats, world: World, radius: float) -> Floats:
    """Cut off the corners of a path as far as obstacles allow it."""
    # Vectors from each corner to the points before and behind it.
    corners = path[1:-1]
    ahead = path[:-2] - corners
    behind = path[2:] - corners
    share = np.zeros((len(corners), 1))
    for step in 0.25 * 0.5 ** np.arange(CUT_BISECTIONS):
        # Each corner keeps the largest cut that is free, found by halving the step.
        starts = corners + (share + step) * ahead
        ends = corners + (share + step) * behind
        share[segment_clearance(starts, ends, world) >= radius - PATH_SLACK / 2.0] += step
    cut = np.stack([corners + share * ahead, corners + share * behind], axis=1)
    return np.concatenate([path[:1], cut.reshape(-1, 2), path[-1:]])


def _straighten(path: Floats, world: World, radius: float) -> Floats:
    """Remove points of a path that a straight line can replace."""
    points = np.ascontiguousarray(path)
    return path[_find_corners(points, world.circles, world.segments, radius - PATH_SLACK)]


@loop
def _find_corners(path: Floats, circles: Floats, segments: Floats, radius: float) -> list[int]:
    """Numbers of the points of a path that remain."""
    corners = [0]
    while corners[-1] < len(path) - 1:
        start = path[corners[-1]]
        farthest = corners[-1] + 1
        # As far as a straight line is free. Behind the first obstacle it isn't looked further.
        for end in path[farthest + 1 :]:
            line = (start[X], start[Y], end[X], end[Y])
            if not is_free(line, circles, segments, radius):
                break
            farthest += 1
        corners.append(farthest)
    return corners


def world_along(path: Floats) -> World:
    """Make an empty world with a path to follow. The robot starts on it, heading along it."""
    world = World(path=path)
    if world.path is None or len(world.path) < 2 or not world.length > 0.0:
        raise WorldError("path: must have at least two points (x, y) [m], not all the same")
    points = drop_repeated(world.path)
    x, y = points[0].tolist()
    dx, dy = (points[1] - points[0]).tolist()
    start = Region(x, y, theta=math.atan2(dy, dx))
    return World(start=start, goal=Region(*points[-1].tolist()), path=points)


def align_with_path(world: World) -> World:
    """Move a world's start and goal to the ends of its path. The start's heading is along it."""
    if world.path is None:
        raise WorldError(f"{world.name or 'the world'}: has no path to follow")
    ends = world_along(world.path)
    return replace(world, start=ends.start, goal=ends.goal, path=ends.path)


def drop_repeated(path: Floats) -> Floats:
    """Remove points of a path that repeat the point before them."""
    moved = np.diff(path, axis=0).any(axis=1)
    distinct: Floats = path[np.concatenate([[True], moved])]
    return distinct


def sample_path(path: Floats, spacing: float = PATH_SPACING) -> Floats:
    """Sample a path at even distances, its end included.

    Returns:
        (samples, 3): x [m], y [m] and direction [rad] of the line that follows, at
        the end that of the last line.
    """
    path = drop_repeated(path)
    steps = np.diff(path, axis=0)
    lengths = np.hypot(*steps.T)
    # Distances of the path's points from its start.
    marks = np.concatenate([[0.0], np.cumsum(lengths)])
    count = max(2, 1 + math.ceil(marks[-1] / spacing - 1e-9))
    s = np.linspace(0.0, marks[-1], count)
    # Each sample lies on the line that starts at or before it.
    piece = np.clip(np.searchsorted(marks, s, side="right") - 1, 0, len(steps) - 1)
    share = (s - marks[piece]) / lengths[piece]
    points = path[piece] + share[:, None] * steps[piece]
    return np.column_stack([points, np.arctan2(*steps[piece].T[::-1])])
