"""Collisions of footprints that are polygons, against brute force and against the box."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.worlds.geometry import Obstacles, footprint_collides, make_surroundings

CONFIG = RobotConfig.preset("acsar")
NOTCHED = ((0.3, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.3, -0.2), (0.05, 0.0))
STAR = tuple(
    (r * math.cos(a), r * math.sin(a))
    for r, a in zip([0.35, 0.1] * 5, np.arange(10) * math.pi / 5.0, strict=True)
)
ASIDE = ((0.5, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.5, -0.1))
SHAPES: dict[str, Any] = {"notched": NOTCHED, "star": STAR, "aside": ASIDE}
GRID = 0.004
"""Between the points of a grid over a footprint [m]."""


def hits(config: RobotConfig, circles: Any, segments: Any, poses: Any) -> list[bool]:
    around = make_surroundings(Obstacles(circles, segments), None, 1, config)
    return [
        footprint_collides(x, y, math.cos(a), math.sin(a), 0, around) for x, y, a in poses.tolist()
    ]


def points(outline: Any, grow: float) -> Any:
    """A grid over an outline, moved outwards or inwards by `grow` along x or y [m]."""
    span = np.arange(-0.6, 0.6, GRID)
    x, y = (axis.ravel() for axis in np.meshgrid(span, span))
    inside = np.zeros(len(x), np.bool_)
    for (ax, ay), (bx, by) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < ax + (bx - ax) * (y - ay) / (by - ay))
    held = np.column_stack([x, y])[inside]
    if grow < 0.0:
        apart = [to_segments(held, [[*a, *b]]) for a, b in sides(outline)]
        held = held[np.min(apart, axis=0) > -grow]
    return held


def sides(outline: Any) -> Any:
    return zip(outline, (*outline[1:], outline[0]), strict=True)


def to_segments(places: Any, segments: Any) -> Any:
    """Distance of every point to the nearest segment [m]."""
    best = np.full(len(places), np.inf)
    for x1, y1, x2, y2 in np.asarray(segments):
        start, along = np.array([x1, y1]), np.array([x2 - x1, y2 - y1])
        share = np.clip((places - start) @ along / (along @ along), 0.0, 1.0)
        best = np.minimum(best, np.linalg.norm(places - start - share[:, None] * along, axis=1))
    return best


def gap(places: Any, circles: Any, segments: Any) -> float:
    """From the nearest point to the nearest obstacle [m]."""
    apart = np.linalg.norm(places[:, None] - circles[None, :, :2], axis=2) - circles[:, 2]
    to_circles = float(apart.min(initial=math.inf))
    return min(to_circles, float(to_segments(places, segments).min(initial=math.inf)))


@pytest.mark.parametrize("kind", ["circles", "segments"])
@pytest.mark.parametrize("name", SHAPES)
def test_collisions_are_those_of_a_dense_grid_of_points(name: str, kind: str) -> None:
    rng, config = np.random.default_rng(1), CONFIG.with_(footprint=SHAPES[name])
    outline = config.outline
    whole, core = points(outline, 0.0), points(outline, -GRID)
    counts = {True: 0, False: 0}
    for _ in range(60):
        circles = np.column_stack([rng.uniform(-1.0, 1.0, (3, 2)), rng.uniform(0.0, 0.2, 3)])
        starts = rng.uniform(-1.0, 1.0, (3, 2))
        segments = np.column_stack([starts, starts + rng.uniform(-0.5, 0.5, (3, 2))])
        pose = np.array([[*rng.uniform(-0.3, 0.3, 2), rng.uniform(-7.0, 7.0)]])
        c, s = math.cos(pose[0, 2]), math.sin(pose[0, 2])
        turn = np.array([[c, s], [-s, c]])
        there = circles[:0] if kind == "segments" else circles
        walls = segments[:0] if kind == "circles" else segments
        found = hits(config, there, walls, pose)[0]
        if gap(core @ turn + pose[0, :2], there, walls) <= GRID / 2.0:
            assert found
            counts[True] += 1
        elif gap(whole @ turn + pose[0, :2], there, walls) > 2.0 * GRID:
            assert not found
            counts[False] += 1
    assert min(counts.values()) > 5


def test_a_rectangle_given_as_a_polygon_is_the_box() -> None:
    rng = np.random.default_rng(2)
    polygon = CONFIG.with_(footprint=CONFIG.outline)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        circles = np.column_stack([rng.uniform(-2, 2, (8, 2)), rng.uniform(0.0, 0.3, 8)])
        starts = rng.uniform(-2, 2, (8, 2))
        segments = np.column_stack([starts, starts + rng.uniform(-1, 1, (8, 2))])
        poses = rng.uniform(-2.0, 2.0, (200, 3))
        found = hits(CONFIG, circles, segments, poses)
        assert hits(polygon, circles, segments, poses) == found
        assert 0 < sum(found) < 200


@pytest.mark.parametrize(
    ("circle", "hit"),
    [
        ((0.25, 0.0, 0.04), False),  # in the notch
        ((0.25, 0.0, 0.14), True),
        ((-0.1, 0.0, 0.01), True),  # within
        ((0.0, 0.0, 5.0), True),  # around
        ((-0.26, 0.26, 0.08), False),  # beyond a corner
        ((-0.26, 0.26, 0.09), True),
    ],
)
def test_circles_in_and_beside_a_notch(circle: tuple[float, ...], hit: bool) -> None:
    config = CONFIG.with_(footprint=NOTCHED)
    assert hits(config, [circle], (), np.zeros((1, 3))) == [hit]


@pytest.mark.parametrize(
    ("segment", "hit"),
    [
        ((0.2, -0.02, 0.2, 0.02), False),  # in the notch
        ((0.2, -0.5, 0.2, 0.5), True),  # through both horns
        ((-0.1, 0.0, -0.05, 0.0), True),  # within
        ((0.3, -0.1, 0.3, 0.1), False),  # before the notch
        ((-0.2, 0.5, -0.2, -0.5), True),  # along a side
        ((-0.5, 0.2001, 0.5, 0.2001), False),
    ],
)
def test_walls_in_and_beside_a_notch(segment: tuple[float, ...], hit: bool) -> None:
    config = CONFIG.with_(footprint=NOTCHED)
    assert hits(config, (), [segment], np.zeros((1, 3))) == [hit]
    assert hits(config, (), [(*segment[2:], *segment[:2])], np.zeros((1, 3))) == [hit]
