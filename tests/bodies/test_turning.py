"""How fast robots turn on ground of any turn factor, on every body, against the closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.envs import PointGoalVectorEnv
from acsar_gym.physics.body import Body
from acsar_gym.physics.bullet import BulletBody
from acsar_gym.physics.model import closed_form_yaw_rate, turn_factor
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import Speeds
from acsar_gym.vector.kernel import layout

FACTORS = [1.2, 1.5378, 2.0]
TURNS: list[Speeds] = [
    (4.0, -4.0, -4.0, 4.0),
    (1.0, -1.0, -1.0, 1.0),
    (8.0, 4.0, 4.0, 8.0),
    (3.0, 7.0, 7.0, 3.0),
    (5.0, 0.0, 0.0, 5.0),
]
SECOND = 200


def on(factor: float | None, **changes: float) -> RobotConfig:
    return RobotConfig(**changes).with_(body={"turn_factor": factor})


def mean_yaw_rate(body: Body, turn: Speeds) -> float:
    """Yaw rate over a second, after two seconds [rad/s]."""
    for _ in range(2 * SECOND):
        body.step(turn)
    before = body.truth.pose[2]
    for _ in range(SECOND):
        body.step(turn)
    return math.remainder(body.truth.pose[2] - before, 2.0 * math.pi)


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


@pytest.mark.parametrize("factor", FACTORS)
def test_circles_are_larger_by_the_factor_at_the_same_speed(factor: float) -> None:
    for turn, plain in ((TURNS[2], 0.45), (TURNS[3], 0.375), (TURNS[4], 0.15)):
        body = PlanarBody(on(factor))
        rate, (speed, _) = mean_yaw_rate(body, turn), body.truth.twist
        assert speed == pytest.approx((turn[0] + turn[1]) / 2.0 * 0.05, rel=0.01)
        assert speed / abs(rate) == pytest.approx(plain * factor, rel=0.015)


@pytest.mark.parametrize("factor", FACTORS)
def test_a_batch_turns_as_commanded_where_its_multiplier_is_the_factor(factor: float) -> None:
    config = on(factor, wheel_separation_multiplier=factor, max_angular=1.2)
    env = PointGoalVectorEnv(5, robot=config, max_episode_steps=1000)
    env.reset(seed=0)
    actions = np.array([[0.0, 1.0], [0.0, -0.4], [0.3, 1.0], [0.6, 0.4], [0.2, -1.0]])
    for _ in range(15):
        env.step(actions)
    rates = env.batch.state[layout.RATE]
    assert rates == pytest.approx(actions[:, 1] * config.max_angular, rel=0.01)
    env.close()


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


def test_without_a_factor_the_geometry_gives_it() -> None:
    assert turn_factor(on(None)) == pytest.approx(1.5378, abs=1e-4)
    own = on(None, wheelbase=0.3)
    assert turn_factor(own) == 2.0
    for turn in TURNS:
        with_factor = mean_yaw_rate(PlanarBody(on(2.0, wheelbase=0.3)), turn)
        assert mean_yaw_rate(PlanarBody(own), turn) == pytest.approx(with_factor, rel=1e-9)


def test_tyres_that_grip_less_sideways_are_pushed_sideways_more_easily() -> None:
    """The friction of a sideways slide is sqrt(kappa) of that of locked wheels."""
    slides = []
    for factor in (1.2, None):
        body = PlanarBody(on(factor))
        body._velocity = (0.0, 0.5, 0.0)
        body.step((0.0, 0.0, 0.0, 0.0))
        slides.append(0.5 - body._velocity[1])
    kappa = 0.2 * (0.3 / 0.22) ** 2
    assert slides[0] / slides[1] == pytest.approx(math.sqrt(kappa), rel=1e-3)
