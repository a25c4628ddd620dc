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


def draw_obstacles(rng: Any, count: int, half: float, longest: float) -> tuple[Any, Any]:
    """Circles and segments within a square."""
    circles = np.column_stack([rng.uniform(-half, half, (count, 2)), rng.uniform(0, 0.3, count)])
    starts = rng.uniform(-half, half, (count, 2))
    ends = starts + rng.uniform(-longest, longest, (count, 2))
    return circles, np.column_stack([starts, ends])


def cast(world: World, spec: RaySpec, pose: tuple[float, float, float]) -> Any:
    ranges = np.empty(spec.rays)
    around = make_surroundings(world, spec, CONFIG)
    x, y, theta = pose
    origins = np.zeros((spec.rays, 2))
    cast_lines(*(x, y, math.cos(theta), math.sin(theta), 0), around, origins=origins, ranges=ranges)
    return ranges


@pytest.mark.parametrize("spec", [RaySpec(64), RaySpec(33, 3.0, math.radians(270.0))])
def test_cast_lines_has_the_ranges_of_numpy(spec: RaySpec) -> None:
    world = World(*draw_obstacles(np.random.default_rng(1), 40, 5.0, 2.0))
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


@pytest.mark.parametrize(("circles", "expected"), [((), 7.5), ([[0.0, 0.0, 2.0]], 0.0)])
def test_cast_lines_sees_nothing_at_full_reach_and_all_from_inside(
    circles: Any, expected: float
) -> None:
    assert (cast(World(circles), RaySpec(16, 7.5), (0.5, 0.0, 3.0)) == expected).all()


def test_measure_ranges_meets_movers_where_each_was_when_it_was_measured() -> None:
    """As circles at rest there would be met."""
    radii = [0.3, 0.1]
    rng = np.random.default_rng(5)
    circles, segments = draw_obstacles(rng, 40, 5.0, 2.0)
    movers = [walk([[0.0, 0.0]], radius=radius) for radius in radii]
    world = World(circles, segments, movers=movers)
    bearings = rng.uniform(-3.0, 3.0, 60)
    moved = rng.uniform(-3.0, 3.0, (60, 2, 2))
    ranges = measure_ranges((0.2, 0.1), bearings, world, moved)
    for k in range(60):
        standing = World(np.vstack([circles, np.column_stack([moved[k], radii])]), segments)
        assert ranges[k] == measure_ranges((0.2, 0.1), bearings[[k]], standing)[0]
    assert (ranges != measure_ranges((0.2, 0.1), bearings, world)).any()


@pytest.mark.parametrize(
    "footprint",
    [
        None,
        ((0.4, 0.0), (-0.2, 0.25), (-0.2, -0.25)),
        ((0.5, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.5, -0.1)),
    ],
)
def test_footprint_collides_with_its_outline_and_its_inside(footprint: Any) -> None:
    """An outline that touches nothing still collides if an obstacle lies within it."""
    rng = np.random.default_rng(1)
    config = CONFIG.with_(footprint=footprint)
    hits = []
    for number in range(400):
        circles, segments = draw_obstacles(rng, 3, 1.0, 0.5)
        world = World(circles) if number % 2 else World(segments=segments)
        x, y, theta = rng.uniform((-0.3, -0.3, -7), (0.3, 0.3, 7)).tolist()

        cos = math.cos(theta)
        sin = math.sin(theta)
        outline = np.array(config.outline) @ [[cos, sin], [-sin, cos]] + (x, y)
        ends = np.roll(outline, -1, axis=0)
        along = (ends - outline)[:, None]
        places = np.concatenate([world.circles[:, :2], world.segments[:, :2]])
        offset = places - outline[:, None]
        is_inside = along[..., 0] * offset[..., 1] > along[..., 1] * offset[..., 0]

        touches = segment_clearance(outline, ends, world).min() <= 0.0
        around = make_surroundings(world, None, config)
        hits.append(footprint_collides(x, y, cos, sin, which=0, around=around))
        assert hits[-1] == (touches or is_inside.all(axis=0).any())
    assert 20 < sum(hits) < 380


ROOM = World(np.array([[0.0, 0.0, 0.5]]), np.array([[2.0, -1.0, 2.0, 1.0]]))


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        ((0.0, 2.0), None, 1.5),
        ((2.0, 3.0), None, 2.0),
        ((0.1, 0.0), None, -0.4),
        ((-1.0, 0.2), (1.0, 0.2), -0.3),  # into the circle
        ((-3.0, 1.0), (3.0, 1.0), 0.0),  # through the end of the segment
        ((2.0, -3.0), (2.0, 3.0), 0.0),  # along the segment
        ((3.0, 0.0), (5.0, 0.0), 1.0),
    ],
)
def test_clearance_by_hand(a: Any, b: Any, expected: float) -> None:
    distances = point_clearance([a], ROOM) if b is None else segment_clearance([a], [b], ROOM)
    assert distances[0] == pytest.approx(expected, abs=1e-15)
