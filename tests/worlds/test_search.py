"""Shortest paths against lengths by hand and the published BARN worlds, and paths to follow."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import samples

from acsar_gym.config import RobotConfig
from acsar_gym.errors import WorldError
from acsar_gym.worlds import files
from acsar_gym.worlds.geometry import point_clearance, segment_clearance
from acsar_gym.worlds.grid import CELL_SIDE, MAX_CELLS, free_cells
from acsar_gym.worlds.search import (
    footprint_radius,
    path_length,
    remaining_distance,
    sample_path,
    shortest_path,
    world_along,
)
from acsar_gym.worlds.world import Floats, Region, World, make_rectangle

BARN = Path(__file__).parents[2].parent / "shared" / "barn"
CUT = 2e-3
"""How much nearer than its radius a path may come to an obstacle [m]."""
RESOLVED = 0.04
"""Room on both sides of a disc in which the search finds a way, a cell's half diagonal [m]."""
PILLAR = np.array([[0.0, 0.0, 0.5]])
FAR = Region(3.0, 0.0)
MIDDLE = Region(0.0, 0.0)
CELL = World(segments=make_rectangle(-1.0, -1.0, 1.0, 1.0), goal=FAR, name="cell")


def closest(path: Floats, world: World) -> float:
    return float(segment_clearance(path[:-1], path[1:], world).min())


@pytest.mark.parametrize("radius", [0.1, 0.25, 0.5])
def test_shortest_path_round_a_pillar_is_two_tangents_and_an_arc(radius: float) -> None:
    world = World(PILLAR, start=Region(-2.0, 0.0), goal=Region(2.0, 0.0))
    path = shortest_path(world, radius)
    reach = 0.5 + radius
    half_angle = math.pi / 2.0 - math.acos(reach / 2.0)
    by_hand = 2.0 * (math.sqrt(4.0 - reach**2) + reach * half_angle)
    assert 1.0 - CUT < path_length(path) / by_hand < 1.04
    assert closest(path, world) > radius - CUT


@samples(8, 40)
@pytest.mark.parametrize("radius", [0.22, 0.5])
def test_shortest_path_comes_no_nearer_than_its_radius(radius: float, count: int) -> None:
    solved = 0
    for seed in range(count):
        rng = np.random.default_rng(seed)
        circles = np.column_stack([rng.uniform(-2, 2, (8, 2)), rng.uniform(0.0, 0.4, 8)])
        starts = rng.uniform(-2, 2, (4, 2))
        segments = np.column_stack([starts, starts + rng.uniform(-1, 1, (4, 2))])
        places = rng.uniform(-2.6, 2.6, (400, 2))
        free = point_clearance(places, World(circles, segments)) > radius + RESOLVED
        ends = places[free][:2].tolist()
        world = World(circles, segments, Region(*ends[0]), Region(*ends[1]))
        try:
            path = shortest_path(world, radius)
        except WorldError as error:
            assert "no way from start to goal" in str(error)  # noqa: PT017
            continue

        solved += 1
        assert closest(path, world) >= radius - CUT
        assert path[[0, -1]].tolist() == ends
    assert solved >= count / 2


@pytest.mark.parametrize(
    ("world", "message"),
    [
        (World(PILLAR, start=Region(0.1, 0), goal=FAR), r"^the start \(0\.1, 0\) .* 0\.00 m .* 0"),
        (World(PILLAR, start=FAR, goal=Region(-1.2, 0, 0.5), name="a"), "^a: the goal .* 0.75 m"),
        (CELL, "^cell: no way"),
    ],
)
def test_shortest_path_refuses_worlds_without_a_way(world: World, message: str) -> None:
    with pytest.raises(WorldError, match=message) as caught:
        shortest_path(world, 0.25)
    assert "\n" not in str(caught.value)


@pytest.mark.skipif(not BARN.is_dir(), reason="the published worlds aren't here")
def test_shortest_path_is_no_longer_than_the_published_ones() -> None:
    radius = footprint_radius(RobotConfig.preset("acsar"))
    for world in files.load_folder(BARN):
        assert 10.0 <= path_length(shortest_path(world, radius)) <= world.length
        # The published path of world 299 comes as near as 0.225 m, where this one may not.
        assert path_length(shortest_path(world, 0.375)) <= world.length + 0.01


def test_free_cells_of_huge_worlds_are_coarse() -> None:
    huge = World(np.array([[1e4, 1e4, 1e4], [-1e4, -1e4, 1e4]]))
    grid = free_cells(huge, 0.25)
    assert 0.9 * MAX_CELLS < grid.free.size < 1.02 * MAX_CELLS
    assert grid.side == pytest.approx(40.0, rel=0.1)
    small = free_cells(World(PILLAR), 0.25)
    assert small.side == CELL_SIDE
    assert small.free.size < 5_000


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


def test_sample_path_goes_along_its_lines_at_even_distances() -> None:
    rows = sample_path(np.array([[0, 0], [1, 0], [1, 0], [1, 0.5]]), 0.5)
    up = math.pi / 2.0
    assert rows.tolist() == [[0, 0, 0], [0.5, 0, 0], [1, 0, up], [1, 0.5, up]]


def test_world_along_starts_on_its_path() -> None:
    world = world_along(np.array([[1, 2], [1, 2], [1, 5], [9, 9]]))
    assert (world.start, world.goal) == (Region(1.0, 2.0, theta=math.pi / 2.0), Region(9.0, 9.0))
    path: Any = world.path
    assert path.tolist() == [[1, 2], [1, 5], [9, 9]]
    with pytest.raises(WorldError, match="at least two points"):
        world_along(np.array([[1, 2], [1, 2]]))
