"""The search over cells: coarse worlds, walls, and ways by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from samples import samples
from search_tools import CUT, PILLAR, ROUGHLY, around, array, between, closest, random_world

from acsar_gym.errors import WorldError
from acsar_gym.worlds import grid as cells_of
from acsar_gym.worlds.geometry import point_clearance
from acsar_gym.worlds.grid import CELL_SIDE, PATH_SLACK, Grid, free_cells
from acsar_gym.worlds.search import (
    path_length,
    shortest_path,
)
from acsar_gym.worlds.world import World


@pytest.mark.parametrize("radius", [0.05, 0.024])
def test_no_footprint_goes_through_a_wall(radius: float) -> None:
    path = shortest_path(between((-3, 0), (3, 0), (), array([0.0, -1.0, 0.0, 1.0])), radius)
    assert path_length(path) >= 2.0 * math.hypot(3.0, 1.0) - 1e-9


LARGE = array([-500.0, 0.0, -499.0, 0.0], [499.0, 0.0, 500.0, 0.0])
"""What makes a world 1 km wide."""


@pytest.mark.parametrize("radius", [0.0, 0.25, 5.0])
def test_huge_worlds_are_searched_coarsely(radius: float) -> None:
    square = np.concatenate([LARGE, LARGE[:, [1, 0, 3, 2]]])
    for world, metres in (
        (World(segments=square), 1e3),
        (World(circles=array([1e4, 1e4, 1e4], [-1e4, -1e4, 1e4])), 4e4),
    ):
        grid = free_cells(world, radius)
        assert 0.9 * cells_of.MAX_CELLS < grid.free.size < 1.02 * cells_of.MAX_CELLS
        assert grid.side == pytest.approx(metres / 1000.0, rel=0.1)
    small = free_cells(World(circles=PILLAR), 0.25)
    assert small.side == CELL_SIDE
    assert small.free.size < 5_000


def test_in_a_coarse_world_a_wide_footprint_finds_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells_of, "MAX_CELLS", 40_000)  # 5 m each, as for 10 km
    segments = np.concatenate([LARGE, LARGE[:, [1, 0, 3, 2]], array([0.0, -400.0, 0.0, 100.0])])
    world = between((-200, 0), (200, 0), (), segments)
    path = shortest_path(world, 20.0)
    by_hand = around((-200, 0), (200, 0), (0.0, 100.0), 20.0, reflex=True)
    assert 1.0 - CUT < path_length(path) / by_hand < ROUGHLY
    assert closest(path, world) > 20.0 - 0.2


def test_in_a_coarse_world_walls_are_walls_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cells_of, "MAX_CELLS", 40_000)
    segments = np.concatenate([LARGE, LARGE[:, [1, 0, 3, 2]], array([0.1, -400.0, 0.1, 100.0])])
    world = between((-200, 0), (200, 0), (), segments)
    try:
        path = shortest_path(world, 0.25)
    except WorldError:
        return
    assert path_length(path) > 2.0 * math.hypot(200.0, 100.0) - 1.0


@samples(3, 10)
def test_free_cells_are_those_of_exact_distances(count: int) -> None:
    for seed in range(count):
        world, radius = random_world(seed, 0.2), 0.1 + 0.05 * seed
        grid = free_cells(world, radius)
        numbers = np.arange(grid.free.size)
        centres = grid.centres(numbers)
        exact = point_clearance(centres, world)
        sure = np.abs(exact - radius) > PATH_SLACK
        assert np.array_equal(grid.free.ravel()[sure], exact[sure] > radius)
        assert [grid.cell(x, y) for x, y in centres[::97].tolist()] == numbers[::97].tolist()
        left, low, right, high = world.bounds
        room_left = 2.0 * radius
        assert (centres.min(axis=0) <= (left - room_left, low - room_left)).all()
        assert (centres.max(axis=0) >= (right + room_left, high + room_left)).all()


def drawing(*lines: str) -> Grid:
    free = np.array([[mark != "#" for mark in line] for line in lines])
    return Grid(free, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("lines", "start", "goal", "length"),
    [
        (("...", "...", "..."), (0, 0), (2, 2), 2.0 * math.sqrt(2.0)),
        (("...", "...", "..."), (2, 0), (0, 2), 2.0 * math.sqrt(2.0)),
        (("....",), (0, 3), (0, 0), 3.0),
        ((".#", ".."), (0, 0), (1, 1), 2.0),  # no corner is cut
        (("..", ".#"), (1, 0), (0, 1), 2.0),
        ((".#", "#."), (0, 0), (1, 1), math.inf),
        (("...", ".#.", "..."), (0, 0), (2, 2), 4.0),
        (("..#..", "....."), (0, 0), (0, 4), 2.0 + 2.0 * math.sqrt(2.0)),
        ((".", "#", "."), (0, 0), (2, 0), math.inf),
        ((".",), (0, 0), (0, 0), 0.0),
    ],
)
def test_ways_over_cells_are_those_by_hand(
    lines: Any, start: Any, goal: Any, length: float
) -> None:
    grid = drawing(*lines)
    width = grid.free.shape[1]
    first, last = (i * width + j for i, j in (start, goal))
    cells = cells_of.search_cells(grid, first, last)
    if math.isinf(length):
        assert cells is None
        return
    assert cells is not None
    assert (cells[0], cells[-1]) == (first, last)
    assert grid.free.ravel()[cells].all()
    assert path_length(grid.centres(cells)) == pytest.approx(length)


def slowly(free: Any, start: int, goal: int) -> float:
    """Dijkstra's algorithm without a heap."""
    count, width = free.size, free.shape[1]
    lengths = {start: 0.0}
    done: set[int] = set()
    while open_cells := set(lengths) - done:
        here = min(open_cells, key=lambda cell: lengths[cell])
        done.add(here)
        i, j = divmod(here, width)
        for k in range(count):
            di, dj = k // width - i, k % width - j
            square = free[min(i, i + di) : max(i, i + di) + 1, min(j, j + dj) : max(j, j + dj) + 1]
            if max(abs(di), abs(dj)) == 1 and square.all():
                length = lengths[here] + math.hypot(di, dj)
                lengths[k] = min(lengths.get(k, math.inf), length)
    return lengths.get(goal, math.inf)


@samples(15, 60)
def test_ways_over_cells_are_those_of_a_slow_search(count: int) -> None:
    rng = np.random.default_rng(2)
    blocked = 0
    for _ in range(count):
        free = rng.random((7, 8)) < 0.75
        first, last = rng.choice(np.flatnonzero(free), 2, replace=False).tolist()
        grid = Grid(free, 0.3, -0.7, 0.05)
        cells = cells_of.search_cells(grid, first, last)
        length = math.inf if cells is None else path_length(grid.centres(cells)) / grid.side
        assert length == pytest.approx(slowly(free, first, last))
        blocked += cells is None
    assert 0 < blocked < 0.8 * count
