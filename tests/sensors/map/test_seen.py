"""The grid of what a robot has seen: its window, its counts and its costs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsar_gym.lidar.scan import Rays
from acsar_gym.sensors.map.seen import (
    CELLS,
    COST_LETHAL,
    COST_UNIT,
    COUNT_FREE,
    COUNT_MOST,
    COUNT_OCCUPIED,
    MISS,
    OCCUPIED,
    SHARED_RAYS,
    Grid,
    add_scan,
    cell_at,
    cell_centre,
    make_stamp,
    move_window,
    raise_costs,
)

SIDE, FARTHEST = 0.05, 4.0
"""Of a cell, and of the LiDAR: it sees beyond the window [m]."""
STAMP = make_stamp(0.12, 0.2)
HALF = CELLS // 2
CELL = st.integers(-500, 500)


def empty() -> Grid:
    return Grid(*(np.zeros((CELLS, CELLS), np.uint8) for _ in range(2)))


def in_window(cell: tuple[int, int], middle: tuple[int, int]) -> bool:
    return all(-HALF <= a - b < HALF for a, b in zip(cell, middle, strict=True))


def place(cell: tuple[int, int]) -> tuple[int, int]:
    return cell[0] % CELLS, cell[1] % CELLS


@given(
    begin=st.tuples(CELL, CELL),
    moves=st.lists(st.tuples(st.integers(-140, 140), st.integers(-140, 140)), max_size=4),
    small=st.lists(st.tuples(st.integers(-2, 2), st.integers(-2, 2)), max_size=4),
)
@settings(max_examples=40, deadline=None)
def test_a_window_that_moves_forgets_what_leaves_it_and_nothing_else(
    begin: tuple[int, int], moves: list[tuple[int, int]], small: list[tuple[int, int]]
) -> None:
    grid, middle, rng = empty(), begin, np.random.default_rng(0)
    kept: dict[tuple[int, int], int] = {}
    for move in [(0, 0), *moves, *small]:
        to = middle[0] + move[0], middle[1] + move[1]
        move_window(grid, *middle, *to)
        middle, kept = to, {cell: value for cell, value in kept.items() if in_window(cell, to)}
        wanted = np.zeros((CELLS, CELLS), np.uint8)
        for cell, value in kept.items():
            wanted[place(cell)] = value
        for cells in grid:
            np.testing.assert_array_equal(cells, wanted)
        for offset in rng.integers(-HALF, HALF, (30, 2)).tolist():
            cell = middle[0] + offset[0], middle[1] + offset[1]
            kept[cell] = int(rng.integers(1, 200))
            for cells in grid:
                cells[place(cell)] = kept[cell]


def see(grid: Grid, pose: Any, middle: Any, ranges: Any, rays: Rays, turn: int) -> None:
    """Add a scan in which nothing moves."""
    nothing = np.zeros(len(ranges), np.uint8)
    add_scan(grid, STAMP, SIDE, pose, middle, ranges, rays, turn, nothing)


def ahead(distance: float, turn: int, grid: Grid, *, x: float = 0.0) -> tuple[int, int]:
    """Add a scan of one ray ahead, and return the cell in which it ends."""
    rays = Rays(0.0, 0.1, 0.05, FARTHEST, 0.0, 0.0, 0.01)
    middle = cell_at(x, SIDE), cell_at(0.0, SIDE)
    see(grid, (x, 0.0, 0.0), middle, np.array([distance]), rays, turn)
    return cell_at(x + distance, SIDE), cell_at(0.0, SIDE)


@pytest.mark.parametrize("x", [0.0, -7.3, 12.01])
@pytest.mark.parametrize(
    ("scans", "count", "occupied"), [(1, 4, False), (2, 7, True), (3, 10, True), (9, 10, True)]
)
def test_a_cell_is_occupied_where_measurements_end(
    x: float, scans: int, count: int, occupied: bool
) -> None:
    grid = empty()
    for _ in range(scans):
        cell = ahead(1.0, 1, grid, x=x)
    assert grid.counts[place(cell)] == count + OCCUPIED * occupied
    assert np.count_nonzero(grid.counts) == 1
    assert grid.costs[place(cell)] == (COST_LETHAL / COST_UNIT if occupied else 0)
    assert (count >= COUNT_OCCUPIED) == occupied
    assert count <= COUNT_MOST


@pytest.mark.parametrize("hits", [2, 9])
def test_a_cell_is_free_again_once_enough_measurements_have_passed_through(hits: int) -> None:
    grid = empty()
    for _ in range(hits):
        cell = ahead(1.0, 1, grid)
    count = int(grid.counts[place(cell)]) - OCCUPIED
    for left in (*range(count - MISS, COUNT_FREE, -MISS), COUNT_FREE):
        for other in range(1, SHARED_RAYS):  # another ray's turn
            ahead(FARTHEST, other, grid)
        ahead(FARTHEST, 0, grid)
        assert grid.counts[place(cell)] == left + OCCUPIED * (left > COUNT_FREE)
    assert not grid.costs.any()
    ahead(FARTHEST, 0, grid)
    assert grid.counts.max() == COUNT_FREE


def test_cells_count_where_the_lidar_is_and_how_the_robot_stands() -> None:
    grid, pose, mount = empty(), (1.3, -2.1, 2.0), (0.3, -0.2)
    rays = Rays(-0.5, 0.4, 0.05, FARTHEST, *mount, 0.01)
    ranges = np.array([0.9, 1.4, 1.1])
    middle = cell_at(pose[0], SIDE), cell_at(pose[1], SIDE)
    see(grid, pose, middle, ranges, rays, 1)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    wanted = set()
    for ray, distance in enumerate(ranges):
        angle = -0.5 + 0.4 * ray
        x, y = mount[0] + distance * math.cos(angle), mount[1] + distance * math.sin(angle)
        x, y = pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y
        wanted.add(place((cell_at(x, SIDE), cell_at(y, SIDE))))
    assert {tuple(cell) for cell in np.argwhere(grid.counts).tolist()} == wanted


@given(
    middle=st.tuples(CELL, CELL),
    seeds=st.lists(st.integers(0, 5), min_size=1, max_size=12),
    shift=st.floats(0.0, 0.049),
)
@settings(max_examples=15, deadline=None)
def test_costs_raised_and_lowered_are_those_made_from_scratch(
    middle: tuple[int, int], seeds: list[int], shift: float
) -> None:
    """Random scans, a few of them again and again, by a robot that turns on the spot."""
    grid = empty()
    x, y = (cell_centre(cell, SIDE) + 0.4 * shift for cell in middle)
    rays = Rays(-math.pi, math.tau / 24, 0.05, FARTHEST, 0.02, 0.01, 0.01)
    for turn, seed in enumerate(seed for seed in seeds for _ in range(4)):
        rng = np.random.default_rng(seed)
        ranges = np.where(rng.random(24) < 0.3, FARTHEST, rng.uniform(0.1, 3.6, 24))
        pose = (x, y, 0.1 * seed)
        see(grid, pose, middle, ranges, rays, turn)
    fresh = empty()
    for i in range(middle[0] - HALF, middle[0] + HALF):
        for j in range(middle[1] - HALF, middle[1] + HALF):
            if grid.counts[place((i, j))] >= OCCUPIED:
                raise_costs(fresh, STAMP, i, j, middle)
    np.testing.assert_array_equal(grid.costs, fresh.costs)
    occupied = grid.counts >= OCCUPIED
    assert (grid.counts[occupied] > OCCUPIED + COUNT_FREE).all()
    assert (grid.counts[~occupied] < COUNT_OCCUPIED).all()
