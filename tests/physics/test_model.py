"""The tyre and motor model against closed forms."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsar_gym.config import BodyConfig, RobotConfig
from acsar_gym.physics import GRAVITY, compute_physics, model
from acsar_gym.physics.model import Velocity, loop_period, wheel_speed
from acsar_gym.protocol import ZERO, Speeds

SPIN: Speeds = (4.0, -4.0, -4.0, 4.0)
DT = loop_period(RobotConfig())
speed = st.floats(-20.0, 20.0)
slow = st.floats(-2.0, 2.0)


def slide(
    velocity: Velocity, wheels: Speeds, config: RobotConfig | None = None, steps: int = 1
) -> Velocity:
    physics = compute_physics(config or RobotConfig())
    for _ in range(steps):
        velocity = model.tyre_step(*velocity, wheels, physics=physics, kappa=physics.kappa, dt=DT)
    return velocity


def test_tyre_step_of_a_spin_is_the_closed_form() -> None:
    config = RobotConfig()
    closed_form = 8.0 * config.wheel_radius / config.wheel_separation / model.turn_factor(config)
    assert closed_form == pytest.approx(0.867, abs=1e-3)
    assert slide((0.0, 0.0, 0.0), SPIN, steps=2000)[2] == pytest.approx(closed_form, rel=1e-6)


@given(speed, speed, slow, slow, slow)
def test_tyre_step_of_mirrored_robots_is_a_mirror_image(
    right: float, left: float, vx: float, vy: float, rate: float
) -> None:
    ahead, sideways, turn = slide((vx, -vy, -rate), (left, right, right, left))
    mirrored = (ahead, -sideways, -turn)
    assert slide((vx, vy, rate), (right, left, left, right)) == pytest.approx(mirrored, abs=1e-9)


def test_tyre_step_of_full_braking_obeys_the_friction_law() -> None:
    vx, _, _ = slide((1.0, 0.0, 0.0), ZERO, RobotConfig(body=BodyConfig(friction=0.5)))
    assert (1.0 - vx) / DT == pytest.approx(0.5 * GRAVITY, rel=1e-4)


@pytest.mark.parametrize("kick", [(0.4, 0.0, 3.0), (0.5, 0.1, -2.0), (0.0, 0.3, 0.5)])
def test_tyre_step_with_locked_wheels_comes_to_rest_without_chatter(kick: Velocity) -> None:
    assert max(map(abs, slide(kick, ZERO, steps=200))) < 1e-6


@pytest.mark.parametrize(
    ("set_point", "gain", "expected"),
    [(1e6, 1.0, 30.0), (10.0, 0.9, 9.0), (1.05, 0.9, 0.0)],
)
def test_wheel_speed_has_its_gain_before_deadband_and_saturation(
    set_point: float, gain: float, expected: float
) -> None:
    assert wheel_speed(0.0, set_point, gain, blend=1.0, deadband=1.0, top=30.0) == expected
