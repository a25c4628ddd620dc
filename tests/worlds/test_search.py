"""Shortest paths against lengths by hand and the published BARN worlds, and paths to follow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds.geometry import segment_clearance
from acsar_gym.worlds.grid import CELL_SIDE, MAX_CELLS, free_cells
from acsar_gym.worlds.search import (
    path_length,
    remaining_distance,
    shortest_path,
    world_along,
)
from acsar_gym.worlds.world import Region, World, make_rectangle

CUT = 2e-3
"""How much nearer than its radius a path may come to an obstacle [m]."""
PILLAR = np.array([[0.0, 0.0, 0.5]])
FAR = Region(3.0, 0.0)
MIDDLE = Region(0.0, 0.0)
CELL = World(segments=make_rectangle(-1.0, -1.0, 1.0, 1.0), goal=FAR, name="cell")


@pytest.mark.parametrize("radius", [0.1, 0.5])
def test_shortest_path_round_a_pillar_is_two_tangents_and_an_arc(radius: float) -> None:
    world = World(PILLAR, start=Region(-2.0, 0.0), goal=Region(2.0, 0.0))
    path = shortest_path(world, radius)
    reach = 0.5 + radius
    half_angle = math.pi / 2.0 - math.acos(reach / 2.0)
    by_hand = 2.0 * (math.sqrt(4.0 - reach**2) + reach * half_angle)
    assert 1.0 - CUT < path_length(path) / by_hand < 1.04
    assert segment_clearance(path[:-1], path[1:], world).min() > radius - CUT


def test_shortest_path_finds_a_far_door_in_a_large_world() -> None:
    # A grid of all 400 m has cells of 40 cm, which are too large for a door of 80 cm.
    walls = np.array([[1.5, -200.0, 1.5, 24.93], [1.5, 25.73, 1.5, 200.0]])
    hall = make_rectangle(-200.0, -200.0, 200.0, 200.0)
    path = shortest_path(World(segments=np.concatenate([hall, walls]), goal=FAR), 0.25)
    assert path_length(path) == pytest.approx(50.5, rel=0.01)


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (World(PILLAR, start=Region(0.1, 0), goal=FAR), r"^the start \(0\.1, 0\) .* 0\.00 m .* 0"),
        (World(PILLAR, start=FAR, goal=Region(-1.2, 0, 0.5), name="a"), "^a: the goal .* 0.75 m"),
        (CELL, "^cell: no way"),
    ],
)
def test_shortest_path_refuses_worlds_without_a_way(world: World, message: str) -> None:
    with pytest.raises(WorldError, match=message):
        shortest_path(world, 0.25)


def test_free_cells_of_huge_worlds_are_coarse() -> None:
    huge = World(np.array([[1e4, 1e4, 1e4], [-1e4, -1e4, 1e4]]))
    grid = free_cells(huge, 0.25)
    assert 0.9 * MAX_CELLS < grid.free.size < 1.02 * MAX_CELLS
    assert grid.side == pytest.approx(40.0, rel=0.1)
    assert free_cells(World(PILLAR), 0.25).side == CELL_SIDE


@pytest.mark.parametrize(
    ("world", "start", "expected"),
    [
        (World(PILLAR), Region(-9.0, 0.0), 12.2),
        # A robot's corners reach farther than its sides: a wall may be nearer than its radius.
        (World(segments=np.array([[-1, 0.1, 1, 0.1]])), MIDDLE, 3.0),
        (CELL, MIDDLE, math.inf),
    ],
)
def test_remaining_distance_counts_from_anywhere(
    world: World, start: Region, expected: float
) -> None:
    length = remaining_distance(world, 0.25, start, FAR)
    assert length == pytest.approx(expected, rel=0.02, abs=0.0)


def test_world_along_starts_on_its_path() -> None:
    world = world_along(np.array([[1, 2], [1, 2], [1, 5], [9, 9]]))
    assert (world.start, world.goal) == (Region(1.0, 2.0, theta=math.pi / 2.0), Region(9.0, 9.0))
    path: Any = world.path
    assert path.tolist() == [[1, 2], [1, 5], [9, 9]]
    with pytest.raises(WorldError, match="at least two points"):
        world_along(np.array([[1, 2], [1, 2]]))
