"""The planar robot against PyBullet's, under the same set points."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from acsar_gym.bodies.bullet import BulletBody
from acsar_gym.bodies.planar import PlanarBody
from acsar_gym.config import RobotConfig
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene

SECOND = 200


def slalom(step: int) -> Speeds:
    swing = 3.0 * math.sin(step / SECOND * 2.0)
    return (6.0 + swing, 6.0 - swing, 6.0 - swing, 6.0 + swing)


def drive_and_stop(step: int) -> Speeds:
    return (7.0, 5.0, 5.0, 7.0) if step < 5 * SECOND else ZERO


DRIVES: dict[str, Callable[[int], Speeds]] = {
    "straight": lambda _: (8.0, 8.0, 8.0, 8.0),
    "arc": lambda _: (8.0, 5.0, 5.0, 8.0),
    "slalom": slalom,
    "spin": lambda _: (4.0, -4.0, -4.0, 4.0),
    "stop": drive_and_stop,
}


@pytest.mark.parametrize("name", DRIVES)
def test_planar_and_bullet_end_in_the_same_place(name: str) -> None:
    planar, bullet = PlanarBody(RobotConfig()), BulletBody(RobotConfig())
    for step in range(10 * SECOND):
        set_points = DRIVES[name](step)
        planar.step(set_points)
        bullet.step(set_points)
    (x, y, theta), (bx, by, btheta) = planar.truth.pose, bullet.truth.pose
    bullet.close()
    assert math.hypot(x - bx, y - by) < 0.03
    assert abs(math.remainder(theta - btheta, 2.0 * math.pi)) < math.radians(2.0)
    assert planar.wheel_angles == pytest.approx(bullet.wheel_angles, abs=1e-9)


def test_reset_puts_the_robot_at_the_start_at_rest() -> None:
    body = PlanarBody(RobotConfig())
    for _ in range(SECOND):
        body.step((5.0, 9.0, 9.0, 5.0))
    body.reset(Scene(start=(1.0, 2.0, 4.0)))
    assert body.truth.pose == pytest.approx((1.0, 2.0, 4.0 - 2.0 * math.pi))
    assert body.truth.twist == (0.0, 0.0)
    assert body.wheel_angles == ZERO


def test_the_planar_robot_has_no_camera() -> None:
    assert PlanarBody(RobotConfig()).image(10, 10) is None
