"""Bodies against closed forms, against each other, and at obstacles; PyBullet's memory."""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import psutil
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.physics.body import Body
from acsar_gym.physics.bullet import (
    BulletBody,
)
from acsar_gym.physics.model import closed_form_yaw_rate
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
AHEAD: Speeds = (8.0, 8.0, 8.0, 8.0)
SECOND = 200
FACTORS = [1.5378, 2.0]
GEOMETRIES = [(0.05, 0.30, 0.22), (0.0825, 0.545, 0.512)]
TURNS: list[Speeds] = [
    (4.0, -4.0, -4.0, 4.0),
    (8.0, 4.0, 4.0, 8.0),
    (3.0, 7.0, 7.0, 3.0),
]
HEADINGS = [math.pi / 4 * k + 0.1 for k in range(8)]
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
OBSTACLES = {
    "pillar ahead": World(np.array([[1.0, 0.0, 0.2]])),
    "wall across": World(segments=np.array([[1.0, -1.0, 1.0, 1.0]])),
    "wall aslant": World(segments=np.array([[0.8, -0.3, 1.4, 1.0]])),
}
SMALL = {
    "pillar ahead": World(np.array([[1.0, 0.0, 0.05]])),
    "pillar aside": World(np.array([[1.0, 0.15, 0.05]])),
    "wall across": OBSTACLES["wall across"],
}


@pytest.fixture
def body() -> Iterator[BulletBody]:
    made = BulletBody(RobotConfig())
    yield made
    made.close()


def on(factor: float | None, **changes: float) -> RobotConfig:
    return RobotConfig(**changes).with_(body={"turn_factor": factor})


def steps(body: Body, set_points: Speeds, count: int) -> None:
    for _ in range(count):
        body.step(set_points)


def mean_yaw_rate(body: Body, turn: Speeds) -> float:
    """Yaw rate over a second, after two seconds [rad/s]."""
    steps(body, turn, 2 * SECOND)
    before = body.truth.pose[2]
    steps(body, turn, SECOND)
    return math.remainder(body.truth.pose[2] - before, 2.0 * math.pi)


def touches_at(body: Body, world: World) -> float:
    """How far the robot has come when it touches something [m]."""
    body.reset(Scene(world=world))
    for _ in range(1000):
        body.step(AHEAD)
        body.feel()
        if body.truth.contact:
            return body.truth.pose[0]
    return math.nan


@pytest.mark.parametrize("geometry", GEOMETRIES)
@pytest.mark.parametrize("turn", TURNS[:3])
def test_steady_turns_are_the_closed_form_at_every_heading(
    geometry: tuple[float, float, float], turn: Speeds
) -> None:
    radius, separation, wheelbase = geometry
    config = RobotConfig(wheel_radius=radius, wheel_separation=separation, wheelbase=wheelbase)
    body, rates = BulletBody(config), []
    for heading in HEADINGS:
        body.reset(Scene(start=(1.0, -2.0, heading)))
        rates.append(mean_yaw_rate(body, turn))
    body.close()
    expected = closed_form_yaw_rate(turn, config)
    assert rates == pytest.approx([expected] * len(HEADINGS), rel=0.01)
    assert max(rates) - min(rates) < 0.005 * abs(expected)


@pytest.mark.parametrize("make", [PlanarBody, BulletBody])
@pytest.mark.parametrize("factor", FACTORS)
def test_steady_turns_are_slower_by_the_factor(make: type[Body], factor: float) -> None:
    config = on(factor)
    body = make(config)  # type: ignore[call-arg]
    for turn in TURNS:
        plain = (turn[0] - turn[1]) * config.wheel_radius / config.wheel_separation
        assert closed_form_yaw_rate(turn, config) == pytest.approx(plain / factor)
        assert mean_yaw_rate(body, turn) == pytest.approx(plain / factor, rel=0.01)
    body.close()


@pytest.mark.parametrize("make", [PlanarBody, BulletBody])
def test_wheels_of_different_radii_turn_a_robot_that_is_sent_straight(make: type[Body]) -> None:
    config = on(1.6, left_wheel_radius_multiplier=0.96, right_wheel_radius_multiplier=1.02)
    body = make(config)  # type: ignore[call-arg]
    straight = (8.0, 8.0, 8.0, 8.0)
    expected = 8.0 * 0.05 * (1.02 - 0.96) / 0.3 / 1.6
    assert closed_form_yaw_rate(straight, config) == pytest.approx(expected)
    assert mean_yaw_rate(body, straight) == pytest.approx(expected, rel=0.01)
    assert body.truth.twist[0] == pytest.approx(8.0 * 0.05 * 0.99, rel=0.01)
    body.close()


def drive_some(body: BulletBody) -> list[tuple[float, float, float]]:
    poses = []
    for turn in (*TURNS[:3], ZERO):
        for _ in range(50):
            body.step(turn)
            poses.append(body.truth.pose)
    return poses


def test_a_reset_body_repeats_a_fresh_one_bit_for_bit(body: BulletBody) -> None:
    start = Scene(start=(0.3, 0.1, 1.0))
    body.reset(start)
    fresh = drive_some(body)
    body.reset(Scene(start=(-5.0, 2.0, -2.0)))
    steps(body, (9.0, 2.0, 2.0, 9.0), 333)
    body.reset(start)
    assert drive_some(body) == fresh


def test_the_picture_shows_robot_and_goal(body: BulletBody) -> None:
    empty = body.image(160, 120)
    body.reset(Scene(goal=(0.5, 0.0)))
    marked = body.image(160, 120)
    assert empty is not None
    assert marked is not None
    assert marked.shape == (120, 160, 3)
    assert marked.std() > 5.0
    assert (empty != marked).any()


@pytest.mark.parametrize(
    ("outline", "worlds"),
    [(None, OBSTACLES), (WEDGE, SMALL), (FORK, SMALL)],
    ids=["box", "wedge", "fork"],
)
def test_both_bodies_touch_at_the_same_place(outline: Any, worlds: dict[str, World]) -> None:
    config = ACSAR.with_(footprint=outline)
    bullet, planar = BulletBody(config), PlanarBody(config)
    for world in worlds.values():
        assert touches_at(bullet, world) == pytest.approx(touches_at(planar, world), abs=0.006)
    bullet.close()


MEMORY: dict[str, Callable[[np.random.Generator], Scene]] = {
    "one world": lambda rng: Scene(goal=(1.0, 1.0)),
    "changing worlds": lambda rng: Scene(
        world=World(np.column_stack([rng.uniform(1.0, 5.0, (40, 2)), np.full(40, 0.1)]))
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MEMORY)
def test_memory_is_flat_over_resets(name: str, body: BulletBody) -> None:
    process, rng = psutil.Process(), np.random.default_rng(0)

    def some_resets(count: int) -> int:
        for _ in range(count):
            body.reset(MEMORY[name](rng))
            body.step(AHEAD)
        gc.collect()
        return int(process.memory_info().rss)

    before = some_resets(100)
    assert some_resets(400) - before < 1_000_000
