"""Obstacles in PyBullet: where they stand, what they stop, and what they cost in memory."""

from __future__ import annotations

import gc
import math

import numpy as np
import psutil
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.physics.body import Body
from acsar_gym.physics.bullet import MAX_SHAPES, BulletBody, StaticObstacles
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
OBSTACLES = {
    "pillar ahead": World(np.array([[1.0, 0.0, 0.2]])),
    "pillar at a corner": World(np.array([[1.0, 0.3, 0.15]])),
    "wall across": World(segments=np.array([[1.0, -1.0, 1.0, 1.0]])),
    "wall aslant": World(segments=np.array([[0.8, -0.3, 1.4, 1.0]])),
    "end of a wall": World(segments=np.array([[0.9, 0.0, 2.0, 0.1]])),
}
AHEAD = (8.0, 8.0, 8.0, 8.0)


def touches_at(body: Body, world: World) -> float:
    """How far the robot has come when it touches something [m]."""
    body.reset(Scene(world=world))
    for _ in range(1000):
        body.step(AHEAD)
        body.feel()
        if body.truth.contact:
            return body.truth.pose[0]
    return math.nan


@pytest.mark.parametrize("name", OBSTACLES)
def test_both_bodies_touch_at_the_same_place(name: str) -> None:
    bullet, planar = BulletBody(ACSAR), PlanarBody(ACSAR)
    place = touches_at(bullet, OBSTACLES[name])
    assert place == pytest.approx(touches_at(planar, OBSTACLES[name]), abs=0.005)
    bullet.close()


def test_a_wall_stops_the_robot() -> None:
    body = BulletBody(ACSAR)
    touches_at(body, OBSTACLES["wall across"])
    for _ in range(400):
        body.step(AHEAD)
    assert body.truth.pose[0] == pytest.approx(1.0 - ACSAR.body.length / 2.0, abs=0.01)
    assert body.truth.contact
    body.close()


def test_a_near_miss_is_no_contact() -> None:
    """A pillar 5 mm beside the footprint."""
    beside = ACSAR.body.width / 2.0 + 0.1 + 0.005
    for body in (BulletBody(ACSAR), PlanarBody(ACSAR)):
        assert math.isnan(touches_at(body, World(np.array([[1.0, beside, 0.1]]))))
        assert body.truth.pose[0] > 1.5
        assert body.truth.pose[1:] == pytest.approx((0.0, 0.0), abs=1e-9)
        body.close()


def test_contact_is_forgotten_with_the_next_reset() -> None:
    body = BulletBody(ACSAR)
    touches_at(body, OBSTACLES["pillar ahead"])
    body.reset(Scene())
    body.feel()
    assert not body.truth.contact
    body.close()


def test_compounds_are_small_and_few() -> None:
    body = BulletBody(ACSAR)
    rng = np.random.default_rng(0)
    circles = np.column_stack([rng.uniform(-9, 9, (300, 2)), np.full(300, 0.1)])
    statics = StaticObstacles(body._client, World(circles))
    assert math.ceil(300 / MAX_SHAPES) <= len(statics) <= 1.3 * 300 / MAX_SHAPES
    assert len(StaticObstacles(body._client, None)) == 0
    body.close()


def test_the_same_world_is_built_once() -> None:
    body = BulletBody(ACSAR)
    world = OBSTACLES["pillar ahead"]
    body.reset(Scene(world=world))
    before = set(body._statics._bodies)
    body.reset(Scene(world=world))
    assert set(body._statics._bodies) == before
    body.close()


def test_memory_stays_flat_over_changing_worlds() -> None:
    body, process, rng = BulletBody(ACSAR), psutil.Process(), np.random.default_rng(0)

    def some_worlds(count: int) -> int:
        for _ in range(count):
            places = rng.uniform(1.0, 5.0, (40, 2))
            body.reset(Scene(world=World(np.column_stack([places, np.full(40, 0.1)]))))
            body.step(AHEAD)
        gc.collect()
        return int(process.memory_info().rss)

    before = some_worlds(100)
    grown = some_worlds(400) - before
    body.close()
    assert grown < 1_000_000
