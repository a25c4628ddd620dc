"""A grid of cells in which a disc's centre may be, and shortest paths over it, by scipy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import require_extra
from acsar_gym.jit import loop
from acsar_gym.worlds.geometry import distance_to_segment, rays_between
from acsar_gym.worlds.world import AX, AY, BX, BY, RADIUS, Floats, World, X, Y

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
        return row * int(self.free.shape[1]) + round((y - self.y) / self.side)

    def centres(self, cells: NDArray[np.int64]) -> Floats:
        """(cells, 2): centres of cells [m]."""
        rows, columns = np.divmod(cells, self.free.shape[1])
        return np.column_stack([self.x + rows * self.side, self.y + columns * self.side])


def bounds_with(world: World, points: Floats) -> Floats:
    """Lower left and upper right corner, (2, 2), of what stands and of some points [m]."""
    corners = np.concatenate([np.reshape(world.standing_bounds, (2, 2)), points])
    return np.array([corners.min(axis=0), corners.max(axis=0)])


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
    margin = 2.0 * radius + 4.0 * CELL_SIDE
    ends = np.zeros((0, 2)) if ends is None else ends
    low, high = bounds_with(world, ends)
    if len(ends):
        low = np.maximum(low, ends.min(axis=0) - reach)
        high = np.minimum(high, ends.max(axis=0) + reach)
    size = high - low + 2.0 * margin

    # A circle is a line without length.
    lines = np.concatenate([world.circles[:, [X, Y, X, Y]], world.segments])
    radii = np.append(world.circles[:, RADIUS], np.zeros(len(world.segments)))
    boxes = np.abs(lines[:, 2:] - lines[:, :2]) + 2.0 * (radii + radius)[:, None]
    distances = np.minimum(boxes, size).prod(axis=1).sum()
    area = max(size.prod() / MAX_CELLS, distances / MAX_DISTANCES)  # of a cell
    side = max(CELL_SIDE, math.sqrt(area))

    x, y = ((np.floor((low - margin) / side) + 0.5) * side).tolist()
    free = np.ones(np.ceil(size / side).astype(np.int64) + 1, np.bool_)
    clearance = max(radius, WALL_SHARE * side) - PATH_SLACK / 2.0
    _block(free, (x, y), side, lines, radii + clearance)
    return Grid(free, x, y, side)


@loop
def _block(
    free: NDArray[np.bool_],
    corner: tuple[float, float],
    side: float,
    lines: Floats,
    reaches: Floats,
) -> None:
    """Mark the cells whose centres are nearer to a line than its reach [m] as not free."""
    x, y = corner
    for line, reach in zip(lines, reaches):  # noqa: B905 - for numba
        low = (min(line[AY], line[BY]) - reach - y) / side
        high = (max(line[AY], line[BY]) + reach - y) / side
        first = (min(line[AX], line[BX]) - reach - x) / side
        last = (max(line[AX], line[BX]) + reach - x) / side
        for row in rays_between(first, last, free.shape[0]):
            for column in rays_between(low, high, free.shape[1]):
                if distance_to_segment(x + side * row, y + side * column, line) < reach:
                    free[row, column] = False


def search_cells(grid: Grid, start: int, goal: int) -> NDArray[np.int64] | None:
    """Find the cells of a shortest path between two cells, or None if there is none.

    Neighbours are the eight cells around a cell. Diagonals don't cut corners.
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
    way = [goal]
    while way[-1] != start:
        way.append(int(previous[way[-1]]))
        if way[-1] < 0:
            return None
    return np.array(way[::-1])
