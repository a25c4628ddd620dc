"""MuJoCo's robot: the URDF's, on its own ground."""

from __future__ import annotations

import math
import sys
from typing import Any

import mujoco
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.physics import compute_physics
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.body import Body
from acsar_gym.physics.model import turn_factor
from acsar_gym.physics.mujoco import URDF, WHEELS, MujocoBody
from acsar_gym.protocol import Speeds
from acsar_gym.worlds import Scene

ACSAR = RobotConfig.preset("acsar")
PHYSICS = compute_physics(ACSAR)
AHEAD: Speeds = (8.0, 8.0, 8.0, 8.0)
SECOND = 200
"""Firmware loops."""


def drive(body: Body, set_points: Speeds, loops: int) -> None:
    for _ in range(loops):
        body.step(set_points)


def test_the_presets_robot_is_the_urdfs() -> None:
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
def test_it_weighs_what_it_should_and_rolls_straight(name: str) -> None:
    config = RobotConfig.preset(name)
    body = MujocoBody(config)
    planar = make_body("planar", config)
    assert body._model.body_subtreemass[0] == pytest.approx(config.body.mass)
    for made in (body, planar):
        made.reset(Scene(start=(1.0, -2.0, 0.7)))
        drive(made, (5.0, 5.0, 5.0, 5.0), 2 * SECOND)
    assert body.truth.pose == pytest.approx(planar.truth.pose, abs=0.01)
    assert body.wheel_speeds == pytest.approx(planar.wheel_speeds, rel=0.01)


def test_it_turns_otherwise_than_our_tyres() -> None:
    """Nothing in it is tuned to the closed form."""
    body = MujocoBody(ACSAR)
    drive(body, (8.0, -8.0, -8.0, 8.0), SECOND)
    theta = body.truth.pose[2]
    drive(body, (8.0, -8.0, -8.0, 8.0), SECOND // 2)
    rate = math.remainder(body.truth.pose[2] - theta, math.tau) * 2.0
    factor = 8.0 * ACSAR.wheel_radius / (ACSAR.wheel_separation / 2.0) / rate
    assert 1.3 < factor < 3.0
    assert factor != pytest.approx(turn_factor(ACSAR), rel=0.1)


def test_what_was_drawn_is_the_robots() -> None:
    body = MujocoBody(ACSAR)
    body.reset(Scene(physics=PHYSICS._replace(grip=PHYSICS.grip / ACSAR.body.friction * 0.1)))
    drive(body, AHEAD, 40)
    assert body.truth.twist[0] == pytest.approx(0.1 * 9.81 * 0.2, rel=0.1)
    body.reset(Scene(physics=PHYSICS._replace(mass=6.0, left_radius=0.055)))
    assert body._model.body_subtreemass[0] == pytest.approx(6.0)
    drive(body, AHEAD, 2 * SECOND)
    assert body.truth.pose[2] < -0.05  # the larger wheels are on the left


def test_without_opengl_a_line_explains_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise mujoco.FatalError("no context")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(ConfigError, match="MUJOCO_GL"):
        MujocoBody(ACSAR).image(8, 6)


def test_without_mujoco_a_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "acsar_gym.physics.mujoco")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r"'\.\[mujoco\]'"):
        make_body("mujoco", ACSAR)
