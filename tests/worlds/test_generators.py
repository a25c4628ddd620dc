"""Numbered worlds: the same everywhere, solvable, and as hard as asked."""

from __future__ import annotations

import hashlib
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from samples import samples

from acsar_gym.errors import WorldError
from acsar_gym.worlds import generators
from acsar_gym.worlds.generators import DEFAULT_RADIUS, PATH_MARGIN, generate_world
from acsar_gym.worlds.geometry import segment_clearance
from acsar_gym.worlds.search import path_length, shortest_path
from acsar_gym.worlds.world import Floats, World

KINDS = ("open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path")
SEARCHED = ("open", "clutter", "rooms")
"""Kinds whose path is a shortest one with a margin."""
CUT = 2e-3
"""How much nearer than its radius a path may come to an obstacle [m]."""


def way(world: World) -> Floats:
    assert world.path is not None
    return world.path


def digests() -> list[str]:
    hashes = []
    for kind in (*KINDS, "crowd_reacting", "dynabarn"):
        world = generate_world(kind, 10**20)
        arrays = world.circles, world.segments, way(world), *(m.pieces for m in world.movers)
        text = repr([(array.shape, array.tobytes()) for array in arrays])
        hashes.append(hashlib.sha256(f"{text} {world.start} {world.goal}".encode()).hexdigest())
    return hashes


def test_numbers_are_the_same_worlds_in_every_process() -> None:
    np.random.seed(7)  # noqa: NPY002 - what nobody should use
    folders = Path(__file__).parent, Path(__file__).parents[1]
    elsewhere = subprocess.run(
        [sys.executable, "-c", "import test_generators; print(*test_generators.digests())"],
        env={**os.environ, "PYTHONHASHSEED": "1234", "PYTHONPATH": ":".join(map(str, folders))},
        capture_output=True,
        text=True,
        check=True,
    )
    assert elsewhere.stdout.split() == digests()


def test_a_range_of_difficulty_varies_it_within(monkeypatch: pytest.MonkeyPatch) -> None:
    levels_tried: list[float] = []

    def picky(rng: np.random.Generator, difficulty: float, radius: float) -> World:
        levels_tried.append(difficulty)
        if len(levels_tried) < 40:
            raise WorldError("can't be crossed")
        return generators.make_open_floor(rng, difficulty, radius)

    levels = [generators.draw_difficulty("open", number, (0.2, 0.4)) for number in range(50)]
    assert 0.2 <= min(levels) < 0.25
    assert 0.35 < max(levels) <= 0.4
    monkeypatch.setitem(generators.MAKERS, "open", picky)
    generate_world("open", 7, (0.2, 0.4))
    assert levels_tried[0] == levels[7]
    assert min(levels_tried) == levels_tried[-1] == 0.2  # made easier, but not too easy


@samples(8, 40)
@pytest.mark.parametrize("kind", KINDS)
def test_every_world_is_solvable(kind: str, count: int) -> None:
    for number in range(count):
        world = generate_world(kind, number, number / (count - 1.0))
        path = way(world)
        ends = [[world.start.x, world.start.y], [world.goal.x, world.goal.y]]
        assert path[[0, -1]].tolist() == ends
        needed = DEFAULT_RADIUS + PATH_MARGIN * (kind in SEARCHED) - CUT
        assert segment_clearance(path[:-1], path[1:], world).min() >= needed
        again = shortest_path(world, DEFAULT_RADIUS)
        assert math.dist(*ends) - 1e-9 <= path_length(again) <= 1.03 * world.length


def test_clutter_has_as_many_obstacles_as_the_difficulty_says() -> None:
    for level in (0.0, 0.35, 1.0):
        world = generate_world("clutter", 3, level)
        assert len(world.circles) + (len(world.segments) - 4) / 4 == round(10 + 35 * level)


@pytest.mark.parametrize(("kind", "radius"), [("clutter", 4.0), ("barn", 2.0)])
def test_too_large_a_footprint_is_one_clear_error(kind: str, radius: float) -> None:
    with pytest.raises(WorldError, match=r"footprint of radius .* m through; use "):
        generate_world(kind, 0, 0.0, radius)
