"""Sides of boxes and walls with doors, by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from acsar_gym.worlds.geometry import point_clearance
from acsar_gym.worlds.world import World, make_box, make_rectangle, make_wall

NO_DOOR = np.zeros((0, 2))
coordinates = st.floats(-50.0, 50.0)
sizes = st.floats(0.01, 20.0)
angles = st.floats(-7.0, 7.0)


def array(*rows: Any) -> Any:
    return np.array(rows, np.float64)


def lengths(sides: Any) -> Any:
    return np.hypot(*(sides[:, 2:] - sides[:, :2]).T)


def corners(sides: Any) -> set[tuple[float, float]]:
    return {(round(x, 9) + 0.0, round(y, 9) + 0.0) for x, y in sides[:, :2].tolist()}


def test_a_box_by_hand() -> None:
    assert corners(make_box(1.0, 2.0, 4.0, 2.0)) == {(3, 3), (-1, 3), (-1, 1), (3, 1)}
    assert corners(make_box(1.0, 2.0, 4.0, 2.0, math.pi / 2)) == {(0, 0), (2, 0), (2, 4), (0, 4)}
    half = round(math.sqrt(0.5), 9)
    assert corners(make_box(0.0, 0.0, 1.0, 1.0, math.pi / 4)) == {
        (half, 0),
        (-half, 0),
        (0, half),
        (0, -half),
    }


def test_a_box_is_turned_counter_clockwise() -> None:
    long = make_box(0.0, 0.0, 2.0, 0.0, math.radians(30.0))
    tip = (math.cos(math.radians(30.0)), math.sin(math.radians(30.0)))
    assert np.hypot(*(long[:, :2] - tip).T).min() == pytest.approx(0.0, abs=1e-12)


def test_an_outline_by_hand() -> None:
    assert corners(make_rectangle(-1.0, 2.0, 3.0, 8.0)) == {(-1, 2), (3, 2), (3, 8), (-1, 8)}


@given(x=coordinates, y=coordinates, length=sizes, width=sizes, theta=angles)
def test_the_sides_of_a_box_are_closed_and_as_long_as_asked(
    x: float, y: float, length: float, width: float, theta: float
) -> None:
    sides = make_box(x, y, length, width, theta)
    assert sides.shape == (4, 4)
    assert sides[:, 2:].tolist() == np.roll(sides[:, :2], -1, axis=0).tolist()
    assert lengths(sides) == pytest.approx([length, width, length, width], abs=1e-9)
    assert sides[:, :2].mean(axis=0) == pytest.approx((x, y), abs=1e-9)
    world = World(segments=sides)
    assert point_clearance([(x, y)], world)[0] == pytest.approx(min(length, width) / 2.0, abs=1e-9)


@given(left=coordinates, low=coordinates, length=sizes, width=sizes)
def test_an_outline_holds_its_corners_and_no_more(
    left: float, low: float, length: float, width: float
) -> None:
    sides = make_rectangle(left, low, left + length, low + width)
    assert sides[:, [0, 2]].min() == pytest.approx(left, abs=1e-9)
    assert sides[:, [1, 3]].min() == pytest.approx(low, abs=1e-9)
    assert sides[:, [0, 2]].max() == pytest.approx(left + length, abs=1e-9)
    assert sides[:, [1, 3]].max() == pytest.approx(low + width, abs=1e-9)


@pytest.mark.parametrize(
    ("doors", "pieces"),
    [
        (NO_DOOR, [(0, 10)]),
        (array([2, 3]), [(0, 2), (3, 10)]),
        (array([2, 3], [5, 7]), [(0, 2), (3, 5), (7, 10)]),
        (array([0, 1]), [(1, 10)]),
        (array([9, 10]), [(0, 9)]),
        (array([-2, 1], [8, 12]), [(1, 8)]),
        (array([0, 10]), []),
        (array([-5, 50]), []),
        (array([2, 4], [4, 6]), [(0, 2), (6, 10)]),  # doors that meet
        (array([2, 5], [4, 6]), [(0, 2), (6, 10)]),  # doors that overlap
        (array([11, 12]), [(0, 10)]),
        (array([3, 3]), [(0, 3), (3, 10)]),
    ],
)
def test_walls_have_doors_where_asked(doors: Any, pieces: Any) -> None:
    found = make_wall((1.0, 5.0), (11.0, 5.0), doors)
    assert found.shape == (len(pieces), 4)
    expected = [[1.0 + low, 5.0, 1.0 + high, 5.0] for low, high in pieces]
    assert found.tolist() == expected


@given(
    start=st.tuples(coordinates, coordinates),
    end=st.tuples(coordinates, coordinates),
    shares=st.lists(st.floats(0.0, 1.0), max_size=8).map(sorted),
)
def test_what_is_left_of_a_wall_and_its_doors_are_the_wall(
    start: tuple[float, float], end: tuple[float, float], shares: list[float]
) -> None:
    length = math.dist(start, end)
    assume(length > 0.01)
    doors = length * np.array(shares[: len(shares) // 2 * 2]).reshape(-1, 2)
    pieces = make_wall(start, end, doors)
    gaps = float((doors[:, 1] - doors[:, 0]).sum())
    assert lengths(pieces).sum() + gaps == pytest.approx(length, abs=1e-9)
    for x1, y1, x2, y2 in pieces.tolist():
        for x, y in ((x1, y1), (x2, y2)):
            assert math.dist(start, (x, y)) + math.dist((x, y), end) == pytest.approx(length)
        assert math.dist(start, (x1, y1)) < math.dist(start, (x2, y2)) + 1e-12
        middle = math.dist(start, ((x1 + x2) / 2.0, (y1 + y2) / 2.0))
        assert not any(low + 1e-9 < middle < high - 1e-9 for low, high in doors.tolist())
