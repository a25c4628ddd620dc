"""MuJoCo's robot: the URDF's, on its own ground."""

from __future__ import annotations

from typing import Any

import mujoco
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.physics import compute_physics
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.body import Body
from acsar_gym.physics.mujoco import URDF, WHEELS, MujocoBody
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")
SECOND = 200
"""Firmware loops."""


def drive(body: Body, speed: float, loops: int) -> None:
    for _ in range(loops):
        body.step((speed, speed, speed, speed))


def test_mujoco_robot_of_the_preset_is_the_urdfs() -> None:
    made = MujocoBody(ACSAR)._model
    spec = mujoco.MjSpec.from_file(str(URDF))
    spec.body("base_footprint").add_freejoint()
    urdf = spec.compile()
    for name in ("base_footprint", "base_link", "lidar_link", *WHEELS):
        assert made.body(name).mass == pytest.approx(urdf.body(name).mass, rel=1e-5)
        inertia = sorted(urdf.body(name).inertia)
        assert sorted(made.body(name).inertia) == pytest.approx(inertia, rel=0.02)
        assert made.body(name).pos == pytest.approx(urdf.body(name).pos, abs=1e-9)


@pytest.mark.parametrize("name", ["acsar", "husky"])
def test_mujoco_robot_weighs_what_it_should_and_rolls_straight(name: str) -> None:
    config = RobotConfig.preset(name)
    body = MujocoBody(config)
    planar = make_body("planar", config)
    assert body._model.body_subtreemass[0] == pytest.approx(config.body.mass)
    for made in (body, planar):
        made.reset(Scene(start=(1.0, -2.0, 0.7)))
        drive(made, 5.0, 2 * SECOND)
    assert body.truth.pose == pytest.approx(planar.truth.pose, abs=0.01)
    assert body.wheel_speeds == pytest.approx(planar.wheel_speeds, rel=0.01)


def test_mujoco_robot_has_the_physics_of_its_scene() -> None:
    physics = compute_physics(ACSAR)
    body = MujocoBody(ACSAR)
    body.reset(Scene(physics=physics._replace(grip=physics.grip / ACSAR.body.friction * 0.1)))
    drive(body, 8.0, 40)
    assert body.truth.twist[0] == pytest.approx(0.1 * 9.81 * 0.2, rel=0.1)
    body.reset(Scene(physics=physics._replace(mass=6.0, left_radius=0.055)))
    assert body._model.body_subtreemass[0] == pytest.approx(6.0)
    drive(body, 8.0, 2 * SECOND)
    assert body.truth.pose[2] < -0.05  # the larger wheels are on the left


def test_mujoco_image_without_opengl_explains_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise mujoco.FatalError("no context")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(ConfigError, match="MUJOCO_GL"):
        MujocoBody(ACSAR).image(8, 6)
