"""What is the planar body's own; test_comparison holds it against PyBullet."""

from __future__ import annotations

import math

import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.physics.body import Camera
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import ZERO
from acsar_gym.worlds import Scene

SECOND = 200


def test_reset_puts_the_robot_at_the_start_at_rest() -> None:
    body = PlanarBody(RobotConfig())
    for _ in range(SECOND):
        body.step((5.0, 9.0, 9.0, 5.0))
    body.reset(Scene(start=(1.0, 2.0, 4.0)))
    assert body.truth.pose == pytest.approx((1.0, 2.0, 4.0 - 2.0 * math.pi))
    assert body.truth.twist == (0.0, 0.0)
    assert body.wheel_angles == ZERO


def test_the_planar_robot_has_no_camera() -> None:
    assert not isinstance(PlanarBody(RobotConfig()), Camera)
