"""Rays, collisions and distances against brute force, by hand, and against PyBullet."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.worlds import World
from acsar_gym.worlds.geometry import (
    Obstacles,
    RaySpec,
    Surroundings,
    cast_rays,
    footprint_collides,
    make_surroundings,
    measure_ranges,
    point_clearance,
    segment_clearance,
)
from acsar_gym.worlds.movers import walk

CONFIG = RobotConfig.preset("acsar")
SPECS = [RaySpec(64), RaySpec(33, 3.0, math.radians(270.0)), RaySpec(1, 4.0, 1.0), RaySpec(360)]
Pose = tuple[float, float, float]


def scene(seed: int) -> tuple[Any, Any]:
    """Random circles (40, 3) and segments (40, 4)."""
    rng = np.random.default_rng(seed)
    circles = np.column_stack([rng.uniform(-5, 5, (40, 2)), rng.uniform(0.0, 0.4, 40)])
    starts = rng.uniform(-5, 5, (40, 2))
    return circles, np.column_stack([starts, starts + rng.uniform(-2, 2, (40, 2))])


def seen(around: Surroundings, pose: Pose) -> np.ndarray[Any, Any]:
    ranges = np.empty(around.directions.shape[1])
    cast_rays(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), 0, around, ranges)
    return ranges


def brute_ray(origin: Any, direction: Any, circles: Any, segments: Any, reach: float) -> float:
    best = reach
    for x, y, radius in circles:
        to = np.array([x, y]) - origin
        if to @ to <= radius**2:
            return 0.0
        along = to @ direction
        inside = along**2 - (to @ to - radius**2)
        if inside >= 0.0 and along > 0.0:
            best = min(best, along - math.sqrt(inside))
    for x1, y1, x2, y2 in segments:
        matrix = np.array([direction, [x1 - x2, y1 - y2]]).T
        distance, share = np.linalg.solve(matrix, np.array([x1, y1]) - origin)
        if distance >= 0.0 and 0.0 <= share <= 1.0:
            best = min(best, float(distance))
    return best


@pytest.mark.parametrize("spec", SPECS, ids=lambda spec: str(spec.rays))
def test_rays_are_those_of_brute_force(spec: RaySpec) -> None:
    circles, segments = scene(1)
    around = make_surroundings(Obstacles(circles, segments), spec, 1, CONFIG)
    rng = np.random.default_rng(2)
    for _ in range(8):
        pose = (*rng.uniform(-4, 4, 2), rng.uniform(-7.0, 7.0))
        turn = np.array([math.cos(pose[2]), math.sin(pose[2])])
        origin = np.array(pose[:2]) + CONFIG.lidar_x_offset * turn
        expected = [
            brute_ray(origin, np.array([math.cos(a), math.sin(a)]), circles, segments, spec.reach)
            for a in spec.angles() + pose[2]
        ]
        assert seen(around, pose) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(("circles", "expected"), [((), 7.5), ([[0.0, 0.0, 2.0]], 0.0)])
def test_nothing_is_seen_at_full_reach_and_all_from_inside(circles: Any, expected: float) -> None:
    around = make_surroundings(Obstacles(circles), RaySpec(16, 7.5), 1, CONFIG)
    assert (seen(around, (0.5, 0.0, 3.0)) == expected).all()


POINTED = ((0.3, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.3, -0.2), (0.4, 0.0))
ROUND = tuple((0.35 * math.cos(a), 0.35 * math.sin(a)) for a in np.arange(10) * math.pi / 5.0)
ASIDE = ((0.5, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.5, -0.1))
SHAPES: dict[str, Any] = {"pointed": POINTED, "round": ROUND, "aside": ASIDE}


def hits(config: RobotConfig, circles: Any, segments: Any, poses: Any) -> list[bool]:
    around = make_surroundings(Obstacles(circles, segments), None, 1, config)
    return [
        footprint_collides(x, y, math.cos(a), math.sin(a), 0, around) for x, y, a in poses.tolist()
    ]


def is_inside(outline: Any, place: Any) -> bool:
    """Whether a ray from the place crosses the outline an odd number of times."""
    (ax, ay), (bx, by) = outline.T, np.roll(outline, -1, axis=0).T
    passed = (ay > place[1]) != (by > place[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        right = place[0] < ax + (bx - ax) * (place[1] - ay) / (by - ay)
    return bool((passed & right).sum() % 2)


@pytest.mark.parametrize("kind", ["circles", "segments"])
@pytest.mark.parametrize("name", SHAPES)
def test_collisions_are_those_of_the_outline_and_what_is_in_it(name: str, kind: str) -> None:
    rng, config = np.random.default_rng(1), CONFIG.with_(footprint=SHAPES[name])
    found = []
    for _ in range(200):
        circles = np.column_stack([rng.uniform(-1.0, 1.0, (3, 2)), rng.uniform(0.0, 0.2, 3)])
        starts = rng.uniform(-1.0, 1.0, (3, 2))
        segments = np.column_stack([starts, starts + rng.uniform(-0.5, 0.5, (3, 2))])
        world = World(circles, ()) if kind == "circles" else World((), segments)  # type: ignore[arg-type]
        pose = np.array([[*rng.uniform(-0.3, 0.3, 2), rng.uniform(-7.0, 7.0)]])
        c, s = math.cos(pose[0, 2]), math.sin(pose[0, 2])
        outline = np.array(config.outline) @ [[c, s], [-s, c]] + pose[0, :2]
        apart = segment_clearance(outline, np.roll(outline, -1, axis=0), world).min()
        places = [*world.circles[:, :2], *world.segments[:, :2]]
        expected = apart <= 0.0 or any(is_inside(outline, place) for place in places)
        assert hits(config, world.circles, world.segments, pose) == [expected]
        found.append(expected)
    assert 20 < sum(found) < 180


@pytest.mark.parametrize(
    ("x", "theta", "hit"),
    [(0.0, 0.0, False), (0.031, 0.0, True), (0.029, 0.0, False), (0.0, math.pi / 4, True)],
)
def test_a_wall_just_ahead_is_touched_exactly(x: float, theta: float, hit: bool) -> None:
    """Half the length is 0.17 m; turned by 45 degrees the corner reaches 0.24 m."""
    assert hits(CONFIG, (), [[0.2, -5.0, 0.2, 5.0]], np.array([[x, 0.0, theta]])) == [hit]


ROOM = World(circles=[[0.0, 0.0, 0.5]], segments=[[2.0, -1.0, 2.0, 1.0]])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("a", "b", "expected"),
    [
        *(((0.0, 2.0), None, 1.5), ((1.5, 0.0), None, 0.5), ((2.0, 0.3), None, 0.0)),
        *(((2.0, 3.0), None, 2.0), ((5.0, 5.0), None, 5.0), ((0.1, 0.0), None, -0.4)),
        ((-1.0, 0.2), (1.0, 0.2), -0.3),  # into the circle
        ((-3.0, 1.0), (3.0, 1.0), 0.0),  # through the end of the segment
        ((-3.0, 2.0), (3.0, 2.0), 1.0),
        ((2.0, -3.0), (2.0, 3.0), 0.0),  # along the segment
        ((3.0, 0.0), (5.0, 0.0), 1.0),
        ((0.0, 4.0), (0.0, 4.0), 3.5),  # a point
    ],
)
def test_distances_by_hand(a: Any, b: Any, expected: float) -> None:
    found = point_clearance([a], ROOM) if b is None else segment_clearance([a], [b], ROOM)
    assert found[0] == pytest.approx(expected, abs=1e-15)


def test_rays_at_any_bearings_meet_movers_where_each_was_then() -> None:
    """As a standing circle there would be met."""
    circles, segments = scene(4)
    movers = tuple(walk([[0.0, 0.0]], radius=radius) for radius in (0.3, 0.1))
    world = World(circles, segments, movers=movers)
    rng = np.random.default_rng(5)
    bearings, moved = rng.uniform(-3.0, 3.0, 60), rng.uniform(-3.0, 3.0, (60, 2, 2))
    ranges = measure_ranges((0.2, 0.1), bearings, world, moved)
    for bearing, places, distance in zip(bearings.tolist(), moved, ranges.tolist(), strict=True):
        rows = [[*place, mover.radius] for place, mover in zip(places, movers, strict=True)]
        standing = World(np.concatenate([circles, rows]), segments)
        (expected,) = measure_ranges((0.2, 0.1), np.array([bearing]), standing)
        assert distance == expected
    assert (ranges != measure_ranges((0.2, 0.1), bearings, world)).any()
