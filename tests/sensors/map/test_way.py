"""The way over the cells: the cheapest one, around what has been seen."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.sensors.map.seen import (
    CELLS,
    COST_LETHAL,
    COST_UNIT,
    OCCUPIED,
    Grid,
    cell_at,
    make_stamp,
    raise_costs,
)
from acsar_gym.sensors.map.way import (
    DIAGONAL,
    MOST_POINTS,
    SCRATCH,
    STRAIGHT,
    length_left,
    next_corner,
    octile,
    piece_cost,
    plan_way,
    search_way,
)

SIDE, HALF = 0.05, CELLS // 2
STAMP = make_stamp(0.12, 0.2)
LETHAL = COST_LETHAL / COST_UNIT
ORIGIN = cell_at(0.0, SIDE), cell_at(0.0, SIDE)


def walled(*walls: tuple[float, float, float, float]) -> Grid:
    """A grid around the origin in which walls have been seen, (ax, ay, bx, by) each [m]."""
    grid = Grid(*(np.zeros((CELLS, CELLS), np.uint8) for _ in range(2)))
    for ax, ay, bx, by in walls:
        for share in np.linspace(0.0, 1.0, 200):
            i, j = (cell_at(a + share * (b - a), SIDE) for a, b in ((ax, bx), (ay, by)))
            grid.counts[i % CELLS, j % CELLS] = OCCUPIED
            raise_costs(grid, STAMP, i, j, ORIGIN)
    return grid


def planned(grid: Grid, goal: tuple[float, float], place: tuple[float, float] = (0.0, 0.0)) -> Any:
    """The way's corners, (n, 4)."""
    points = np.zeros((MOST_POINTS, 4))
    middle = cell_at(place[0], SIDE), cell_at(place[1], SIDE)
    count = plan_way(grid, SIDE, middle, place, goal, points, np.zeros(SCRATCH, np.int32))
    return points[:count]


def step_cost(cost: int, diagonal: bool) -> int:
    return int(((DIAGONAL if diagonal else STRAIGHT) * (4 + cost)) >> 2)


def measure_all(costs: Any, middle: tuple[int, int]) -> Any:
    """(CELLS, CELLS): costs of the cheapest ways from the middle, by Dijkstra's algorithm; no way
    goes on from a cell at the window's edge."""
    graph = pytest.importorskip("scipy.sparse.csgraph")
    sparse = pytest.importorskip("scipy.sparse")
    rows: list[Any] = []
    columns: list[Any] = []
    weights: list[Any] = []
    first = middle[0] - HALF, middle[1] - HALF
    window = np.roll(costs, (-first[0], -first[1]), (0, 1)).astype(int)
    index = np.arange(CELLS * CELLS).reshape(CELLS, CELLS)
    inner = slice(1, CELLS - 1)
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            if di or dj:
                to = slice(1 + di, CELLS - 1 + di), slice(1 + dj, CELLS - 1 + dj)
                length = DIAGONAL if di and dj else STRAIGHT
                rows.append(index[inner, inner].ravel())
                columns.append(index[to].ravel())
                weights.append(((length * (4 + window[to])) >> 2).ravel())
    ends = np.concatenate(rows), np.concatenate(columns)
    matrix = sparse.csr_matrix((np.concatenate(weights).astype(float), ends), (CELLS**2,) * 2)
    return graph.dijkstra(matrix, indices=HALF * CELLS + HALF).reshape(CELLS, CELLS)


@pytest.mark.parametrize(
    ("seed", "middle", "offset"),
    [
        (0, (0, 0), (20, 3)),
        (3, (300, 2), (62, 0)),  # nearly at the edge
        (5, (-1, -1), (200, -40)),  # outside of the window
    ],
)
@pytest.mark.parametrize("dense", [0.05, 0.3])
def test_the_way_is_the_cheapest_one(
    seed: int, middle: tuple[int, int], offset: tuple[int, int], dense: float
) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.integers(0, 20, (CELLS, CELLS)).astype(np.uint8)
    costs[rng.random((CELLS, CELLS)) < dense] = int(LETHAL)
    scratch = np.zeros(SCRATCH, np.int32)
    goal = middle[0] + offset[0], middle[1] + offset[1]
    found = search_way(costs, middle, goal, scratch)
    way = scratch[:found].astype(int)[::-1]
    i, j = way // CELLS, way % CELLS
    assert (i[0], j[0]) == (HALF, HALF)
    first = middle[0] - HALF, middle[1] - HALF
    cost = 0
    for n in range(1, found):
        di, dj = abs(i[n] - i[n - 1]), abs(j[n] - j[n - 1])
        assert max(di, dj) == 1
        entered = int(costs[(i[n] + first[0]) % CELLS, (j[n] + first[1]) % CELLS])
        cost += step_cost(entered, bool(di and dj))
    least = measure_all(costs, middle)
    end = int(i[-1]), int(j[-1])
    assert cost == least[end]
    gi, gj = HALF + offset[0], HALF + offset[1]
    ends = [(p, q) for p in range(CELLS) for q in range(CELLS) if {p, q} & {0, CELLS - 1}]
    ends += [(gi, gj)] if 0 <= gi < CELLS and 0 <= gj < CELLS else []
    assert end in ends
    assert cost + octile(gi - end[0], gj - end[1]) == min(
        least[p, q] + octile(gi - p, gj - q) for p, q in ends
    )


def test_where_nothing_has_been_seen_the_way_is_straight() -> None:
    for goal in ((1.0, 0.3), (-2.0, -2.0), (0.0, -1.7)):
        points = planned(walled(), goal)
        assert points[0, :2].tolist() == [0.0, 0.0]
        assert points[-1, :2].tolist() == list(goal)
        assert points[0, 2] == pytest.approx(math.hypot(*goal), rel=0.01)
        assert points[-1, 2] == 0.0


DEAD_END = ((1.0, -0.8, 1.0, 0.8), (-0.2, 0.8, 1.0, 0.8), (-0.2, -0.8, 1.0, -0.8))
"""Walls ahead and on both sides."""


@pytest.mark.parametrize(
    ("walls", "goal", "least"),
    [
        # back out of the dead end, round its corner 0.12 m or more away, and on
        (DEAD_END, (2.0, 0.0), 2 * math.hypot(0.2, 0.9) + 1.2 + 0.9),
        (DEAD_END[:1], (2.0, 0.0), 2 * math.hypot(1.0, 0.92)),
        (DEAD_END[:1], (9.0, 0.0), math.hypot(1.0, 0.92) + math.hypot(8.0, 0.92)),  # far outside
    ],
)
def test_the_way_goes_round_what_is_in_between(
    walls: tuple[tuple[float, float, float, float], ...], goal: tuple[float, float], least: float
) -> None:
    grid = walled(*walls)
    points = planned(grid, goal)
    assert points[-1, :2].tolist() == list(goal)
    assert least < points[0, 2] < 1.4 * least
    for begin, end in itertools.pairwise(points):
        pieces = tuple(begin[:2].tolist()), tuple(end[:2].tolist())
        cost, most = piece_cost(grid.costs, SIDE, ORIGIN, *pieces)
        assert most < LETHAL
        assert end[3] == pytest.approx(cost, abs=1.0)  # the goal lies anywhere in its cell
    lengths = np.hypot(*np.diff(points[:, :2], axis=0).T)
    assert points[:, 2] == pytest.approx([*np.cumsum(lengths[::-1])[::-1], 0.0])


def test_a_robot_whose_goal_cannot_be_reached_still_gets_a_way() -> None:
    box = (
        (1.0, -0.5, 1.0, 0.5),
        (1.0, 0.5, 2.0, 0.5),
        (2.0, 0.5, 2.0, -0.5),
        (2.0, -0.5, 1.0, -0.5),
    )
    points = planned(walled(*box), (1.5, 0.0))
    assert points[-1, :2].tolist() == [1.5, 0.0]


POINTS = np.array([[0.0, 0.0, 3.0, 0.0], [1.0, 0.0, 2.0, 0.0], [1.0, 2.0, 0.0, 0.0]])


@pytest.mark.parametrize(
    ("x", "y", "corner", "left"),
    [(0.0, 0.0, 1, 3.0), (0.5, 0.0, 1, 2.5), (0.9, -0.1, 1, 2.0 + math.hypot(0.1, 0.1)),
     (1.1, 0.5, 2, math.hypot(0.1, 1.5)), (1.0, 2.5, 2, 0.5)],
)  # fmt: skip
def test_corners_are_passed_and_the_way_that_is_left_measured(
    x: float, y: float, corner: int, left: float
) -> None:
    assert next_corner(POINTS, 3, 1, x, y) == corner
    assert length_left(POINTS, corner, x, y) == pytest.approx(left)
