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
"""Most distances from cells to obstacles. If long obstacles need more, cells are larger."""
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
        row = round((x - self.x) / self.side)
        column = round((y - self.y) / self.side)
        return row * int(self.free.shape[1]) + column

    def centres(self, cells: NDArray[np.int64]) -> Floats:
        """(cells, 2): centres of cells [m]."""
        rows, columns = np.divmod(cells, self.free.shape[1])
        return np.column_stack([self.x + rows * self.side, self.y + columns * self.side])

    def block(self, line: list[float], reach: float) -> None:
        """Mark the cells whose centres are nearer than `reach` to a line x1, y1, x2, y2 [m]."""
        x1, y1, x2, y2 = line
        rows = _span(min(x1, x2) - reach, max(x1, x2) + reach, self.x, self.side)
        columns = _span(min(y1, y2) - reach, max(y1, y2) + reach, self.y, self.side)
        box = self.free[rows, columns]

        row, column = np.ogrid[: box.shape[0], : box.shape[1]]
        dx = self.x + self.side * (row + rows.start) - x1
        dy = self.y + self.side * (column + columns.start) - y1
        length_x = x2 - x1
        length_y = y2 - y1
        square = length_x * length_x + length_y * length_y
        along = dx * length_x + dy * length_y
        share = np.clip(along / square, 0.0, 1.0) if square > 0.0 else 0.0
        box[(dx - share * length_x) ** 2 + (dy - share * length_y) ** 2 < reach * reach] = False


def _span(low: float, high: float, first: float, side: float) -> slice:
    """Indices of the cells between two coordinates, for cells from a first one on."""
    start = math.ceil((low - first) / side)
    stop = math.floor((high - first) / side) + 1
    return slice(max(start, 0), max(stop, 0))


def bounds_with(world: World, points: Floats) -> Floats:
    """Lower left and upper right corner, (2, 2), of what stands and of some points [m]."""
    every = np.concatenate([np.reshape(world.standing_bounds, (2, 2)), points])
    return np.array([every.min(axis=0), every.max(axis=0)])


def _margin(radius: float) -> float:
    """Width that is added on each side of a box [m]."""
    return 2.0 * radius + 4.0 * CELL_SIDE


def count_cells(box: Floats, radius: float) -> float:
    """How many cells a box (2, 2) needs with its margins."""
    width, height = (box[1] - box[0] + 2.0 * _margin(radius)).tolist()
    return float(width * height / CELL_SIDE**2)


def crop_world(world: World, box: Floats) -> World:
    """The world with only those obstacles whose bounding boxes overlap this box (2, 2)."""
    centres, radii = world.circles[:, :2], world.circles[:, 2:]
    ends = world.segments.reshape(-1, 2, 2)
    circles = (centres + radii >= box[0]) & (centres - radii <= box[1])
    segments = (ends.max(axis=1) >= box[0]) & (ends.min(axis=1) <= box[1])
    return World(world.circles[circles.all(axis=1)], world.segments[segments.all(axis=1)])


def free_cells(
    world: World, radius: float, ends: Floats | None = None, reach: float = math.inf
) -> Grid:
    """Make the grid of cells whose centre is at least `radius` away from every obstacle.

    No wall fits between two neighbouring cells.

    Args:
        world: World with the obstacles.
        radius: Radius of the disc [m].
        ends: Points (points, 2) that the grid contains as well [m].
        reach: Distance from these points up to which there are cells [m].
    """
    margin = _margin(radius)
    box = bounds_with(world, np.zeros((0, 2)) if ends is None else ends)
    if ends is not None and math.isfinite(reach):
        box[0] = np.maximum(box[0], ends.min(axis=0) - reach)
        box[1] = np.minimum(box[1], ends.max(axis=0) + reach)
        world = crop_world(world, box + np.array([[-margin], [margin]]))

    # A circle is a line without length.
    lines = np.concatenate([world.circles[:, [0, 1, 0, 1]], world.segments])
    radii = np.concatenate([world.circles[:, 2], np.zeros(len(world.segments))])
    size = box[1] - box[0] + 2.0 * margin
    boxes = np.abs(lines[:, 2:] - lines[:, :2]) + 2.0 * radii[:, None] + 2.0 * radius
    distances = float(np.minimum(boxes, size).prod(axis=1).sum())
    side = CELL_SIDE * max(
        1.0,
        math.sqrt(size.prod() / MAX_CELLS) / CELL_SIDE,
        math.sqrt(distances / MAX_DISTANCES) / CELL_SIDE,
    )

    x, y = (np.floor((box[0] - margin) / side) + 0.5).tolist()
    free = np.ones(np.ceil(size / side).astype(np.int64) + 1, np.bool_)
    grid = Grid(free, x * side, y * side, side)
    radius = max(radius, WALL_SHARE * side)
    for line, thickness in zip(lines.tolist(), radii.tolist(), strict=True):
        grid.block(line, thickness + radius - PATH_SLACK / 2.0)
    return grid


def search_cells(grid: Grid, start: int, goal: int) -> NDArray[np.int64] | None:
    """Find the cells of a shortest path between two cells; None if there is none.

    Neighbours are the eight cells around a cell; diagonals don't cut corners.
    """
    with require_extra("a world with obstacles", "scipy"):
        from scipy.sparse import csr_array  # noqa: PLC0415 - slow to import
        from scipy.sparse.csgraph import dijkstra  # noqa: PLC0415

    free = grid.free
    # Before 1.15, scipy's searches refuse indices of 64 bits.
    number = np.arange(free.size, dtype=np.int32).reshape(free.shape)
    ahead = free[:-1] & free[1:]
    aside = free[:, :-1] & free[:, 1:]
    square = ahead[:, :-1] & ahead[:, 1:]
    diagonal = math.sqrt(2.0) * grid.side
    steps = [
        (number[:-1][ahead], number[1:][ahead], grid.side),
        (number[:, :-1][aside], number[:, 1:][aside], grid.side),
        (number[:-1, :-1][square], number[1:, 1:][square], diagonal),
        (number[1:, :-1][square], number[:-1, 1:][square], diagonal),
    ]
    columns = zip(*(np.broadcast_arrays(*step) for step in steps), strict=True)
    origins, targets, lengths = map(np.concatenate, columns)
    graph = csr_array((lengths, (origins, targets)), shape=(free.size, free.size))

    search_from: Any = dijkstra  # its stubs know no single start
    _, previous = search_from(graph, directed=False, indices=start, return_predecessors=True)
    if start != goal and previous[goal] < 0:
        return None
    way = [goal]
    while way[-1] != start:
        way.append(int(previous[way[-1]]))
    return np.array(way[::-1])


def may_leave(grid: Grid, start: int, goal: int) -> bool:
    """Whether a path between two cells may lead through the area outside the grid."""
    with require_extra("a world with obstacles", "scipy"):
        from scipy.ndimage import label  # noqa: PLC0415 - slow to import

    regions, _ = label(grid.free, np.ones((3, 3)))
    edges = np.concatenate([regions[0], regions[-1], regions[:, 0], regions[:, -1]])
    return bool(np.isin(regions.flat[[start, goal]], edges).all())
