"""Rays, collisions and distances against brute force and by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.worlds import World
from acsar_gym.worlds.geometry import (
    RaySpec,
    cast_lines,
    footprint_collides,
    make_surroundings,
    measure_ranges,
    point_clearance,
    segment_clearance,
)
from acsar_gym.worlds.movers import walk

CONFIG = RobotConfig.preset("acsar")
SPECS = [RaySpec(64), RaySpec(33, 3.0, math.radians(270.0)), RaySpec(1, 4.0, 1.0), RaySpec(360)]
SHAPES: dict[str, Any] = {
    "box": None,
    "triangle": ((0.4, 0.0), (-0.2, 0.25), (-0.2, -0.25)),
    "aside": ((0.5, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.5, -0.1)),
    "round": tuple((0.3 * math.cos(k), 0.2 * math.sin(k)) for k in range(6)),
}


def draw_world(seed: int) -> World:
    rng = np.random.default_rng(seed)
    circles = np.column_stack([rng.uniform(-5, 5, (40, 2)), rng.uniform(0.0, 0.4, 40)])
    starts = rng.uniform(-5, 5, (40, 2))
    return World(circles, np.column_stack([starts, starts + rng.uniform(-2, 2, (40, 2))]))


def unit(theta: float) -> tuple[float, float]:
    return math.cos(theta), math.sin(theta)


def cast(world: World, spec: RaySpec, pose: tuple[float, float, float]) -> np.ndarray[Any, Any]:
    ranges = np.empty(spec.rays)
    around = make_surroundings(world, spec, CONFIG)
    x, y, theta = pose
    origins = np.zeros((spec.rays, 2))
    cast_lines(x, y, *unit(theta), 0, around, origins=origins, ranges=ranges)
    return ranges


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: str(spec.rays))
def test_rays_are_those_of_numpy(spec: RaySpec) -> None:
    world = draw_world(1)
    rng = np.random.default_rng(2)
    for _ in range(8):
        x, y, theta = rng.uniform((-4, -4, -7), (4, 4, 7)).tolist()
        offset = CONFIG.lidar_x_offset
        place = (x + offset * math.cos(theta), y + offset * math.sin(theta))
        expected = measure_ranges(place, spec.angles() + theta, world)
        if point_clearance([place], world)[0] <= 0.0:
            expected[:] = 0.0
        expected = np.minimum(expected, spec.reach)
        assert cast(world, spec, (x, y, theta)) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("bearing", "expected"), [(0.0, 1.5), (math.pi, 3.0), (math.pi / 2, math.inf), (0.5, math.inf)]
)
def test_ranges_by_hand(bearing: float, expected: float) -> None:
    world = World(np.array([[2.0, 0.0, 0.5]]), np.array([[-3.0, -1.0, -3.0, 1.0]]))
    ranges = measure_ranges((0.0, 0.0), np.array([bearing]), world)
    assert ranges == pytest.approx([expected])


@pytest.mark.parametrize(("circles", "expected"), [((), 7.5), ([[0.0, 0.0, 2.0]], 0.0)])
def test_nothing_is_seen_at_full_reach_and_all_from_inside(circles: Any, expected: float) -> None:
    assert (cast(World(circles), RaySpec(16, 7.5), (0.5, 0.0, 3.0)) == expected).all()


def test_rays_at_any_bearings_meet_movers_where_each_was_then() -> None:
    """As standing circles there would be met."""
    movers = [walk([[0.0, 0.0]], radius=radius) for radius in (0.3, 0.1)]
    drawn = draw_world(4)
    world = World(drawn.circles, drawn.segments, movers=movers)
    rng = np.random.default_rng(5)
    bearings = rng.uniform(-3.0, 3.0, 60)
    moved = rng.uniform(-3.0, 3.0, (60, 2, 2))
    ranges = measure_ranges((0.2, 0.1), bearings, world, moved)
    for k in range(60):
        rows = np.column_stack([moved[k], [0.3, 0.1]])
        standing = World(np.concatenate([drawn.circles, rows]), drawn.segments)
        assert ranges[k] == measure_ranges((0.2, 0.1), bearings[[k]], standing)[0]
    assert (ranges != measure_ranges((0.2, 0.1), bearings, world)).any()


@pytest.mark.parametrize("kind", ["circles", "segments"])
@pytest.mark.parametrize("name", SHAPES)
def test_collisions_are_those_of_the_outline_and_its_inside(name: str, kind: str) -> None:
    """An outline that touches nothing still collides if an obstacle lies within it."""
    rng = np.random.default_rng(1)
    config = CONFIG.with_(footprint=SHAPES[name])
    hits = []
    for _ in range(200):
        circles = np.column_stack([rng.uniform(-1.0, 1.0, (3, 2)), rng.uniform(0.0, 0.2, 3)])
        starts = rng.uniform(-1.0, 1.0, (3, 2))
        segments = np.column_stack([starts, starts + rng.uniform(-0.5, 0.5, (3, 2))])
        world = World(circles) if kind == "circles" else World(segments=segments)
        x, y, theta = rng.uniform((-0.3, -0.3, -7), (0.3, 0.3, 7)).tolist()

        cos, sin = unit(theta)
        outline = np.array(config.outline) @ [[cos, sin], [-sin, cos]] + (x, y)
        ends = np.roll(outline, -1, axis=0)
        places = np.concatenate([world.circles[:, :2], world.segments[:, :2]])
        along = (ends - outline)[:, None]
        offset = places - outline[:, None]
        is_inside = along[..., 0] * offset[..., 1] > along[..., 1] * offset[..., 0]

        touches = segment_clearance(outline, ends, world).min() <= 0.0
        around = make_surroundings(world, None, config)
        hits.append(footprint_collides(x, y, cos, sin, which=0, around=around))
        assert hits[-1] == (touches or is_inside.all(axis=0).any())
    assert 10 < sum(hits) < 190


@pytest.mark.parametrize(
    ("x", "theta", "hit"),
    [(0.0, 0.0, False), (0.031, 0.0, True), (0.029, 0.0, False), (0.0, math.pi / 4, True)],
)
def test_a_wall_just_ahead_is_touched_exactly(x: float, theta: float, hit: bool) -> None:
    """Half the length is 0.17 m. Turned by 45 degrees the corner reaches 0.24 m."""
    around = make_surroundings(World((), [[0.2, -5.0, 0.2, 5.0]]), None, CONFIG)  # type: ignore[arg-type]
    assert footprint_collides(x, 0.0, *unit(theta), which=0, around=around) == hit


ROOM = World(circles=[[0.0, 0.0, 0.5]], segments=[[2.0, -1.0, 2.0, 1.0]])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((0.0, 2.0), None, 1.5),
        ((2.0, 0.3), None, 0.0),
        ((2.0, 3.0), None, 2.0),
        ((0.1, 0.0), None, -0.4),
        ((-1.0, 0.2), (1.0, 0.2), -0.3),  # into the circle
        ((-3.0, 1.0), (3.0, 1.0), 0.0),  # through the end of the segment
        ((-3.0, 2.0), (3.0, 2.0), 1.0),
        ((2.0, -3.0), (2.0, 3.0), 0.0),  # along the segment
        ((3.0, 0.0), (5.0, 0.0), 1.0),
    ],
)
def test_distances_by_hand(a: Any, b: Any, expected: float) -> None:
    distances = point_clearance([a], ROOM) if b is None else segment_clearance([a], [b], ROOM)
    assert distances[0] == pytest.approx(expected, abs=1e-15)
