"""Worlds: what they refuse, that they never change, and shapes and frames by hand."""

from __future__ import annotations

import math
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import WorldError
from acsar_gym.worlds import follow_keys, walk
from acsar_gym.worlds.world import (
    Region,
    World,
    make_box,
    make_rectangle,
    make_wall,
    point_in_world,
    to_odometry,
    to_world,
)

WIDTHS = {"circles": 3, "segments": 4, "path": 2}
NAMES = pytest.mark.parametrize("name", WIDTHS)


@NAMES
@pytest.mark.parametrize("value", [math.nan, -10_001.0])
def test_world_refuses_numbers_that_are_not_finite_and_near(name: str, value: float) -> None:
    bad: Any = np.zeros((3, WIDTHS[name]))
    bad[1, -1] = value
    with pytest.raises(WorldError, match=f"^{name}: must be finite numbers of at most 10000 m$"):
        World(**{name: bad})


@NAMES
@pytest.mark.parametrize("bad", [[1.0, 2.0], [[1.0], [1.0, 2.0]], "abc", [[1j, 0.0, 1.0]]])
def test_world_refuses_bad_shapes(name: str, bad: Any) -> None:
    with pytest.raises(WorldError, match=f"^{name}: must be rows of {WIDTHS[name]} numbers, have"):
        World(**{name: bad})


def test_world_has_at_most_20_000_obstacles_in_all() -> None:
    assert World(np.zeros((10_000, 3)), np.zeros((10_000, 4))).obstacles == 20_000
    with pytest.raises(WorldError, match=r"^20,001 obstacles are too many, at most 20,000$"):
        World(np.zeros((10_000, 3)), np.zeros((10_001, 4)))
    with pytest.raises(WorldError, match=r"^path: 20,001 are too many"):
        World(path=np.zeros((20_001, 2)))


@NAMES
def test_world_never_changes(name: str) -> None:
    rows: Any = np.ones((1, WIDTHS[name]))
    world = World(**{name: rows})
    rows[:] = 7.0
    assert (getattr(world, name) == 1.0).all()
    with pytest.raises(FrozenInstanceError):
        setattr(world, name, rows)
    for made in (world, replace(world, name="other")):
        with pytest.raises(ValueError, match="read-only"):
            getattr(made, name)[0, 0] = 2.0


@pytest.mark.parametrize(
    "bad", [(math.nan, 0.0), (10_000.1, 0.0), (0.0, 0.0, -1e-9), (0.0, 0.0, 0.0, "north")]
)
def test_region_refuses_bad_numbers(bad: Any) -> None:
    with pytest.raises(WorldError, match=r"^region .*must be numbers of at most 10000, the radius"):
        Region(*bad)


@pytest.mark.parametrize(
    ("world", "bounds"),
    [
        (World(), (0.0, 0.0, 1.0, 0.0)),
        (World(np.array([[5.0, 6.0, 2.0]])), (0.0, 0.0, 7.0, 8.0)),
        (World(path=np.array([[0.5, -8.0], [0.0, 8.0]])), (0.0, -8.0, 1.0, 8.0)),
        (World(movers=[walk([[2, 0], [2, 3]], radius=0.5)]), (0.0, -0.5, 2.5, 3.5)),
        (World(movers=[follow_keys([0, 4], [[0, -1], [0, 9]])]), (-0.25, -1.25, 1.0, 9.25)),
    ],
)
def test_bounds_hold_everything_and_no_more(world: World, bounds: Any) -> None:
    assert world.bounds == bounds


@pytest.mark.parametrize(
    ("sides", "corners"),
    [
        (make_box(1.0, 2.0, 4.0, 2.0), {(3, 3), (-1, 3), (-1, 1), (3, 1)}),
        (make_box(1.0, 2.0, 4.0, 2.0, math.pi / 2), {(0, 0), (2, 0), (2, 4), (0, 4)}),
        (make_rectangle(-1.0, 2.0, 3.0, 8.0), {(-1, 2), (3, 2), (3, 8), (-1, 8)}),
    ],
)
def test_boxes_by_hand(sides: Any, corners: Any) -> None:
    assert {(round(x, 9), round(y, 9)) for x, y in sides[:, :2].tolist()} == corners


@pytest.mark.parametrize(
    ("doors", "pieces"),
    [
        ([], [(0, 10)]),
        ([(2, 3), (5, 7)], [(0, 2), (3, 5), (7, 10)]),
        ([(-5, 50)], []),
        ([(2, 5), (4, 6)], [(0, 2), (6, 10)]),  # doors that overlap
    ],
)
def test_make_wall_has_doors_where_asked(doors: Any, pieces: Any) -> None:
    wall = make_wall((1.0, 5.0), (11.0, 5.0), np.reshape(doors, (-1, 2)))
    assert wall.shape == (len(pieces), 4)
    assert wall.tolist() == [[1.0 + low, 5.0, 1.0 + high, 5.0] for low, high in pieces]


def test_to_odometry_begins_at_the_start() -> None:
    start = (3.0, 2.0, math.pi / 2.0)  # looking along +y
    assert to_odometry(start, start) == (0.0, 0.0, 0.0)
    expected = (2.0, 0.0, 1.5 * math.pi - 3.0)
    assert to_odometry(start, (3.0, 4.0, -3.0)) == pytest.approx(expected, abs=1e-12)
    assert point_in_world(start, (2.0, 1.0)) == pytest.approx((2.0, 4.0))
    origin = (0.0, 0.0, 0.0)
    pose = (1.25, -2.5, 3.0)
    assert to_odometry(origin, pose) == to_world(origin, pose) == pose
