"""The tyre and motor model against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from acsar_gym.config import BodyConfig, RobotConfig
from acsar_gym.physics import GRAVITY, compute_physics, model
from acsar_gym.physics.model import Velocity, loop_period, wheel_speed
from acsar_gym.protocol import ZERO, Speeds

DT = loop_period(RobotConfig())


def slide(
    velocity: Velocity, wheels: Speeds, config: RobotConfig | None = None, steps: int = 1
) -> Velocity:
    physics = compute_physics(config or RobotConfig())
    for _ in range(steps):
        velocity = model.tyre_step(*velocity, wheels, physics=physics, kappa=physics.kappa, dt=DT)
    return velocity


@pytest.mark.parametrize("seed", range(20))
def test_tyre_step_of_mirrored_robots_is_a_mirror_image(seed: int) -> None:
    outer, inner, vx, vy, rate = np.random.default_rng(seed).uniform(-5.0, 5.0, 5).tolist()
    ahead, sideways, turned = slide((vx, -vy, -rate), (inner, outer, outer, inner))
    mirrored = (ahead, -sideways, -turned)
    assert slide((vx, vy, rate), (outer, inner, inner, outer)) == pytest.approx(mirrored, abs=1e-9)


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
