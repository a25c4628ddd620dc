"""Worlds like BARN's: their figures against the published ones, their rules against slow ones."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.worlds import files, generators
from acsar_gym.worlds.generators import generate_world
from acsar_gym.worlds.world import Region, World

PUBLISHED = Path(__file__).parents[2].parent / "shared" / "barn"
CORRIDOR = 96
"""Cylinders of the corridor's three walls."""
WALLS = 60
"""Cells of the first and the last row."""
INNER = 28 * 30
LATTICE = np.array([-4.425, 5.175])


@pytest.fixture(scope="module")
def worlds() -> list[World]:
    return [generate_world("barn", number) for number in range(300)]


def cells_of(points: Any) -> Any:
    """N x 2: row and column of points, which must lie on the lattice."""
    exact = (points - LATTICE) / 0.15
    cells = np.rint(exact).astype(int)
    assert exact == pytest.approx(cells, abs=1e-6)
    return cells


def field_of(world: World) -> Any:
    """30 x 30: which cells hold a cylinder, without those of the corridor."""
    cells = cells_of(world.circles[:, :2])
    inside = cells[cells[:, 1] >= 0]
    field = np.zeros((30, 30), np.bool_)
    field[inside[:, 0], inside[:, 1]] = True
    assert field.sum() == len(inside)  # none twice
    return field


def fill(world: World) -> float:
    return (len(world.circles) - CORRIDOR - WALLS) / INNER


def test_as_full_as_the_published_ones(worlds: list[World]) -> None:
    fills = [fill(world) for world in worlds]
    assert min(fills) >= 25 / INNER > 0.029
    assert max(fills) <= 0.25
    assert np.mean(fills) == pytest.approx(0.127, abs=0.025)
    assert min(fills) < 0.05
    assert max(fills) > 0.22


def test_laid_out_as_the_published_ones(worlds: list[World]) -> None:
    """The same frame, start and goal, a corridor of 5 m, and two full rows at the sides."""
    expected = {(-4.425 + 0.15 * k, 0.075) for k in range(30)}
    expected |= {(x, 0.225 + 0.15 * k) for x in (-4.425, -0.075) for k in range(33)}
    corridor = np.array(sorted(expected))

    for world in worlds:
        assert world.start == Region(-2.0, 3.0, 0.0, math.pi / 2.0)
        assert world.goal == Region(-2.0, 13.0)
        centres = world.circles[:, :2]
        behind = centres[centres[:, 1] < 5.1]
        assert len(behind) == CORRIDOR
        order = np.lexsort(np.rint(behind.T[::-1] * 1e3))
        assert behind[order] == pytest.approx(corridor, abs=1e-9)

        field = field_of(world)
        assert field[[0, -1]].all()
        assert np.ptp(centres[:, 0]) == pytest.approx(4.35)


@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published worlds aren't here")
def test_the_published_worlds_might_be_ours(worlds: list[World]) -> None:
    ours = worlds[0].circles
    for world in files.load_folder(PUBLISHED):
        assert (world.start, world.goal) == (generators.BARN_START, generators.BARN_GOAL)
        field = field_of(world)
        made = generators.place_cylinders(field)
        assert len(made) == len(world.circles)
        ordered = [rows[np.lexsort(np.rint(rows.T * 1e3))] for rows in (made, world.circles)]
        assert ordered[0] == pytest.approx(ordered[1], abs=1e-6)
        assert made[:CORRIDOR] == pytest.approx(ours[:CORRIDOR])
        assert len(list(generators.find_crossable(field[None]))) == 1
