"""Paths to follow and distances to the goal, against ones that are known."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from acsar_gym.config import RobotConfig
from acsar_gym.errors import WorldError
from acsar_gym.worlds.generators import make_smooth_path, make_waypoint_path
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.search import (
    PATH_SPACING,
    GoalDistances,
    drop_repeated,
    measure_goal_distances,
    path_length,
    sample_path,
    world_along,
)
from acsar_gym.worlds.world import Region, World


def array(*rows: Any) -> Any:
    return np.array(rows, np.float64)


CORNER = array([0, 0], [1, 0], [1, 0], [1, 0.5])


def test_samples_by_hand() -> None:
    found = sample_path(CORNER, 0.25)
    assert found[:, :2].tolist() == [
        [0.0, 0.0],
        [0.25, 0.0],
        [0.5, 0.0],
        [0.75, 0.0],
        [1.0, 0.0],
        [1.0, 0.25],
        [1.0, 0.5],
    ]
    up = math.pi / 2.0
    assert found[:, 2].tolist() == [0.0, 0.0, 0.0, 0.0, up, up, up]  # at the corner, the way on


@pytest.mark.parametrize(
    ("length", "spacing", "count"),
    [
        (1.0, 0.05, 21),
        (1.0, 0.3, 5),  # 0.25 m apart, never more than asked
        (0.3, 0.1, 4),  # 0.3 / 0.1 is a little more than 3
        (1.0, 50.0, 2),
        (100.0, 0.05, 2001),
    ],
)
def test_samples_are_evenly_spaced_and_at_most_as_far_apart_as_asked(
    length: float, spacing: float, count: int
) -> None:
    found = sample_path(array([2.0, 1.0], [2.0, 1.0 - length]), spacing)
    assert found.shape == (count, 3)
    assert np.diff(found[:, 1]) == pytest.approx(-length / (count - 1))
    assert found[[0, -1], :2].tolist() == [[2.0, 1.0], [2.0, 1.0 - length]]
    assert (found[:, 2] == -math.pi / 2.0).all()


@pytest.mark.parametrize(
    ("path", "theta"),
    [
        (array([1, 2], [3, 2]), 0.0),
        (array([1, 2], [1, 2], [1, 5], [9, 9]), math.pi / 2.0),
        (array([1, 2], [0, 1], [1, 2]), -3.0 * math.pi / 4.0),
        (array([1, 2], [1.0 + 1e-9, 2.0], [1, 5]), 0.0),
    ],
)
def test_along_a_path_the_robot_starts_on_it(path: Any, theta: float) -> None:
    world = world_along(path)
    assert world.obstacles == 0
    assert (world.start.x, world.start.y, world.start.radius) == (1.0, 2.0, 0.0)
    assert world.start.theta == pytest.approx(theta)
    assert (world.goal.x, world.goal.y) == tuple(path[-1])
    assert world.path is not None
    assert world.path.tolist() == drop_repeated(path).tolist()
    assert world.length == pytest.approx(path_length(path))
    assert not world.path.flags.writeable


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (array([1, 2]), "at least two points"),
        (array([1, 2], [1, 2], [1, 2]), "not all the same"),
        (None, "at least two points"),
        (array([1, 2, 3], [4, 5, 6]), r"path: must be rows of 2 numbers, have shape \(2, 3\)"),
        (array([0, 0], [math.nan, 1]), "path: must be finite"),
        ("straight on", "path: must be rows of 2"),
        (np.zeros((20_001, 2)), "path: 20,001 are too many"),
    ],
)
def test_what_is_no_path_is_one_clear_error(path: Any, message: str) -> None:
    with pytest.raises(WorldError, match=message):
        world_along(path)


@pytest.mark.parametrize("make", [make_smooth_path, make_waypoint_path])
def test_made_paths_are_along_themselves(make: Any) -> None:
    for seed in range(10):
        world = make(np.random.default_rng(seed), 0.5, 0.25)
        again = world_along(world.path)
        assert (again.start, again.goal) == (world.start, world.goal)
        samples = sample_path(world.path)
        assert np.hypot(*np.diff(samples[:, :2], axis=0).T).max() <= PATH_SPACING + 1e-9
        assert samples[0].tolist() == pytest.approx([0.0, 0.0, world.start.theta])


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


def test_outside_the_grid_the_edge_counts() -> None:
    ways = measure_goal_distances([World(start=Region(-1.0, 0.0), goal=Region(0.0, 0.0))], ROBOT)
    assert length(ways, -1e6, 0.0) == pytest.approx(length(ways, -2.0, 0.0), abs=0.01)


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
