"""Rays and collisions against brute force in plain NumPy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.worlds.geometry import (
    Obstacles,
    RaySpec,
    Surroundings,
    cast_rays,
    footprint_collides,
    make_surroundings,
)

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
    ranges = np.empty(len(around.directions))
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


def test_rays_of_a_full_turn_are_evenly_spaced_without_a_double() -> None:
    angles = RaySpec(8).angles()
    assert np.diff(angles) == pytest.approx(math.pi / 4)
    assert angles[-1] - angles[0] < 2.0 * math.pi - 0.1
    ends = RaySpec(5, 1.0, math.pi).angles()
    assert (ends[0], ends[-1]) == pytest.approx((-math.pi / 2, math.pi / 2))


def test_an_empty_world_is_seen_at_full_reach() -> None:
    around = make_surroundings(Obstacles(), RaySpec(16, 7.5), 1, CONFIG)
    assert (seen(around, (1.0, 2.0, 3.0)) == 7.5).all()


def test_from_inside_an_obstacle_everything_is_near() -> None:
    around = make_surroundings(Obstacles([[0.0, 0.0, 2.0]]), RaySpec(16), 1, CONFIG)
    assert (seen(around, (0.5, 0.0, 0.0)) == 0.0).all()


SPACING = 0.0031
"""No point of the footprint is farther from the nearest point of its grid [m]."""


def footprint(pose: Pose, scale: float) -> np.ndarray[Any, Any]:
    """A grid of points all over the footprint, its border and corners included."""
    half = scale * np.array([CONFIG.body.length, CONFIG.body.width]) / 2.0
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 81), np.linspace(-1, 1, 81)), axis=-1)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    turned = grid.reshape(-1, 2) * half @ np.array([[c, s], [-s, c]]) + np.array(pose[:2])
    return np.asarray(turned)


def gap_to_circles(points: Any, circles: Any) -> float:
    return min(float(np.linalg.norm(points - c[:2], axis=1).min() - c[2]) for c in circles)


def gap_to_segments(points: Any, segments: Any) -> float:
    best = math.inf
    for x1, y1, x2, y2 in segments:
        start, along = np.array([x1, y1]), np.array([x2 - x1, y2 - y1])
        share = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
        apart = points - start - share[:, None] * along
        best = min(best, float(np.linalg.norm(apart, axis=1).min()))
    return best


@pytest.mark.parametrize("kind", ["circles", "segments"])
def test_collisions_are_those_of_a_dense_grid_of_points(kind: str) -> None:
    """What meets a slightly smaller footprint is hit, what misses every point is not."""
    rng = np.random.default_rng(3)
    gaps = {"circles": gap_to_circles, "segments": gap_to_segments}
    hits = misses = 0
    for seed in range(80):
        circles, segments = scene(seed)
        pose = (*rng.uniform(-4, 4, 2), rng.uniform(-7.0, 7.0))
        if kind == "circles":
            around, shapes, gap = Obstacles(circles), circles, gaps[kind]
        else:
            around, shapes, gap = Obstacles((), segments), segments, gaps[kind]
        tools = make_surroundings(around, None, 1, CONFIG)
        found = footprint_collides(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), 0, tools)
        if gap(footprint(pose, 0.96), shapes) <= SPACING:
            assert found
            hits += 1
        elif gap(footprint(pose, 1.0), shapes) > SPACING:
            assert not found
            misses += 1
    assert hits > 5
    assert misses > 5


@pytest.mark.parametrize(
    ("pose", "hit"),
    [
        ((0.0, 0.0, 0.0), False),
        ((0.031, 0.0, 0.0), True),
        ((0.029, 0.0, 0.0), False),
        ((0.0, 0.0, math.pi / 4), True),
    ],
)
def test_a_wall_just_ahead_is_touched_exactly(pose: Pose, hit: bool) -> None:
    """Half the length is 0.17 m; turned by 45 degrees the corner reaches 0.24 m."""
    around = make_surroundings(Obstacles((), [[0.2, -5.0, 0.2, 5.0]]), None, 1, CONFIG)
    assert (
        footprint_collides(pose[0], pose[1], math.cos(pose[2]), math.sin(pose[2]), 0, around) == hit
    )


def test_a_wall_through_the_footprint_is_touched_though_no_end_is_inside() -> None:
    around = make_surroundings(Obstacles((), [[0.0, -5.0, 0.0, 5.0]]), None, 1, CONFIG)
    assert footprint_collides(0.05, 0.0, 1.0, 0.0, 0, around)


@pytest.mark.parametrize(
    ("circles", "segments"),
    [
        ([[0.0, 0.0]], ()),
        ([[0.0, 0.0, -1.0]], ()),
        ([[0.0, math.nan, 1.0]], ()),
        ((), [[1.0, 2.0, 3.0]]),
        (np.zeros((7, 2, 3)), ()),
        ("abc", ()),
    ],
)
def test_malformed_obstacles_are_one_clear_error(circles: Any, segments: Any) -> None:
    with pytest.raises(ConfigError, match="obstacles"):
        Obstacles(circles, segments).arrays(3)


@pytest.mark.parametrize("spec", [(0,), (8, -1.0), (8, 1.0, 7.0), (8, math.inf)])
def test_malformed_sensors_are_one_clear_error(spec: tuple[Any, ...]) -> None:
    with pytest.raises(ConfigError, match="must"):
        RaySpec(*spec)
