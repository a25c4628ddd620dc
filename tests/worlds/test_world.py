"""Worlds: what they refuse, that they never change, their bounds and frames."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import follow_keys, walk
from acsar_gym.worlds.world import (
    Region,
    World,
    point_in_world,
    to_odometry,
    to_world,
)

NAMES = pytest.mark.parametrize(("name", "width"), [("circles", 3), ("segments", 4), ("path", 2)])


@NAMES
def test_world_refuses_bad_numbers_and_shapes(name: str, width: int) -> None:
    for value in (math.nan, -10_001.0):
        bad: Any = np.zeros((3, width))
        bad[1, -1] = value
        with pytest.raises(WorldError, match=f"^{name}: must be finite numbers of at most 10000 m"):
            World(**{name: bad})
    for bad in ([1.0, 2.0], "abc", [[1j, 0.0, 1.0]]):
        with pytest.raises(WorldError, match=f"^{name}: must be rows of {width} numbers, have"):
            World(**{name: bad})


def test_world_has_at_most_20_000_obstacles_in_all() -> None:
    assert World(np.zeros((10_000, 3)), np.zeros((10_000, 4))).obstacles == 20_000
    with pytest.raises(WorldError, match=r"^20,001 obstacles are too many, at most 20,000$"):
        World(np.zeros((10_000, 3)), np.zeros((10_001, 4)))
    with pytest.raises(WorldError, match=r"^path: 20,001 are too many"):
        World(path=np.zeros((20_001, 2)))
    with pytest.raises(WorldError, match=r"^circles: a radius must not be negative"):
        World(np.array([[0.0, 0.0, -0.1]]))


@NAMES
def test_world_never_changes(name: str, width: int) -> None:
    rows: Any = np.ones((1, width))
    world = World(**{name: rows})
    rows[:] = 7.0
    assert (getattr(world, name) == 1.0).all()
    for made in (world, replace(world, name="other")):
        with pytest.raises(ValueError, match="read-only"):
            getattr(made, name)[0, 0] = 2.0


@pytest.mark.parametrize("bad", [(10_000.1, 0.0), (0.0, 0.0, -1e-9), (0.0, 0.0, 0.0, "north")])
def test_region_refuses_bad_numbers(bad: Any) -> None:
    with pytest.raises(WorldError, match=r"^region .*must be numbers of at most 10000, the radius"):
        Region(*bad)


@pytest.mark.parametrize(
    ("world", "bounds"),
    [
        (World(np.array([[5.0, 6.0, 2.0]])), (0.0, 0.0, 7.0, 8.0)),
        (World(path=np.array([[0.5, -8.0], [0.0, 8.0]])), (0.0, -8.0, 1.0, 8.0)),
        (World(movers=[walk([[2, 0], [2, 3]], radius=0.5)]), (0.0, -0.5, 2.5, 3.5)),
        (World(movers=[follow_keys([0, 4], [[0, -1], [0, 9]])]), (-0.25, -1.25, 1.0, 9.25)),
    ],
)
def test_bounds_hold_everything_and_no_more(world: World, bounds: Any) -> None:
    assert world.bounds == bounds


def test_to_odometry_begins_at_the_start() -> None:
    start = (3.0, 2.0, math.pi / 2.0)  # looking along +y
    pose = (3.0, 4.0, -3.0)
    expected = (2.0, 0.0, 1.5 * math.pi - 3.0)
    assert to_odometry(start, pose) == pytest.approx(expected, abs=1e-12)
    assert to_world(start, expected) == pytest.approx(pose)
    assert point_in_world(start, (2.0, 1.0)) == pytest.approx((2.0, 4.0))
