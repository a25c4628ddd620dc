"""Ways to the goal around obstacles, against ways that are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from acsar_gym.config import RobotConfig
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import (
    DEFAULT_COSTS,
    GoalDistances,
    clearance_costs,
    measure_goal_distances,
)
from acsar_gym.worlds.world import Region, World

ROBOT = RobotConfig.of(None)


def length(ways: GoalDistances, x: float, y: float, world: int = 0) -> float:
    """The length of one way."""
    return float(ways.lengths(np.array([world]), np.array([x]), np.array([y]))[0])


def test_on_an_open_floor_the_way_is_straight_in_every_direction() -> None:
    ways = measure_goal_distances([World(start=Region(-3.0, -3.0), goal=Region(0.0, 0.0))], ROBOT)
    for angle in np.linspace(-3.0, -1.6, 7):
        x, y = 2.5 * math.cos(angle), 2.5 * math.sin(angle)
        assert length(ways, x, y) == pytest.approx(2.5, rel=0.03)


def test_the_way_goes_round_a_wall() -> None:
    wall = World(
        segments=np.array([[1.0, -2.0, 1.0, 2.0]]), start=Region(0.0, 0.0), goal=Region(2.0, 0.0)
    )
    ways = measure_goal_distances([wall], ROBOT)
    around = 2.0 * math.hypot(1.0, 2.24)
    assert around < length(ways, 0.0, 0.0) < 1.2 * around  # near the wall it counts as longer
    assert length(ways, 0.0, 1.5) < length(ways, 0.0, 0.0)  # nearer to the wall's end
    assert length(ways, 1.5, 0.0) < 1.5  # behind it


def test_worlds_of_different_sizes_keep_apart() -> None:
    small = World(start=Region(-1.0, 0.0), goal=Region(0.0, 0.0))
    large = World(start=Region(-9.0, 4.0), goal=Region(1.0, 0.0))
    ways = measure_goal_distances([small, large, small], ROBOT)
    assert len(ways.values) == int(ways.sizes.prod(axis=1).sum())
    found = ways.lengths(np.arange(3), np.full(3, -0.5), np.zeros(3))
    assert_allclose(found, [0.5, 1.5, 0.5], rtol=0.02)


def test_ways_of_generated_worlds_are_near_the_shortest_ones() -> None:
    pool = Pool.of("clutter:1000-1004")
    starts = np.array([[world.start.x, world.start.y] for world in pool])
    ways = measure_goal_distances(list(pool), ROBOT)
    found = ways.lengths(np.arange(len(pool)), *starts.T)
    shortest = np.array([world.length for world in pool])
    assert (found > 0.9 * shortest).all()
    assert (found < 1.5 * shortest).all()


def test_outside_the_grid_the_edge_counts() -> None:
    ways = measure_goal_distances([World(start=Region(-1.0, 0.0), goal=Region(0.0, 0.0))], ROBOT)
    assert length(ways, -1e6, 0.0) == pytest.approx(length(ways, -2.0, 0.0), abs=0.01)


def test_costs_fall_with_the_distance_to_1() -> None:
    costs = clearance_costs(np.linspace(0.0, 3.0, 200), (0.17, 0.24))
    assert costs[0] == DEFAULT_COSTS.lethal
    assert (np.diff(costs) <= 0.0).all()
    assert costs[-1] == pytest.approx(1.0, abs=1e-6)
