"""A grid of cells in which a disc's centre may be, and shortest paths over it, by scipy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import require_extra
from acsar_gym.worlds.world import Floats, World

CELL_SIDE = 0.05
"""Side of a cell [m]."""
MAX_CELLS = 1_000_000
"""Most cells of a search: 2,500 m^2. Larger areas get larger cells."""
MAX_DISTANCES = 200_000_000
"""Most distances from cells to obstacles; where long obstacles need more, cells are larger."""
PATH_SLACK = 1e-3
"""How much nearer than the clearance a path may be to an obstacle between two cells [m]."""
WALL_SHARE = 0.75
"""Cells nearer to an obstacle than this share of their side are never free."""


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of a world in which a disc's centre may be."""

    free: NDArray[np.bool_]
    """(nx, ny): whether the disc's centre may be in the cell."""
    x: float
    """x of the centre of cell (0, 0) [m]."""
    y: float
    """y of the centre of cell (0, 0) [m]."""
    side: float
    """Side of a cell [m]."""

    def cell(self, x: float, y: float) -> int:
        """Number of the cell that contains a point."""
        i, j = round((x - self.x) / self.side), round((y - self.y) / self.side)
        return i * int(self.free.shape[1]) + j

    def centres(self, cells: NDArray[np.int64]) -> Floats:
        """(cells, 2): centres of cells [m]."""
        i, j = np.divmod(cells, self.free.shape[1])
        return np.column_stack([self.x + i * self.side, self.y + j * self.side])


def bounds_with(world: World, ends: Floats) -> Floats:
    """Least x and y, largest x and y of what stands and the ends of a path [m]."""
    low, high = world.standing_bounds[:2], world.standing_bounds[2:]
    return np.concatenate([np.minimum(low, ends.min(axis=0)), np.maximum(high, ends.max(axis=0))])


def _margin(radius: float) -> float:
    """Width that is added on each side of a box [m]."""
    return 2.0 * radius + 4.0 * CELL_SIDE


def count_cells(box: Floats, radius: float, side: float) -> float:
    """How many cells of a side [m] a box (least x, y, largest x, y) needs with its margins."""
    width, height = (box[2:] - box[:2] + 2.0 * _margin(radius)).tolist()
    return float(width * height / side**2)


def crop_world(world: World, box: Floats) -> World:
    """The world with only those obstacles whose bounding boxes overlap this box."""
    centres, radii = world.circles[:, :2], world.circles[:, 2:]
    low = np.minimum(world.segments[:, :2], world.segments[:, 2:])
    high = np.maximum(world.segments[:, :2], world.segments[:, 2:])
    circles = ((centres + radii >= box[:2]) & (centres - radii <= box[2:])).all(axis=1)
    segments = ((high >= box[:2]) & (low <= box[2:])).all(axis=1)
    return World(world.circles[circles], world.segments[segments])


def free_cells(
    world: World, radius: float, ends: Floats | None = None, reach: float = math.inf
) -> Grid:
    """Make the grid of cells whose centre is at least `radius` away from every obstacle.

    No wall fits between two neighbouring cells.
    """
    box, margin = np.array(world.standing_bounds), _margin(radius)
    if ends is not None:
        box = bounds_with(world, ends)
        if math.isfinite(reach):
            box[:2] = np.maximum(box[:2], ends.min(axis=0) - reach)
            box[2:] = np.minimum(box[2:], ends.max(axis=0) + reach)
            world = crop_world(world, np.concatenate([box[:2] - margin, box[2:] + margin]))
    left, low = (box[:2] - margin).tolist()
    width, height = (box[2:] - box[:2] + 2.0 * margin).tolist()
    circles, segments = world.circles, world.segments
    sizes = [np.repeat(2.0 * circles[:, 2:], 2, axis=1), np.abs(segments[:, 2:] - segments[:, :2])]
    boxes = np.minimum(np.concatenate(sizes) + 2.0 * radius, (width, height))
    side = CELL_SIDE * max(
        1.0,
        math.sqrt(width * height / MAX_CELLS) / CELL_SIDE,
        math.sqrt(float(boxes.prod(axis=1).sum()) / MAX_DISTANCES) / CELL_SIDE,
    )
    x, y = (math.floor(least / side) + 0.5 for least in (left, low))
    free = np.ones((math.ceil(width / side) + 1, math.ceil(height / side) + 1), np.bool_)
    grid = Grid(free, x * side, y * side, side)
    radius = max(radius, WALL_SHARE * side)
    for cx, cy, r in circles.tolist():
        _block_cells(grid, (cx, cy, cx, cy), r + radius)
    for line in segments.tolist():
        _block_cells(grid, line, radius)
    return grid


def _block_cells(grid: Grid, line: tuple[float, float, float, float], radius: float) -> None:
    """Mark the cells nearer than `radius` to a line as not free."""
    x1, y1, x2, y2 = line
    reach = radius - PATH_SLACK / 2.0
    low_i = max(math.ceil((min(x1, x2) - reach - grid.x) / grid.side), 0)
    low_j = max(math.ceil((min(y1, y2) - reach - grid.y) / grid.side), 0)
    high_i = min(math.floor((max(x1, x2) + reach - grid.x) / grid.side) + 1, grid.free.shape[0])
    high_j = min(math.floor((max(y1, y2) + reach - grid.y) / grid.side) + 1, grid.free.shape[1])
    dx = grid.x + grid.side * np.arange(low_i, max(high_i, low_i))[:, None] - x1
    dy = grid.y + grid.side * np.arange(low_j, max(high_j, low_j))[None, :] - y1
    ex, ey = x2 - x1, y2 - y1
    square = ex * ex + ey * ey
    share = np.clip((dx * ex + dy * ey) / square, 0.0, 1.0) if square > 0.0 else 0.0
    near = (dx - share * ex) ** 2 + (dy - share * ey) ** 2 < reach * reach
    grid.free[low_i:high_i, low_j:high_j] &= ~near


def search_cells(grid: Grid, start: int, goal: int) -> NDArray[np.int64] | None:
    """Find the cells of a shortest path between two cells; None where there is none.

    Neighbours are the eight cells around a cell; diagonals don't cut corners.
    """
    with require_extra("a world with obstacles", "scipy"):
        from scipy.sparse import csr_array  # noqa: PLC0415 - slow to import
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

    free = grid.free
    # Before 1.15, scipy's searches refuse indices of 64 bits.
    number = np.arange(free.size, dtype=np.int32).reshape(free.shape)
    ahead, side = free[:-1] & free[1:], free[:, :-1] & free[:, 1:]
    square = ahead[:, :-1] & ahead[:, 1:]
    pairs = (
        (number[:-1][ahead], number[1:][ahead], 1.0),
        (number[:, :-1][side], number[:, 1:][side], 1.0),
        (number[:-1, :-1][square], number[1:, 1:][square], math.sqrt(2.0)),
        (number[1:, :-1][square], number[:-1, 1:][square], math.sqrt(2.0)),
    )
    rows, columns = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    costs = np.concatenate([np.full(len(one), cost * grid.side) for one, _, cost in pairs])
    graph = csr_array((costs, (rows, columns)), shape=(free.size, free.size))
    search_from: Any = dijkstra  # its stubs know no single start
    _, before = search_from(graph, directed=False, indices=start, return_predecessors=True)
    if start != goal and before[goal] < 0:
        return None
    way = [goal]
    while way[-1] != start:
        way.append(int(before[way[-1]]))
    return np.array(way[::-1])


def may_leave(grid: Grid, start: int, goal: int) -> bool:
    """Whether a path between two cells may lead through the area outside the grid."""
    with require_extra("a world with obstacles", "scipy"):
        from scipy.ndimage import label  # noqa: PLC0415 - slow to import

    parts = label(grid.free, np.ones((3, 3)))[0]
    edges = np.concatenate([parts[0], parts[-1], parts[:, 0], parts[:, -1]])
    return bool(np.isin(parts.flat[[start, goal]], edges).all())
