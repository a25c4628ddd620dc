"""BARN's five measures on worlds that can be measured by hand, and on the published ones."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds.difficulty import (
    VISIBILITY_RAYS,
    VISIBILITY_REACH,
    Difficulty,
    measure_difficulty,
)
from acsar_gym.worlds.world import World

ANGLES = 2.0 * math.pi * np.arange(VISIBILITY_RAYS) / VISIBILITY_RAYS


def array(*rows: Any) -> Any:
    return np.array(rows, np.float64)


def corridor(width: float) -> World:
    half = width / 2.0
    walls = array([-50.0, -half, 50.0, -half], [-50.0, half, 50.0, half])
    return World(segments=walls, path=array([0.0, 0.0], [3.0, 0.0], [7.0, 0.0]))


@pytest.mark.parametrize("width", [0.5, 1.0, 1.4])
def test_a_straight_corridor(width: float) -> None:
    found = measure_difficulty(corridor(width))
    away = np.abs(np.sin(ANGLES))
    rays = np.where(away > 1e-9, width / 2.0 / np.maximum(away, 1e-9), np.inf)
    assert found.closest_obstacle == pytest.approx(width / 2.0)
    assert found.characteristic_dimension == pytest.approx(width)
    assert found.visibility == pytest.approx(np.minimum(rays, VISIBILITY_REACH).mean())
    assert found.dispersion == 4.0  # wall, free ahead, wall, free behind
    assert found.tortuosity == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("circles", "expected"),
    [
        ((), (VISIBILITY_REACH, VISIBILITY_REACH, 0.0, 2.0 * VISIBILITY_REACH, 1.0)),
        (array([0.0, 0.0, 2.0]), (0.0, 0.0, 0.0, 0.0, 1.0)),
    ],
    ids=["an empty world", "inside a pillar"],
)
def test_nothing_around_and_nothing_seen(circles: Any, expected: tuple[float, ...]) -> None:
    found = measure_difficulty(World(circles), path=array([0.0, 0.0], [1.0, 0.0]))
    assert found == Difficulty(*expected)


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (None, "has no path"),
        (array([1.0, 1.0], [1.0, 1.0]), "two points"),
        (array([0.0, math.nan], [1.0, 1.0]), "finite"),
        (array([0.0, 0.0], [9000.0, 0.0]), "too long"),
    ],
)
def test_bad_paths_are_refused(path: Any, message: str) -> None:
    with pytest.raises(WorldError, match=message):
        measure_difficulty(World(), path)
