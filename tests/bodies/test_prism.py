"""A robot whose footprint is a polygon in PyBullet, against the planar body."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import border_distance, contains_point
from acsar_gym.physics.body import Body
from acsar_gym.physics.bullet import BulletBody, _feet, _hubs
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
WEDGE: Any = ((0.3, 0.0), (-0.2, 0.25), (-0.2, -0.25))
FORK: Any = (
    (0.3, 0.2),
    (-0.2, 0.2),
    (-0.2, -0.2),
    (0.3, -0.2),
    (0.3, -0.1),
    (0.05, 0.0),
    (0.3, 0.1),
)
AHEAD = (8.0, 8.0, 8.0, 8.0)
OBSTACLES = {
    "pillar ahead": World(np.array([[1.0, 0.0, 0.05]])),
    "pillar aside": World(np.array([[1.0, 0.15, 0.05]])),
    "wall across": World(segments=np.array([[1.0, -1.0, 1.0, 1.0]])),
}


def touches_at(body: Body, world: World) -> float:
    """How far the robot has come when it touches something [m]."""
    body.reset(Scene(world=world))
    for _ in range(1000):
        body.step(AHEAD)
        body.feel()
        if body.truth.contact:
            return body.truth.pose[0]
    return math.nan


@pytest.mark.parametrize("outline", [WEDGE, FORK], ids=["wedge", "fork"])
def test_both_bodies_touch_at_the_same_place(outline: Any) -> None:
    config = ACSAR.with_(footprint=outline)
    bullet, planar = BulletBody(config), PlanarBody(config)
    for world in OBSTACLES.values():
        assert touches_at(bullet, world) == pytest.approx(touches_at(planar, world), abs=0.006)
    bullet.close()


def test_a_notch_is_open() -> None:
    config = ACSAR.with_(footprint=FORK)
    place = {name: touches_at(PlanarBody(config), world) for name, world in OBSTACLES.items()}
    assert place["pillar ahead"] > place["wall across"] + 0.1


def test_a_polygon_drives_as_the_box_does() -> None:
    ends = []
    for config in (ACSAR, ACSAR.with_(footprint=WEDGE), ACSAR.with_(footprint=FORK)):
        body = BulletBody(config)
        for _ in range(200):
            body.step((6.0, 8.0, 8.0, 6.0))
        ends.append(body.truth.pose)
        body.close()
    assert ends[1] == pytest.approx(ends[0], abs=1e-6)
    assert ends[2] == pytest.approx(ends[0], abs=1e-6)


@pytest.mark.parametrize("outline", [None, WEDGE, FORK], ids=["box", "wedge", "fork"])
def test_feet_stand_within_the_footprint(outline: Any) -> None:
    config = ACSAR.with_(footprint=outline)
    feet, foot = _feet(config)
    assert 1e-3 <= foot <= config.wheel_radius
    for (x, y), hub in zip(feet, _hubs(config), strict=True):
        assert contains_point(config.outline, x, y)
        assert border_distance(config.outline, x, y) >= foot - 1e-12
        assert x * hub[1] == pytest.approx(y * hub[0])
        if outline is None:
            assert (x, y) == hub[:2]


def test_its_camera_sees_it() -> None:
    pictures = []
    for outline in (None, WEDGE):
        body = BulletBody(ACSAR.with_(footprint=outline))
        image = body.image(160, 120)
        assert image is not None
        pictures.append(image)
        body.close()
    assert (pictures[0] != pictures[1]).any()
