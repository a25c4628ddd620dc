"""Worlds: what they refuse, that they never change, and what they tell."""

from __future__ import annotations

import math
import pickle
from dataclasses import FrozenInstanceError, replace
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.worlds.world import MAX_COORDINATE, MAX_OBSTACLES, Region, World

WIDTHS = {"circles": 3, "segments": 4, "path": 2}


def array(*rows: Any) -> Any:
    return np.array(rows, np.float64)


def points(world: World) -> Any:
    """Every point of a world, in a fixed order."""
    regions = array([world.start.x, world.start.y], [world.goal.x, world.goal.y])
    ends = world.segments.reshape(-1, 2)
    path = np.zeros((0, 2)) if world.path is None else world.path
    return np.concatenate([regions, world.circles[:, :2], ends, path])


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
    half = MAX_OBSTACLES // 2
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
    region = Region(MAX_COORDINATE, -MAX_COORDINATE, MAX_COORDINATE, -math.pi)
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
