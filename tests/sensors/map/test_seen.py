"""The grid of what a robot has seen: its window, its counts and its costs."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym.lidar.scan import Rays
from acsar_gym.sensors.map.seen import (
    CELLS,
    COST_LETHAL,
    COST_UNIT,
    COUNT_FREE,
    HALF,
    MISS,
    OCCUPIED,
    SHARED_RAYS,
    Grid,
    add_scan,
    cell_at,
    cell_centre,
    make_stamp,
    move_window,
    place_scan,
)

SIDE = 0.05
FARTHEST = 4.0
"""Side of a cell, and range of the LiDAR, which sees beyond the window [m]."""
STAMP = make_stamp(0.12, 0.2)
Cell = tuple[int, int]


def make_grid(middle: Cell = (0, 0)) -> Grid:
    """An empty grid around a cell."""
    counts, costs = np.zeros((2, CELLS, CELLS), np.uint8)
    return Grid(counts, costs, STAMP, SIDE, first_i=middle[0] - HALF, first_j=middle[1] - HALF)


def element(cell: Cell) -> Cell:
    return cell[0] % CELLS, cell[1] % CELLS


@pytest.mark.parametrize("start", [(0, 0), (-371, 444)])
@pytest.mark.parametrize("move", [(1, -3), (-100, 60), (20, 140)])
def test_window_that_moves_forgets_what_leaves_it_and_nothing_else(start: Cell, move: Cell) -> None:
    cells = np.random.default_rng(0).integers(1, 200, (2, CELLS, CELLS)).astype(np.uint8)
    grid = make_grid((start[0] + move[0], start[1] + move[1]))
    grid.counts[:], grid.costs[:] = cells
    move_window(grid, start[0] - HALF, start[1] - HALF)
    i = grid.first_i + (np.arange(CELLS) - grid.first_i) % CELLS
    j = grid.first_j + (np.arange(CELLS) - grid.first_j) % CELLS
    stays_i = (i >= start[0] - HALF) & (i < start[0] + HALF)
    stays_j = (j >= start[1] - HALF) & (j < start[1] + HALF)
    expected = np.where(stays_i[:, None] & stays_j, cells, 0)
    np.testing.assert_array_equal([grid.counts, grid.costs], expected)


def see_ahead(grid: Grid, distance: float, turn: int) -> Cell:
    """Add a scan of a single ray ahead, and return the cell in which it ends."""
    x = cell_centre(grid.first_i + HALF, SIDE)
    rays = Rays(0.0, 0.1, 0.05, farthest=FARTHEST, mount_x=0.0, mount_y=0.0, period=0.01)
    measured = np.zeros(0), np.zeros(1), 0.0  # nothing moves
    pose = (x, 0.0, 0.0)
    scan = place_scan(pose, np.array([distance]), rays, measured=measured, now=0.0)
    add_scan(grid, scan, turn)
    return element((cell_at(x + distance, SIDE), cell_at(0.0, SIDE)))


@pytest.mark.parametrize(
    ("middle", "scans", "count", "occupied"),
    [(0, 1, 4, False), (-146, 2, 7, True), (240, 9, 10, True)],
)
def test_cell_is_occupied_where_measurements_end(
    middle: int, scans: int, count: int, occupied: bool
) -> None:
    grid = make_grid((middle, 0))
    for _ in range(scans):
        cell = see_ahead(grid, 1.0, turn=1)
    assert grid.counts[cell] == count + OCCUPIED * occupied
    assert np.count_nonzero(grid.counts) == 1
    assert grid.costs[cell] == (COST_LETHAL / COST_UNIT if occupied else 0)


def test_cell_is_free_again_once_enough_measurements_have_passed_through() -> None:
    grid = make_grid()
    for _ in range(9):
        cell = see_ahead(grid, 1.0, turn=1)
    count = int(grid.counts[cell]) - OCCUPIED
    while count > COUNT_FREE:
        for turn in range(SHARED_RAYS):  # the ray clears cells in a single turn of these
            see_ahead(grid, FARTHEST, turn)
        count = max(count - MISS, COUNT_FREE)
        assert grid.counts[cell] == count + OCCUPIED * (count > COUNT_FREE)
    assert not grid.costs.any()
    assert grid.counts.max() == COUNT_FREE
