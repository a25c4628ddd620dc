"""Floors of a house: rooms, doors and furniture as wide and as many as the difficulty says."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds.generators import CORRIDOR_LENGTH, ROOM_DEPTH, make_rooms
from acsar_gym.worlds.geometry import point_clearance
from acsar_gym.worlds.search import shortest_path
from acsar_gym.worlds.world import World

RADIUS = 0.25
LEVELS = (0.0, 0.3, 0.7, 1.0)


def floor(seed: int, level: float, radius: float = RADIUS) -> World:
    return make_rooms(np.random.default_rng(seed), level, radius)


def half_width(world: World) -> float:
    """Of the corridor."""
    return float(world.segments[:4, 1].max()) - ROOM_DEPTH


def gaps(world: World, y: float) -> list[tuple[float, float]]:
    """Where the corridor's wall at this y has doors."""
    lines = world.segments[4:]
    on_it = lines[np.isclose(lines[:, [1, 3]], y, atol=1e-9).all(axis=1)]
    pieces = sorted((min(x1, x2), max(x1, x2)) for x1, _, x2, _ in on_it.tolist())
    edges = [0.0, *(edge for piece in pieces for edge in piece), CORRIDOR_LENGTH]
    every = list(zip(edges[::2], edges[1::2], strict=True))
    return [(low, high) for low, high in every if high - low > 1e-9]


def dividers(world: World, side: float) -> list[float]:
    """Where the walls between the rooms of one side stand: upright ones that meet the corridor."""
    lines = world.segments[4:]
    meets = np.isclose(lines[:, [1, 3]], side * half_width(world)).any(axis=1)
    upright = np.isclose(lines[:, 0], lines[:, 2])
    return sorted(lines[meets & upright, 0].tolist())


def boxes(world: World) -> int:
    """Four sides in a row, the last of which ends where the first begins."""
    lines = world.segments[4:]
    fours = (lines[first : first + 4] for first in range(len(lines) - 3))
    return sum(np.array_equal(four[:, 2:], np.roll(four[:, :2], -1, axis=0)) for four in fours)


def room_of(world: World, x: float, y: float) -> tuple[float, int]:
    """Side, and number of the room along it."""
    side = math.copysign(1.0, y)
    return side, int(np.searchsorted(dividers(world, side), x))


@pytest.mark.parametrize("level", LEVELS)
def test_doors_are_as_wide_as_the_difficulty_says(level: float) -> None:
    width = 1.3 - level * (1.3 - 2.0 * RADIUS - 0.2)
    for seed in range(20):
        world = floor(seed, level)
        for side in (-1.0, 1.0):
            doors = gaps(world, side * half_width(world))
            assert [high - low for low, high in doors] == pytest.approx([width] * len(doors))
            walls = [0.0, *dividers(world, side), CORRIDOR_LENGTH]
            assert len(doors) == len(walls) - 1  # one for each room
            for (low, high), left, right in zip(doors, walls[:-1], walls[1:], strict=True):
                assert left + 0.2 - 1e-9 <= low < high <= right - 0.2 + 1e-9


@pytest.mark.parametrize("radius", [0.1, 0.25, 0.5])
def test_the_narrowest_door_lets_the_footprint_through(radius: float) -> None:
    world = floor(1, 1.0, radius)
    for low, high in gaps(world, half_width(world)):
        assert high - low == pytest.approx(2.0 * radius + 0.2)


def test_there_are_three_or_four_rooms_on_each_side() -> None:
    counts = [len(dividers(floor(seed, 0.0), side)) + 1 for seed in range(30) for side in (-1, 1)]
    assert set(counts) == {3, 4}
    widths = [
        np.diff([0.0, *dividers(floor(seed, 0.0), 1.0), CORRIDOR_LENGTH]).min()
        for seed in range(30)
    ]
    assert min(widths) >= CORRIDOR_LENGTH / 4 * 0.7 - 1e-9
    assert np.ptp(widths) > 0.5


def test_the_house_is_closed_and_as_large_as_said() -> None:
    for seed in range(20):
        world = floor(seed, 0.5)
        half = half_width(world)
        assert 0.6 <= half <= 0.9
        assert world.bounds == pytest.approx(
            (0.0, -half - ROOM_DEPTH, CORRIDOR_LENGTH, half + ROOM_DEPTH)
        )
        corners = world.segments[:4, :2]
        assert world.segments[:4, 2:].tolist() == np.roll(corners, -1, axis=0).tolist()


def test_furniture_grows_from_none_to_four_pieces_a_room() -> None:
    walls = {seed: floor(seed, 0.0) for seed in range(20)}
    pieces: dict[float, list[float]] = {level: [] for level in LEVELS}
    for level in LEVELS:
        for seed, bare in walls.items():
            count = sum(len(dividers(bare, side)) + 1 for side in (-1, 1))
            world = floor(seed, level)
            pieces[level].append((len(world.circles) + boxes(world)) / count)
    assert set(pieces[0.0]) == {0.0}
    assert set(pieces[1.0]) == {4.0}
    assert np.mean(pieces[0.3]) == pytest.approx(1.2, abs=0.25)
    assert np.mean(pieces[0.7]) == pytest.approx(2.8, abs=0.25)


def test_furniture_is_as_large_as_said() -> None:
    for seed in range(10):
        world = floor(seed, 1.0)
        sizes = world.circles[:, 2]
        assert ((sizes >= 0.2 / 3.0) & (sizes <= 0.8 / 3.0)).all()
        centres = world.circles[:, :2]
        assert (np.abs(centres[:, 1]) > half_width(world) + 0.2 - 1e-9).all()  # none in the way
        assert (np.abs(centres[:, 1]) < half_width(world) + ROOM_DEPTH - 0.2 + 1e-9).all()


@pytest.mark.parametrize("radius", [0.15, 0.25, 0.5])
def test_start_and_goal_lie_in_rooms_away_from_the_walls(radius: float) -> None:
    for seed in range(20):
        world = floor(seed, 0.0, radius)
        ends = np.array([[world.start.x, world.start.y], [world.goal.x, world.goal.y]])
        assert (point_clearance(ends, world) >= radius + 0.1 - 1e-9).all()
        assert (np.abs(ends[:, 1]) > half_width(world)).all()
        assert world.goal.theta is None
        assert world.start.theta is not None
        assert -math.pi <= world.start.theta <= math.pi


def test_start_and_goal_lie_in_different_rooms() -> None:
    seen: set[Any] = set()
    for seed in range(60):
        world = floor(seed, 0.0)
        one = room_of(world, world.start.x, world.start.y)
        other = room_of(world, world.goal.x, world.goal.y)
        assert one != other
        seen |= {one, other}
    assert len(seen) == 8


def test_what_is_wider_than_the_doors_stays_in_its_room() -> None:
    for seed in range(6):
        with pytest.raises(WorldError, match="no way from start to goal"):
            shortest_path(floor(seed, 0.0, 0.7), 0.7)
        assert len(shortest_path(floor(seed, 0.0, 0.6), 0.6)) > 2


def test_walls_between_rooms_have_a_door_now_and_then() -> None:
    whole = cut = 0
    for seed in range(40):
        world = floor(seed, 0.0)
        lines = world.segments[4:]
        upright = lines[np.isclose(lines[:, 0], lines[:, 2])]
        long = np.isclose(np.abs(upright[:, 3] - upright[:, 1]), ROOM_DEPTH)
        whole += int(long.sum())
        cut += int((~long).sum()) // 2
    assert whole > 0.3 * (whole + cut)
    assert cut > 0.3 * (whole + cut)
