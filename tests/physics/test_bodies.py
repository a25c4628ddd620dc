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
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.body import Body
from acsar_gym.physics.bullet import BulletBody
from acsar_gym.physics.model import closed_form_yaw_rate
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
AHEAD: Speeds = (8.0, 8.0, 8.0, 8.0)
SECOND = 200
"""Firmware loops."""
TURNS: list[Speeds] = [(4.0, -4.0, -4.0, 4.0), (8.0, 4.0, 4.0, 8.0), (3.0, 7.0, 7.0, 3.0)]
WEDGE: Any = ((0.3, 0.0), (-0.2, 0.25), (-0.2, -0.25))
WALL = World(segments=np.array([[1.0, -1.0, 1.0, 1.0]]))
OBSTACLES = [
    (None, World(np.array([[1.0, 0.0, 0.2]]))),
    (None, World(segments=np.array([[0.8, -0.3, 1.4, 1.0]]))),
    (WEDGE, World(np.array([[1.0, 0.15, 0.05]]))),
    (WEDGE, WALL),
]


@pytest.fixture
def body() -> Iterator[BulletBody]:
    made = BulletBody(RobotConfig())
    yield made
    made.close()


def drive(body: Body, set_points: Speeds, loops: int) -> None:
    for _ in range(loops):
        body.step(set_points)


def mean_yaw_rate(body: Body, turn: Speeds) -> float:
    """Yaw rate over a second, after two seconds [rad/s]."""
    drive(body, turn, 2 * SECOND)
    theta = body.truth.pose[2]
    drive(body, turn, SECOND)
    return math.remainder(body.truth.pose[2] - theta, math.tau)


def touches_at(body: Body, world: World) -> float:
    """How far the robot has come when it touches something [m]."""
    body.reset(Scene(world=world))
    for _ in range(1000):
        body.step(AHEAD)
        body.feel()
        if body.truth.contact:
            return body.truth.pose[0]
    return math.nan


@pytest.mark.parametrize("turn", TURNS)
def test_steady_turns_are_the_closed_form_at_every_heading(turn: Speeds) -> None:
    config = RobotConfig(wheel_radius=0.0825, wheel_separation=0.545, wheelbase=0.512)
    body, rates = BulletBody(config), []
    for eighth in range(8):
        body.reset(Scene(start=(1.0, -2.0, math.pi / 4 * eighth + 0.1)))
        rates.append(mean_yaw_rate(body, turn))
    body.close()
    expected = closed_form_yaw_rate(turn, config)
    assert rates == pytest.approx([expected] * 8, rel=0.01)
    assert max(rates) - min(rates) < 0.005 * abs(expected)


@pytest.mark.parametrize("name", ["planar", "bullet"])
def test_turns_follow_the_turn_factor_and_the_wheels_radii(name: str) -> None:
    config = RobotConfig(left_wheel_radius_multiplier=0.96, right_wheel_radius_multiplier=1.02)
    body = make_body(name, config.with_(body={"turn_factor": 1.6}))
    for right, left, _, _ in (AHEAD, *TURNS):
        expected = 0.05 * (right * 1.02 - left * 0.96) / 0.3 / 1.6
        assert mean_yaw_rate(body, (right, left, left, right)) == pytest.approx(expected, rel=0.01)
    body.close()


def test_a_reset_body_repeats_a_fresh_body_bit_for_bit(body: BulletBody) -> None:
    def drive_some() -> list[Any]:
        body.reset(Scene(start=(0.3, 0.1, 1.0)))
        truths = []
        for turn in (*TURNS, ZERO):
            drive(body, turn, 50)
            truths.append(body.truth)
        return truths

    fresh = drive_some()
    body.reset(Scene(start=(-5.0, 2.0, -2.0)))
    drive(body, (9.0, 2.0, 2.0, 9.0), 333)
    assert drive_some() == fresh


def test_the_picture_shows_robot_and_goal(body: BulletBody) -> None:
    empty = body.image(160, 120)
    body.reset(Scene(goal=(0.5, 0.0)))
    marked = body.image(160, 120)
    assert marked.shape == (120, 160, 3)
    assert marked.std() > 5.0
    assert (empty != marked).any()


@pytest.mark.parametrize(("outline", "world"), OBSTACLES)
def test_both_bodies_touch_at_the_same_place(outline: Any, world: World) -> None:
    config = ACSAR.with_(footprint=outline)
    bullet, planar = make_body("bullet", config), make_body("planar", config)
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

    def reset_often(count: int) -> int:
        for _ in range(count):
            body.reset(MEMORY[name](rng))
            body.step(AHEAD)
        gc.collect()
        return int(process.memory_info().rss)

    warm = reset_often(100)
    assert reset_often(400) - warm < 1_000_000
