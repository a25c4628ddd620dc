"""Numbered worlds: the same everywhere, solvable, as hard as asked, and like the published ones."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import samples

from acsar_gym.errors import WorldError
from acsar_gym.tools.evaluation.provenance import hash_world
from acsar_gym.worlds import files, generators
from acsar_gym.worlds.generators import DEFAULT_RADIUS, PATH_MARGIN, generate_world
from acsar_gym.worlds.geometry import segment_clearance
from acsar_gym.worlds.search import path_length, shortest_path
from acsar_gym.worlds.world import World

KINDS = ("open", "clutter", "rooms", "barn", "smooth_path", "waypoint_path")
SEARCHED = KINDS[:3]
"""Kinds whose path is a shortest one with a margin."""
CUT = 2e-3
"""How much nearer than its radius a path may come to an obstacle [m]."""


RECORDED = {
    "open": "5721daeaf0532fa0",
    "clutter": "91d94e4786e623ea",
    "rooms": "de169ecb6a21d2bb",
    "barn": "8a308de53b218adc",
    "smooth_path": "f372f470b6022c3c",
    "waypoint_path": "8a762475f8a71826",
    "crowd": "9227778ede75cccf",
    "crowd_reacting": "364d4422927ef2ec",
    "dynabarn": "5d192bf19f1b0475",
}
"""Hashes of some worlds of each generator, which change with a new version of the package only."""
LEVELS: dict[int, Any] = {0: 0.0, 1: 1.0, 3: 0.35, 4: 0.8, 10: (0.2, 0.6), 20: None}
"""Difficulties of these worlds, by number: all kinds of halls, and a draw that is left out."""


@pytest.mark.parametrize("kind", generators.MAKERS)
def test_generate_world_makes_the_recorded_worlds(kind: str) -> None:
    worlds = [generate_world(kind, number, level, 0.240416) for number, level in LEVELS.items()]
    digest = hashlib.sha256(b"".join(map(hash_world, worlds))).hexdigest()
    assert digest[:16] == RECORDED[kind]


def test_generate_world_varies_difficulty_within_a_range(monkeypatch: pytest.MonkeyPatch) -> None:
    levels_tried: list[float] = []

    def picky(rng: np.random.Generator, difficulty: float, radius: float) -> World:
        levels_tried.append(difficulty)
        if len(levels_tried) < 40:
            raise WorldError("can't be crossed")
        return generators.make_open_floor(rng, difficulty, radius)

    monkeypatch.setitem(generators.MAKERS, "open", picky)
    generate_world("open", 7, (0.2, 0.4))
    assert levels_tried[0] == generators.draw_difficulty("open", 7, (0.2, 0.4)) > 0.2
    assert min(levels_tried) == levels_tried[-1] == 0.2  # made easier, but not too easy


@samples(8, 40)
@pytest.mark.parametrize("kind", KINDS)
def test_generate_world_is_solvable(kind: str, count: int) -> None:
    for number in range(count):
        world = generate_world(kind, number, number / (count - 1.0))
        path: Any = world.path
        ends = [[world.start.x, world.start.y], [world.goal.x, world.goal.y]]
        margin = PATH_MARGIN if kind in SEARCHED else 0.0
        again = shortest_path(world, DEFAULT_RADIUS)
        for way, needed in ((path, DEFAULT_RADIUS + margin), (again, DEFAULT_RADIUS)):
            assert way[[0, -1]].tolist() == ends
            assert segment_clearance(way[:-1], way[1:], world).min() >= needed - CUT
        assert math.dist(*ends) - 1e-9 <= path_length(again) <= 1.03 * world.length


@pytest.mark.parametrize(("kind", "radius"), [("clutter", 4.0), ("barn", 2.0)])
def test_generate_world_refuses_a_footprint_that_is_too_large(kind: str, radius: float) -> None:
    with pytest.raises(WorldError, match=r"footprint of radius .* m through; use "):
        generate_world(kind, 0, 0.0, radius)


# BARN's fields, behind a corridor of three walls

PUBLISHED = Path(__file__).parents[2].parent / "shared" / "barn"


def field_of(world: World) -> Any:
    """30 x 30: which cells hold a cylinder, without those of the corridor."""
    exact = (world.circles[:, :2] - (-4.425, 5.175)) / 0.15
    cells = np.rint(exact).astype(int)
    assert exact == pytest.approx(cells, abs=1e-6)
    field = np.zeros((30, 30), np.bool_)
    inside = cells[cells[:, 1] >= 0]
    field[inside[:, 0], inside[:, 1]] = True
    assert field.sum() == len(inside)  # none twice
    return field


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published worlds aren't here")
def test_place_cylinders_makes_the_published_worlds_of_their_fields() -> None:
    for world in files.load_folder(PUBLISHED):
        assert (world.start, world.goal) == (generators.BARN_START, generators.BARN_GOAL)
        field = field_of(world)
        made = generators.place_cylinders(field)
        ordered = [rows[np.lexsort(np.rint(rows.T * 1e3))] for rows in (made, world.circles)]
        assert ordered[0] == pytest.approx(ordered[1], abs=1e-6)
        assert len(list(generators.find_crossable(field[None]))) == 1
        assert path_length(shortest_path(world, DEFAULT_RADIUS)) <= world.length
