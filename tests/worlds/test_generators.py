"""Numbered worlds: the same everywhere, solvable, and as hard as asked."""

from __future__ import annotations

import hashlib
import itertools
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import samples

from acsar_gym.errors import WorldError
from acsar_gym.worlds import generators
from acsar_gym.worlds.generators import (
    ARENA_HALF,
    DEFAULT_RADIUS,
    PATH_MARGIN,
    generate_world,
)
from acsar_gym.worlds.geometry import point_clearance, segment_clearance
from acsar_gym.worlds.search import PATH_SPACING, path_length, shortest_path
from acsar_gym.worlds.world import Floats, World

KINDS = ("open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path")
SEARCHED = ("open", "clutter", "rooms")
"""Kinds whose path is a shortest one with a margin."""
CUT = 2e-3
"""How much nearer than its radius a path may come to an obstacle [m]."""
LEVELS = (0.0, 0.35, 0.7, 1.0)


def way(world: World) -> Floats:
    assert world.path is not None
    return world.path


def closest(path: Floats, world: World) -> float:
    return float(segment_clearance(path[:-1], path[1:], world).min())


def turns(path: Floats) -> Any:
    """Angles between the pieces of a path [rad]."""
    headings = np.arctan2(*np.diff(path, axis=0).T[::-1])
    return np.angle(np.exp(1j * np.diff(headings)))


def digests() -> list[str]:
    found = []
    moving = "crowd_reacting", "dynabarn", "open+2"
    for kind, level in itertools.product((*KINDS, *moving), (None, 1.0)):
        world = generate_world(kind, 10**20, level)
        arrays = world.circles, world.segments, way(world), *(m.pieces for m in world.movers)
        text = repr([(array.shape, array.tobytes()) for array in arrays])
        text += f" {world.start} {world.goal} {world.name}"
        found.append(hashlib.sha256(text.encode()).hexdigest())
    return found


def test_numbers_are_the_same_worlds_in_every_process() -> None:
    np.random.seed(7)  # noqa: NPY002 - what nobody should use
    folders = Path(__file__).parent, Path(__file__).parents[1]
    there = subprocess.run(
        [sys.executable, "-c", "import test_generators; print(*test_generators.digests())"],
        env={**os.environ, "PYTHONHASHSEED": "1234", "PYTHONPATH": ":".join(map(str, folders))},
        capture_output=True,
        text=True,
        check=True,
    )
    assert there.stdout.split() == digests()


def test_a_range_of_difficulty_varies_it_within(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []

    def picky(rng: np.random.Generator, difficulty: float, radius: float) -> World:
        asked.append(difficulty)
        if len(asked) < 40:
            raise WorldError("can't be crossed")
        return generators.make_open_floor(rng, difficulty, radius)

    whole, usual = (generate_world("clutter", 3, level) for level in ((0.0, 1.0), None))
    assert np.array_equal(way(whole), way(usual))
    levels = [generators.draw_difficulty("open", number, (0.2, 0.4)) for number in range(50)]
    assert 0.2 <= min(levels) < 0.25
    assert 0.35 < max(levels) <= 0.4
    monkeypatch.setitem(generators.MAKERS, "open", picky)
    generate_world("open", 7, (0.2, 0.4))
    assert asked[0] == levels[7]
    assert min(asked) == asked[-1] == 0.2  # made easier, but not too easy


@samples(8, 40)
@pytest.mark.parametrize("kind", KINDS)
def test_every_world_is_solvable(kind: str, count: int) -> None:
    for number in range(count):
        world = generate_world(kind, number, number / (count - 1.0))
        path = way(world)
        ends = [[world.start.x, world.start.y], [world.goal.x, world.goal.y]]
        assert path[[0, -1]].tolist() == ends
        assert closest(path, world) >= DEFAULT_RADIUS + PATH_MARGIN * (kind in SEARCHED) - CUT
        assert min(point_clearance(ends, world)) >= DEFAULT_RADIUS - CUT
        again = shortest_path(world, DEFAULT_RADIUS)
        assert math.dist(*ends) - 1e-9 <= path_length(again) <= 1.03 * world.length
        assert world.start.radius == world.goal.radius == 0.0
        assert world.goal.theta is None
        assert world.start.theta is not None


@pytest.mark.parametrize("level", LEVELS)
def test_clutter_has_as_many_obstacles_as_the_difficulty_says(level: float) -> None:
    for number in range(6):
        world = generate_world("clutter", number, level)
        assert len(world.circles) + (len(world.segments) - 4) / 4 == round(10 + 35 * level)
        assert world.bounds[0] >= -ARENA_HALF - 0.5
        assert world.segments[:4].min(axis=0).tolist() == [-ARENA_HALF] * 4
        assert math.dist((world.start.x, world.start.y), (world.goal.x, world.goal.y)) >= ARENA_HALF
        assert ((world.circles[:, 2] >= 0.08) & (world.circles[:, 2] <= 0.3)).all()
        sides = np.hypot(*(world.segments[4:, 2:] - world.segments[4:, :2]).T)
        assert ((sides >= 0.15 - 1e-9) & (sides <= 0.7 + 1e-9)).all()


@pytest.mark.parametrize("level", LEVELS)
def test_smooth_paths_are_as_crooked_as_the_difficulty_says(level: float) -> None:
    sharpest, lengths = [], []
    for number in range(40):
        path = way(generate_world("smooth_path", number, level))
        pieces = np.hypot(*np.diff(path, axis=0).T)
        assert pieces == pytest.approx(PATH_SPACING)
        sharpest.append(np.abs(turns(path)).max() / PATH_SPACING)
        lengths.append(path_length(path))
        assert path[0].tolist() == [0.0, 0.0]
    assert max(sharpest) <= 0.5 + 1.5 * level + 1e-9
    assert np.mean(sharpest) > 0.97 * (0.5 + 1.5 * level)
    assert min(lengths) >= 4.0 - PATH_SPACING
    assert max(lengths) <= 8.0 + PATH_SPACING
    assert np.ptp(lengths) > 3.0


@pytest.mark.parametrize(
    ("kind", "radius", "level"),
    [
        ("clutter", 4.0, 0.0),
        ("barn", 2.0, 1.0),
    ],
)
def test_too_large_a_footprint_is_one_clear_error(
    kind: str, radius: float, level: float | None
) -> None:
    with pytest.raises(WorldError, match=r"footprint of radius .* m through; use "):
        generate_world(kind, 0, level, radius)
