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
    MOST_POINTS,
    REMAINING,
    SCRATCH,
    piece_cost,
    plan_way,
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


def test_plan_way_is_straight_if_nothing_has_been_seen() -> None:
    points = plan(make_grid(), (1.0, 0.3))
    assert points[[0, -1], :2].tolist() == [[0.0, 0.0], [1.0, 0.3]]
    assert points[0, REMAINING] == pytest.approx(math.hypot(1.0, 0.3), rel=0.01)


DEAD_END = ((1.0, -0.8, 1.0, 0.8), (-0.2, 0.8, 1.0, 0.8), (-0.2, -0.8, 1.0, -0.8))


@pytest.mark.parametrize(
    ("walls", "goal", "shortest"),
    [
        # back out of the dead end, round its corner at 0.12 m or more, and on
        (DEAD_END, (2.0, 0.0), 2 * math.hypot(0.2, 0.9) + 1.2 + 0.9),
        (DEAD_END[:1], (9.0, 0.0), math.hypot(1.0, 0.92) + math.hypot(8.0, 0.92)),  # far outside
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
