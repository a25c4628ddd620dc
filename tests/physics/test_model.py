"""The tyre and motor model against closed forms."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.config import BodyConfig, MotorConfig, RobotConfig
from acsar_gym.physics import GRAVITY, compute_physics, model
from acsar_gym.physics.model import loop_period, tyre_step, wheel_speed
from acsar_gym.protocol import ZERO, Speeds

SPIN: Speeds = (4.0, -4.0, -4.0, 4.0)
DT = loop_period(RobotConfig())
speed = st.floats(-20.0, 20.0)
slow = st.floats(-2.0, 2.0)


def steady_yaw_rate(wheels: Speeds, config: RobotConfig) -> float:
    p, velocity = compute_physics(config), (0.0, 0.0, 0.0)
    for _ in range(2000):
        velocity = tyre_step(*velocity, wheels, p, p.kappa, DT)
    return velocity[2]


def test_spin_on_the_spot_is_the_closed_form() -> None:
    config = RobotConfig()
    assert model.closed_form_yaw_rate(SPIN, config) == pytest.approx(0.867, abs=1e-3)
    assert steady_yaw_rate(SPIN, config) == pytest.approx(
        model.closed_form_yaw_rate(SPIN, config), rel=1e-6
    )


@given(speed, speed, slow, slow, slow)
def test_mirrored_robots_move_as_mirror_images(
    right: float, left: float, vx: float, vy: float, rate: float
) -> None:
    p = compute_physics(RobotConfig())
    x1, y1, w1 = tyre_step(vx, vy, rate, (right, left, left, right), p, p.kappa, DT)
    x2, y2, w2 = tyre_step(vx, -vy, -rate, (left, right, right, left), p, p.kappa, DT)
    assert (x1, y1, w1) == pytest.approx((x2, -y2, -w2), abs=1e-9)


def test_full_braking_obeys_the_friction_law() -> None:
    config = RobotConfig(body=BodyConfig(friction=0.5))
    p = compute_physics(config)
    vx, _, _ = tyre_step(1.0, 0.0, 0.0, ZERO, p, p.kappa, DT)
    assert (1.0 - vx) / DT == pytest.approx(0.5 * GRAVITY, rel=1e-4)


@pytest.mark.parametrize("kick", [(0.4, 0.0, 3.0), (0.5, 0.1, -2.0), (0.0, 0.3, 0.5)])
def test_locked_wheels_bring_the_robot_to_rest_without_chatter(
    kick: tuple[float, float, float],
) -> None:
    p = compute_physics(RobotConfig())
    velocity = kick
    for _ in range(200):
        velocity = tyre_step(*velocity, ZERO, p, p.kappa, DT)
    assert max(map(abs, velocity)) < 1e-6


def test_motor_lag_is_first_order() -> None:
    config = RobotConfig(motor=MotorConfig(time_constant=0.1))
    p = compute_physics(config)
    value = 0.0
    for _ in range(round(0.1 / DT)):
        value = wheel_speed(value, 10.0, 1.0, p.blend_a, p.deadband_a, p.max_speed)
    assert value == pytest.approx(10.0 * (1.0 - math.exp(-1.0)), rel=1e-9)


@pytest.mark.parametrize(
    ("motor", "speed", "set_point", "gain", "expected"),
    [
        ({"time_constant": 0.0}, 0.0, 7.0, 1.0, 7.0),  # without lag, at once
        ({}, 0.0, 1e6, 1.0, 30.0),
        ({"deadband": 1.0}, 0.0, 10.0, 0.9, 9.0),  # a gain comes before deadband and saturation
        ({"deadband": 1.0}, 0.0, 29.0, 1.1, 30.0),
    ],
)
def test_a_wheel_without_lag(
    motor: dict[str, float], speed: float, set_point: float, gain: float, expected: float
) -> None:
    own = {"max_speed": 30.0, "time_constant": 0.0, **motor}
    p = compute_physics(RobotConfig(motor=MotorConfig(**own)))
    assert wheel_speed(speed, set_point, gain, p.blend_a, p.deadband_a, p.max_speed) == expected
