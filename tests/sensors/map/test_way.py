"""The way over the cells: the cheapest way, around what has been seen."""

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
    HALF,
    Grid,
    cell_at,
    make_stamp,
    raise_costs,
)
from acsar_gym.sensors.map.way import (
    COST,
    DIAGONAL,
    MOST_POINTS,
    REMAINING,
    SCRATCH,
    STRAIGHT,
    octile,
    piece_cost,
    plan_way,
    search_way,
)

SIDE = 0.05
LETHAL = COST_LETHAL / COST_UNIT
Wall = tuple[float, float, float, float]


def make_grid(*walls: Wall) -> Grid:
    """A grid around the origin in which walls have been seen, (ax, ay, bx, by) each [m]."""
    counts, costs = np.zeros((2, CELLS, CELLS), np.uint8)
    stamp = make_stamp(0.12, 0.2)
    grid = Grid(counts, costs, stamp, side=SIDE, first_i=-HALF, first_j=-HALF)
    for ax, ay, bx, by in walls:
        for x, y in np.linspace((ax, ay), (bx, by), 200).tolist():
            raise_costs(grid, cell_at(x, SIDE), cell_at(y, SIDE))
    return grid


def plan(grid: Grid, goal: tuple[float, float]) -> Any:
    """The way's corners from the origin, (n, 4)."""
    points = np.zeros((MOST_POINTS, 4))
    scratch = np.zeros(SCRATCH, np.int32)
    count, cost = plan_way(grid, (0.0, 0.0), goal, points=points, scratch=scratch)
    assert cost == pytest.approx(points[:count, COST].sum())
    return points[:count]


def measure_all(costs: Any) -> Any:
    """(CELLS, CELLS): Costs of the cheapest ways from the middle, which end at the edge."""
    cheapest = np.full((CELLS, CELLS), np.inf)
    cheapest[HALF, HALF] = 0.0
    previous: Any = np.zeros(0)
    while not np.array_equal(cheapest, previous):
        previous = cheapest.copy()
        for di, dj in itertools.product((-1, 0, 1), repeat=2):
            target = slice(1 + di, CELLS - 1 + di), slice(1 + dj, CELLS - 1 + dj)
            steps = ((DIAGONAL if di and dj else STRAIGHT) * (4 + costs[target])) >> 2
            cheapest[target] = np.minimum(cheapest[target], previous[1:-1, 1:-1] + steps)
    return cheapest


@pytest.mark.parametrize(
    ("seed", "middle", "offset"),
    [
        (3, (300, 2), (62, 0)),  # nearly at the edge
        (5, (-1, -1), (200, -40)),  # outside the window
    ],
)
def test_search_way_finds_the_cheapest(
    seed: int, middle: tuple[int, int], offset: tuple[int, int]
) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.integers(0, 20, (CELLS, CELLS))
    costs[rng.random((CELLS, CELLS)) < 0.3] = int(LETHAL)
    first = middle[0] - HALF, middle[1] - HALF
    rolled = np.roll(costs, first, (0, 1)).astype(np.uint8)
    grid = make_grid()._replace(costs=rolled, first_i=first[0], first_j=first[1])
    scratch = np.zeros(SCRATCH, np.int32)
    count = search_way(grid, (middle[0] + offset[0], middle[1] + offset[1]), scratch)

    # A connected way from the middle.
    i, j = np.divmod(scratch[:count][::-1], CELLS)
    assert (i[0], j[0]) == (HALF, HALF)
    rows = abs(np.diff(i))
    columns = abs(np.diff(j))
    assert (np.maximum(rows, columns) == 1).all()
    lengths = np.where(rows * columns, DIAGONAL, STRAIGHT)
    cost = ((lengths * (4 + costs[i[1:], j[1:]])) >> 2).sum()

    # No way to its end is cheaper, nor a way to another end and straight on.
    cheapest = measure_all(costs)
    goal = HALF + offset[0], HALF + offset[1]
    ends = [cell for cell in np.ndindex(CELLS, CELLS) if {0, CELLS - 1} & set(cell) or cell == goal]
    assert (i[-1], j[-1]) in ends
    assert cost == cheapest[i[-1], j[-1]]
    assert cost + octile(int(goal[0] - i[-1]), int(goal[1] - j[-1])) == min(
        cheapest[p, q] + octile(goal[0] - p, goal[1] - q) for p, q in ends
    )


def test_plan_way_is_straight_if_nothing_has_been_seen() -> None:
    points = plan(make_grid(), (1.0, 0.3))
    assert points[[0, -1], :2].tolist() == [[0.0, 0.0], [1.0, 0.3]]
    assert points[0, REMAINING] == pytest.approx(math.hypot(1.0, 0.3), rel=0.01)


WALL = (1.0, -0.8, 1.0, 0.8)
DEAD_END = (WALL, (-0.2, 0.8, 1.0, 0.8), (-0.2, -0.8, 1.0, -0.8))


@pytest.mark.parametrize(
    ("walls", "goal", "shortest"),
    [
        # back out of the dead end, round its corner at 0.12 m or more, and on
        (DEAD_END, (2.0, 0.0), 2 * math.hypot(0.2, 0.9) + 1.2 + 0.9),
        ((WALL,), (9.0, 0.0), math.hypot(1.0, 0.92) + math.hypot(8.0, 0.92)),  # far outside
    ],
)
def test_plan_way_goes_round_walls(
    walls: tuple[Wall, ...], goal: tuple[float, float], shortest: float
) -> None:
    grid = make_grid(*walls)
    points = plan(grid, goal)
    assert points[-1, :2].tolist() == list(goal)
    assert shortest < points[0, REMAINING] < 1.4 * shortest
    for start, end in itertools.pairwise(points):
        cost, highest = piece_cost(grid, tuple(start[:2]), tuple(end[:2]))
        assert highest < LETHAL
        assert end[COST] == pytest.approx(cost, abs=1.0)  # the goal lies anywhere in its cell
    lengths = np.hypot(*np.diff(points[:, :2], axis=0).T)
    assert points[:, REMAINING] == pytest.approx([*np.cumsum(lengths[::-1])[::-1], 0.0])


def test_plan_way_to_a_goal_that_cannot_be_reached() -> None:
    corners = itertools.pairwise([(1.0, -0.5), (1.0, 0.5), (2.0, 0.5), (2.0, -0.5), (1.0, -0.5)])
    points = plan(make_grid(*((*a, *b) for a, b in corners)), (1.5, 0.0))
    assert points[-1, :2].tolist() == [1.5, 0.0]
