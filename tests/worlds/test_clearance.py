"""Distances to obstacles against hand-computed ones and against samples of every obstacle."""

from __future__ import annotations

import resource
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from acsar_gym.worlds.geometry import CLEARANCE_CHUNK, point_clearance, segment_clearance
from acsar_gym.worlds.world import World

ROOM = World(circles=[[0.0, 0.0, 0.5]], segments=[[2.0, -1.0, 2.0, 1.0]])  # type: ignore[arg-type]
SHARES = np.linspace(0.0, 1.0, 401)[:, None]
coordinates = st.floats(-20.0, 20.0).map(lambda value: round(value, 3))


def rows(width: int, most: int = 6) -> st.SearchStrategy[Any]:
    return st.integers(0, most).flatmap(
        lambda count: arrays(np.float64, (count, width), elements=coordinates)
    )


@st.composite
def worlds(draw: st.DrawFn) -> World:
    circles, segments = draw(rows(3)), draw(rows(4))
    circles[:, 2:] = np.abs(circles[:, 2:]) / 10.0
    return World(circles, segments)


def samples(a: Any, b: Any) -> Any:
    """Points on the piece from a to b and the farthest that any of its points is from them."""
    return a + SHARES * (b - a), float(np.hypot(*(b - a))) / (len(SHARES) - 1) / 2.0


def brute(point: Any, world: World) -> tuple[float, float]:
    """Bounds of the clearance of a point."""
    least, most = np.inf, np.inf
    for x, y, radius in world.circles:
        distance = float(np.hypot(point[0] - x, point[1] - y)) - radius
        least, most = min(least, distance), min(most, distance)
    for segment in world.segments:
        points, slack = samples(segment[:2], segment[2:])
        distance = float(np.hypot(*(points - point).T).min())
        least, most = min(least, distance - slack), min(most, distance)
    return least, most


@pytest.mark.parametrize(
    ("point", "expected"),
    [((0.0, 2.0), 1.5), ((1.5, 0.0), 0.5), ((2.0, 0.3), 0.0), ((2.0, 3.0), 2.0), ((5.0, 5.0), 5.0)],
)
def test_points_are_as_far_as_computed_by_hand(point: Any, expected: float) -> None:
    assert point_clearance([point], ROOM).tolist() == [expected]


def test_it_is_negative_inside_a_circle() -> None:
    assert point_clearance([(0.1, 0.0)], ROOM)[0] == pytest.approx(-0.4)
    assert segment_clearance([(-1.0, 0.2)], [(1.0, 0.2)], ROOM)[0] == pytest.approx(-0.3)


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((-3.0, 1.0), (3.0, 1.0), 0.0),  # through the end of the segment
        ((-3.0, 2.0), (3.0, 2.0), 1.0),
        ((1.0, 0.7), (4.0, 0.7), 0.0),  # across the segment
        ((2.0, -3.0), (2.0, 3.0), 0.0),  # along the segment
        ((3.0, 0.0), (5.0, 0.0), 1.0),
        ((0.0, 4.0), (0.0, 4.0), 3.5),  # a point
    ],
)
def test_pieces_are_as_far_as_computed_by_hand(a: Any, b: Any, expected: float) -> None:
    assert segment_clearance([a], [b], ROOM)[0] == pytest.approx(expected, abs=1e-15)


def test_an_empty_world_is_infinitely_wide() -> None:
    assert point_clearance([(0.0, 0.0)], World()).tolist() == [np.inf]
    assert segment_clearance([(0.0, 0.0)], [(1.0, 0.0)], World()).tolist() == [np.inf]


def test_no_points_have_no_clearance() -> None:
    assert point_clearance([], ROOM).shape == segment_clearance([], [], ROOM).shape == (0,)


def test_segments_without_length_are_points() -> None:
    world = World(segments=[[1.0, 1.0, 1.0, 1.0]])  # type: ignore[arg-type]
    assert point_clearance([(1.0, 3.0)], world).tolist() == [2.0]
    assert segment_clearance([(0.0, 0.0)], [(2.0, 0.0)], world).tolist() == [1.0]


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"shape \(N, 2\)"):
        point_clearance([1.0, 2.0, 3.0], ROOM)
    with pytest.raises(ValueError, match="2 starts and 1 ends"):
        segment_clearance([(0.0, 0.0), (1.0, 1.0)], [(1.0, 0.0)], ROOM)


@given(world=worlds(), points=rows(2))
def test_points_are_as_far_as_brute_force_says(world: World, points: Any) -> None:
    for point, distance in zip(points, point_clearance(points, world), strict=True):
        least, most = brute(point, world)
        assert least - 1e-9 <= distance <= most + 1e-9 or distance == most


@given(world=worlds(), pieces=rows(4))
def test_pieces_are_as_far_as_their_nearest_point(world: World, pieces: Any) -> None:
    a, b = pieces[:, :2], pieces[:, 2:]
    for start, end, distance in zip(a, b, segment_clearance(a, b, world), strict=True):
        points, slack = samples(start, end)
        nearest = point_clearance(points, world).min()
        assert nearest - slack - 1e-9 <= distance <= nearest + 1e-9 or distance == nearest


@given(world=worlds(), pieces=rows(4))
def test_pieces_have_no_direction(world: World, pieces: Any) -> None:
    a, b = pieces[:, :2], pieces[:, 2:]
    there, back = segment_clearance(a, b, world), segment_clearance(b, a, world)
    np.testing.assert_allclose(there, back, atol=1e-12)


def test_chunks_make_no_difference() -> None:
    rng = np.random.default_rng(0)
    circles = np.column_stack(
        [rng.uniform(-5.0, 5.0, (CLEARANCE_CHUNK // 8, 2)), np.full(CLEARANCE_CHUNK // 8, 0.01)]
    )
    world, points = World(circles), rng.uniform(-5.0, 5.0, (50, 2))
    one_by_one = [point_clearance([point], world)[0] for point in points]
    assert point_clearance(points, world).tolist() == one_by_one


def test_memory_stays_small() -> None:
    rng = np.random.default_rng(0)
    world = World(segments=rng.uniform(-5.0, 5.0, (20_000, 4)))
    points = rng.uniform(-5.0, 5.0, (300, 2))  # 6 million distances, 48 MB of each vector
    point_clearance(points[:1], world)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    point_clearance(points, world)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # kB
