"""Analytic rays against PyBullet's own rayTestBatch.

PyBullet stops a ray up to 1 mm beside a convex shape's surface, which at a grazing angle is a
centimetre of range; its rays meet triangles exactly. So ranges are compared on prisms of triangles
so fine that they differ from a cylinder by less than a millimetre at any angle, and on the env's
own PyBullet bodies it is the points hit that must lie on our surfaces.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pybullet
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.physics.bullet import BulletBody
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.generators import generate_world
from acsar_gym.worlds.geometry import (
    Obstacles,
    RaySpec,
    cast_rays,
    make_surroundings,
    measure_ranges,
    point_clearance,
)

CONFIG = RobotConfig.preset("acsar").with_(lidar_x_offset=0.0, lidar_y_offset=0.0)
SCENES = 1000
SIDES = 720
REACH = 5.0
RADII = np.linspace(0.03, 0.2, 12)
LENGTHS = np.linspace(0.3, 4.0, 8)
MILLIMETRE = 1e-3
Array = np.ndarray[Any, Any]


@pytest.fixture
def client() -> Iterator[int]:
    connected = pybullet.connect(pybullet.DIRECT)
    yield connected
    pybullet.disconnect(connected)


def prism(client: int, outline: Array, closed: bool) -> int:
    """A body of upright triangles along an outline (n, 2), around the origin."""
    count = len(outline)
    vertices = [(x, y, z) for z in (0.0, 1.0) for x, y in outline.tolist()]
    indices = []
    for i in range(count if closed else count - 1):
        j = (i + 1) % count
        indices += [i, j, count + j, i, count + j, count + i]
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_MESH,
        vertices=vertices,
        indices=indices,
        flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
        physicsClientId=client,
    )
    return int(pybullet.createMultiBody(0.0, shape, physicsClientId=client))


def bodies(client: int) -> list[int]:
    """Fine prisms for circles, and single walls for segments."""
    angles = np.arange(SIDES) * 2.0 * math.pi / SIDES
    ring = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    circles = [prism(client, radius * ring, closed=True) for radius in RADII]
    ends = np.array([[-0.5, 0.0], [0.5, 0.0]])
    return circles + [prism(client, length * ends, closed=False) for length in LENGTHS]


def pybullet_rays(client: int, angles: Array) -> tuple[Array, Array]:
    """Ranges from the origin, and the body that each ray meets, -1 for none."""
    starts = [(0.0, 0.0, 0.37)] * len(angles)
    ends = [(REACH * math.cos(a), REACH * math.sin(a), 0.37) for a in angles.tolist()]
    found = pybullet.rayTestBatch(starts, ends, physicsClientId=client)
    return np.array([ray[2] * REACH for ray in found]), np.array([ray[0] for ray in found])


def moved(client: int, made: list[int], rng: np.random.Generator) -> Array:
    """Put the bodies somewhere else around the origin; returns their poses (n, 3)."""
    bearing, distance = rng.uniform(-math.pi, math.pi, (2, len(made)))
    distance = 0.3 + np.abs(distance) * 1.5
    poses = np.stack(
        [distance * np.cos(bearing), distance * np.sin(bearing), rng.uniform(-3, 3, len(made))],
        axis=1,
    )
    for body, (x, y, theta) in zip(made, poses.tolist(), strict=True):
        turn = (0.0, 0.0, math.sin(theta / 2.0), math.cos(theta / 2.0))
        pybullet.resetBasePositionAndOrientation(body, (x, y, 0.0), turn, physicsClientId=client)
    return poses


def worlds_of(poses: Array) -> tuple[Array, Array]:
    """The same scene as circles and segments."""
    round_ones, walls = poses[: len(RADII)], poses[len(RADII) :]
    half = LENGTHS[:, None] / 2.0 * np.stack([np.cos(walls[:, 2]), np.sin(walls[:, 2])], axis=1)
    return (
        np.column_stack([round_ones[:, :2], RADII]),
        np.column_stack([walls[:, :2] - half, walls[:, :2] + half]),
    )


def ours(circles: Array, segments: Array, spec: RaySpec) -> tuple[Array, Array]:
    """Ranges of `cast`, and which obstacle is next to each point hit, -1 for none."""
    around = make_surroundings(Obstacles(circles, segments), spec, 1, CONFIG)
    ranges = np.empty(spec.rays)
    cast_rays(0.0, 0.0, 1.0, 0.0, 0, around, ranges)
    angles = spec.angles()
    points = ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    parts = [World(circles[k : k + 1]) for k in range(len(circles))]
    parts += [World(segments=segments[k : k + 1]) for k in range(len(segments))]
    off = np.abs(np.stack([point_clearance(points, part) for part in parts]))
    return ranges, np.where(ranges < REACH, off.argmin(axis=0), -1)


def test_ranges_are_those_of_rayTestBatch(client: int) -> None:  # noqa: N802 - PyBullet's name
    rng, spec = np.random.default_rng(0), RaySpec(64, REACH)
    made = bodies(client)
    inside = agree = rays = 0
    worst = 0.0
    for _ in range(SCENES):
        circles, segments = worlds_of(moved(client, made, rng))
        if (np.hypot(circles[:, 0], circles[:, 1]) <= circles[:, 2] + 0.01).any():
            inside += 1
            continue  # from within a circle all our ranges are zero
        theirs, body = pybullet_rays(client, spec.angles())
        ranges, which = ours(circles, segments, spec)
        same = np.array([made.index(b) if b >= 0 else -1 for b in body]) == which
        both = same & (which >= 0)
        worst = max(worst, float(np.abs(ranges - theirs)[both].max(initial=0.0)))
        agree += int((same & (np.abs(ranges - theirs) < MILLIMETRE)).sum())
        rays += spec.rays
    assert inside < SCENES / 20
    assert worst < MILLIMETRE
    assert agree / rays >= 0.999


def test_what_pybullet_hits_in_the_envs_bodies_lies_on_our_surfaces() -> None:
    body, rng = BulletBody(CONFIG), np.random.default_rng(0)
    angles = RaySpec(64, REACH).angles()
    hits = 0
    for number in range(10):
        world = generate_world("clutter", number)
        place = rng.uniform(-3.0, 3.0, 2)
        if point_clearance(place[None], world)[0] < 0.3:
            continue
        body.reset(Scene(start=(9.0, 9.0, 0.0), world=world))
        ranges = body.rays((float(place[0]), float(place[1])), angles, REACH)
        met = ranges < REACH
        points = place + ranges[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        assert (
            np.abs(point_clearance(points[met], world)).max() < 2.1 * MILLIMETRE
        )  # walls are 2 mm
        far = measure_ranges((float(place[0]), float(place[1])), angles, world)
        assert np.mean(np.abs(np.minimum(far, REACH) - ranges) < 5.0 * MILLIMETRE) > 0.9
        hits += int(met.sum())
    body.close()
    assert hits > 200
