"""Worlds: what they refuse, that they never change, and how they look from another pose."""

from __future__ import annotations

import math
import pickle
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.worlds.clearance import clearance
from acsar_gym.worlds.world import FARTHEST, MOST_OBSTACLES, Region, World

WIDTHS = {"circles": 3, "segments": 4, "path": 2}
coordinates = st.floats(-100.0, 100.0)
angles = st.floats(-10.0, 10.0)


def array(*rows: Any) -> Any:
    return np.array(rows, np.float64)


def rows(width: int) -> st.SearchStrategy[Any]:
    shape = st.tuples(st.integers(1, 4), st.just(width))
    return shape.flatmap(lambda shape: arrays(np.float64, shape, elements=coordinates))


@st.composite
def worlds(draw: st.DrawFn) -> World:
    circles = draw(rows(3))
    circles[:, 2] = np.abs(circles[:, 2]) / 10.0
    theta = draw(st.none() | angles)
    start = Region(draw(coordinates), draw(coordinates), draw(st.floats(0.0, 5.0)), theta)
    goal = Region(draw(coordinates), draw(coordinates), draw(st.floats(0.0, 5.0)))
    return World(circles, draw(rows(4)), start, goal, draw(st.none() | rows(2)), "drawn")


def points(world: World) -> Any:
    """Every point of a world, in a fixed order."""
    regions = array([world.start.x, world.start.y], [world.goal.x, world.goal.y])
    ends = world.segments.reshape(-1, 2)
    path = np.zeros((0, 2)) if world.path is None else world.path
    return np.concatenate([regions, world.circles[:, :2], ends, path])


def apart(places: Any) -> Any:
    return np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))


def zeros(count: int, width: int) -> Any:
    return np.zeros((count, width))


@pytest.mark.parametrize("name", WIDTHS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300, 10_001.0, -10_001.0])
def test_every_number_is_finite_and_near(name: str, value: float) -> None:
    bad = zeros(3, WIDTHS[name])
    bad[1, -1] = value
    with pytest.raises(WorldError, match=f"^{name}: must be finite numbers of at most 10000 m$"):
        World(**{name: bad})


@pytest.mark.parametrize("name", WIDTHS)
@pytest.mark.parametrize(
    "bad",
    [
        [1.0, 2.0, 3.0, 4.0],
        [[1.0]],
        [[1.0, 2.0, 3.0, 4.0, 5.0]],
        [[1.0, 2.0], [1.0, 2.0, 3.0]],
        [[[1.0, 2.0], [3.0, 4.0]]],
        7.0,
        "abc",
        ["abc"],
        {"x": 1.0},
        World,
        [[10**400] * 4],
        [[None, {}, [], ()]],
    ],
    ids=lambda bad: str(bad)[:40],
)
def test_bad_shapes_are_one_clear_error(name: str, bad: Any) -> None:
    with pytest.raises(WorldError, match=f"^{name}: must be rows of {WIDTHS[name]} numbers, have"):
        World(**{name: bad})


def test_world_errors_are_config_errors() -> None:
    with pytest.raises(ConfigError):
        World(circles=array([0.0, 0.0, -1.0]))


@pytest.mark.parametrize("radius", [-1e-300, -1.0])
def test_a_radius_is_never_negative(radius: float) -> None:
    with pytest.raises(WorldError, match="circles: a radius must not be negative"):
        World(circles=array([0.0, 0.0, 1.0], [0.0, 0.0, radius]))


def test_a_world_has_at_most_20_000_obstacles_in_all() -> None:
    half = MOST_OBSTACLES // 2
    assert World(np.zeros((half, 3)), np.zeros((half, 4))).obstacles == 20_000
    with pytest.raises(WorldError, match=r"^20,001 obstacles are too many, at most 20,000$"):
        World(np.zeros((half, 3)), np.zeros((half + 1, 4)))
    for name, width in WIDTHS.items():
        assert getattr(World(**{name: zeros(20_000, width)}), name).shape == (20_000, width)
        with pytest.raises(WorldError, match=f"^{name}: 20,001 are too many, at most 20,000$"):
            World(**{name: zeros(20_001, width)})


@pytest.mark.parametrize("empty", [[], (), [[]], np.zeros((0, 3)), np.zeros((0, 4))])
def test_nothing_is_no_obstacle(empty: Any) -> None:
    world = World(empty, empty)
    assert (world.circles.shape, world.segments.shape, world.obstacles) == ((0, 3), (0, 4), 0)


def test_lists_and_whole_numbers_become_arrays_of_floats() -> None:
    world = World([[1, 2, 3]], [(1, 2, 3, 4)], path=[[0, 0], [3, 4]])  # type: ignore[arg-type]
    assert world.circles.dtype == world.segments.dtype == np.float64
    assert world.circles.tolist() == [[1.0, 2.0, 3.0]]
    assert world.segments.tolist() == [[1.0, 2.0, 3.0, 4.0]]
    assert world.length == 5.0


@pytest.mark.parametrize("name", WIDTHS)
def test_worlds_never_change(name: str) -> None:
    given_rows = zeros(1, WIDTHS[name]) + 1.0
    world = World(**{name: given_rows})
    given_rows[:] = 7.0
    kept = getattr(world, name)
    assert (kept == 1.0).all()
    with pytest.raises(ValueError, match="read-only"):
        kept[0, 0] = 2.0
    with pytest.raises(FrozenInstanceError):
        setattr(world, name, given_rows)
    with pytest.raises(FrozenInstanceError):
        world.start.x = 1.0  # type: ignore[misc]
    seen = world.seen_from((1.0, 2.0, 3.0))
    assert not getattr(seen, name).flags.writeable
    assert not getattr(replace(world, name="other"), name).flags.writeable


def test_worlds_are_sent_to_other_processes() -> None:
    world = World(array([1, 2, 3]), array([1, 2, 3, 4]), Region(1.0, 2.0), path=array([0, 0]))
    sent = pickle.loads(pickle.dumps(world))  # noqa: S301 - our own bytes
    assert np.array_equal(points(sent), points(world))
    assert (sent.start, sent.goal, sent.name) == (world.start, world.goal, world.name)


def test_worlds_are_told_apart_by_identity() -> None:
    one, other = World(), World()
    assert len({one, other, one}) == 2


BAD_REGIONS: list[Any] = [
    (math.nan, 0.0),
    (0.0, math.inf),
    (0.0, 0.0, math.nan),
    (0.0, 0.0, math.inf),
    (0.0, 0.0, -1e-9),
    (0.0, 0.0, 0.0, math.nan),
    (0.0, 0.0, 0.0, math.inf),
    (10_000.1, 0.0),
    (0.0, 10**400),
    ("1", 0.0),
    (None, 0.0),
    (0.0, 0.0, None),
    (0.0, 0.0, 0.0, "north"),
    ([0.0], 0.0),
]


@pytest.mark.parametrize(
    "bad",
    [
        *BAD_REGIONS,
        (np.array([1.0, 2.0]), 0.0),  # a ValueError
        (1j, 0.0),
        (0.0, 0.0, 0.0, []),
        (0.0, 0.0, 0.0, ""),
    ],
    ids=lambda bad: str(bad)[:40],
)
def test_bad_regions_are_one_clear_error(bad: Any) -> None:
    with pytest.raises(WorldError, match=r"^region .*must be numbers of at most 10000, the radius"):
        Region(*bad)


def test_regions_may_be_as_far_as_coordinates() -> None:
    region = Region(FARTHEST, -FARTHEST, FARTHEST, -math.pi)
    assert (region.x, region.y, region.radius, region.theta) == (1e4, -1e4, 1e4, -math.pi)
    assert Region(1, 2) == Region(1.0, 2.0, 0.0, None)


def test_complex_numbers_are_refused() -> None:
    with pytest.raises(WorldError, match="circles: must be"):
        World(circles=np.array([[1j, 0.0, 1.0]]))


def test_the_length_is_that_of_the_path() -> None:
    assert World(path=array([0, 0], [3, 4], [3, 4], [3, 0])).length == pytest.approx(9.0)
    assert World(path=array([2, 2])).length == 0.0
    assert World(path=np.zeros((0, 2))).length == 0.0
    assert math.isnan(World().length)


@pytest.mark.parametrize(
    ("world", "bounds"),
    [
        (World(), (0.0, 0.0, 1.0, 0.0)),
        (World(array([5.0, 6.0, 2.0])), (0.0, 0.0, 7.0, 8.0)),
        (World(array([-5.0, -6.0, 2.0])), (-7.0, -8.0, 1.0, 0.0)),
        (World(segments=array([4.0, -3.0, -2.0, 9.0])), (-2.0, -3.0, 4.0, 9.0)),
        (World(path=array([0.5, -8.0], [0.0, 8.0])), (0.0, -8.0, 1.0, 8.0)),
        (World(path=np.zeros((0, 2))), (0.0, 0.0, 1.0, 0.0)),
        (World(start=Region(-1.0, 2.0, 3.0)), (-4.0, -1.0, 2.0, 5.0)),
        (World(goal=Region(9.0, 2.0, 0.5)), (0.0, 0.0, 9.5, 2.5)),
    ],
)
def test_bounds_hold_everything_and_no_more(world: World, bounds: Any) -> None:
    assert world.bounds == bounds


@given(world=worlds(), x=coordinates, y=coordinates, theta=angles)
def test_seen_from_a_pose_nothing_changes_but_the_frame(
    world: World, x: float, y: float, theta: float
) -> None:
    seen = world.seen_from((x, y, theta))
    cos, sin = math.cos(theta), math.sin(theta)
    for old, new in zip(points(world).tolist(), points(seen).tolist(), strict=True):
        dx, dy = old[0] - x, old[1] - y
        assert new == pytest.approx([cos * dx + sin * dy, cos * dy - sin * dx], abs=1e-9)
    np.testing.assert_allclose(apart(points(seen)), apart(points(world)), atol=1e-9)
    assert seen.circles[:, 2].tolist() == world.circles[:, 2].tolist()
    assert (seen.start.radius, seen.goal.radius) == (world.start.radius, world.goal.radius)
    assert (seen.goal.theta, seen.name) == (None, "drawn")
    assert seen.length == pytest.approx(world.length, abs=1e-9, nan_ok=True)
    np.testing.assert_allclose(
        clearance(points(seen), seen), clearance(points(world), world), atol=1e-9
    )


@given(world=worlds(), x=coordinates, y=coordinates, theta=angles)
def test_seen_from_a_pose_and_back_is_the_same_world(
    world: World, x: float, y: float, theta: float
) -> None:
    cos, sin = math.cos(theta), math.sin(theta)
    back = (-cos * x - sin * y, sin * x - cos * y, -theta)  # the world's frame, seen from the pose
    again = world.seen_from((x, y, theta)).seen_from(back)
    np.testing.assert_allclose(points(again), points(world), atol=1e-9)
    if world.start.theta is None or again.start.theta is None:
        assert again.start.theta is world.start.theta
    else:
        turned = math.remainder(again.start.theta - world.start.theta, math.tau)
        assert turned == pytest.approx(0.0, abs=1e-9)


@given(world=worlds(), theta=angles)
def test_seen_from_its_start_the_start_is_the_origin(world: World, theta: float) -> None:
    world = replace(world, start=replace(world.start, theta=theta))
    seen = world.seen_from((world.start.x, world.start.y, theta)).start
    assert (seen.x, seen.y, seen.theta) == pytest.approx((0.0, 0.0, 0.0), abs=1e-12)


def test_what_is_ahead_of_a_pose_lies_on_its_x_axis() -> None:
    world = World(array([3.0, 4.0, 0.5]), array([3.0, 5.0, 2.0, 2.0]), Region(3.0, 2.0, 0.1, 3.0))
    seen = world.seen_from((3.0, 2.0, math.pi / 2.0))  # looking along +y
    assert seen.circles[0].tolist() == pytest.approx([2.0, 0.0, 0.5])
    assert seen.segments[0].tolist() == pytest.approx([3.0, 0.0, 0.0, 1.0])
    assert seen.start.theta == pytest.approx(3.0 - math.pi / 2.0)
    assert world.seen_from((0.0, 0.0, -3.0)).start.theta == pytest.approx(6.0 - math.tau)


def test_a_world_as_large_as_allowed_is_seen_from_anywhere_in_it() -> None:
    world = World(array([9_000.0, 9_000.0, 1.0]), start=Region(0.0, 0.0, 0.0, math.pi / 4.0))
    assert world.seen_from((0.0, 0.0, math.pi / 4.0)).circles[0, 0] == pytest.approx(12_727.9, 1e-3)


@pytest.mark.parametrize("pose", [(math.nan, 0.0, 0.0), (0.0, 0.0, math.nan), (1e9, 0.0, 0.0)])
def test_a_pose_that_is_nowhere_is_refused(pose: Any) -> None:
    with pytest.raises(WorldError):
        World(array([1.0, 2.0, 3.0])).seen_from(pose)
