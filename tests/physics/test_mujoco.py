"""MuJoCo's robot: the URDF's, on its own ground, with the names and episodes of the others."""

from __future__ import annotations

import math
import sys
from typing import Any

import mujoco
import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.physics import compute_physics
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.body import Body
from acsar_gym.physics.model import closed_form_yaw_rate
from acsar_gym.physics.mujoco import URDF, WHEELS, MujocoBody
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import Speeds
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
PHYSICS = compute_physics(ACSAR)
AHEAD: Speeds = (8.0, 8.0, 8.0, 8.0)
SPIN: Speeds = (8.0, -8.0, -8.0, 8.0)
SECOND = 200
"""Firmware loops."""
WEDGE: Any = ((0.3, 0.0), (-0.2, 0.25), (-0.2, -0.25))
PILLAR = World(np.array([[1.0, 0.3, 0.15]]))
WALL = World(segments=np.array([[1.0, -1.0, 1.0, 1.0]]))


def drive(body: Body, set_points: Speeds, loops: int) -> None:
    for _ in range(loops):
        body.step(set_points)


def touches_at(body: Body, world: World) -> float:
    """How far the robot has come when it touches something [m]."""
    body.reset(Scene(world=world))
    for _ in range(1000):
        body.step(AHEAD)
        body.feel()
        if body.truth.contact:
            return body.truth.pose[0]
    return math.nan


def test_the_presets_robot_is_the_urdfs() -> None:
    made, spec = MujocoBody(ACSAR)._model, mujoco.MjSpec.from_file(str(URDF))
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
    body, planar = MujocoBody(config), PlanarBody(config)
    assert body._model.body_subtreemass[0] == pytest.approx(config.body.mass)
    for made in (body, planar):
        made.reset(Scene(start=(1.0, -2.0, 0.7)))
        drive(made, (5.0, 5.0, 5.0, 5.0), 2 * SECOND)
    assert body.truth.pose == pytest.approx(planar.truth.pose, abs=0.01)
    assert body.wheel_speeds == pytest.approx(planar.wheel_speeds, rel=0.01)


def test_it_turns_otherwise_than_our_tyres() -> None:
    """Nothing in it is tuned to the closed form."""
    body = MujocoBody(ACSAR)
    drive(body, SPIN, SECOND)
    theta = body.truth.pose[2]
    drive(body, SPIN, SECOND // 2)
    rate = math.remainder(body.truth.pose[2] - theta, math.tau) * 2.0
    formula = 8.0 * ACSAR.wheel_radius / (ACSAR.wheel_separation / 2.0)
    assert 1.3 < formula / rate < 3.0
    assert rate != pytest.approx(closed_form_yaw_rate(SPIN, ACSAR), rel=0.1)


def test_the_friction_that_was_drawn_bounds_the_acceleration() -> None:
    body = MujocoBody(ACSAR)
    body.reset(Scene(physics=PHYSICS._replace(grip=PHYSICS.grip / ACSAR.body.friction * 0.1)))
    drive(body, AHEAD, 40)
    assert body.truth.twist[0] == pytest.approx(0.1 * 9.81 * 0.2, rel=0.1)


def test_mass_and_radii_that_were_drawn_are_the_robots() -> None:
    body = MujocoBody(ACSAR)
    body.reset(Scene(physics=PHYSICS._replace(mass=6.0, left_radius=0.055)))
    assert body._model.body_subtreemass[0] == pytest.approx(6.0)
    drive(body, AHEAD, 2 * SECOND)
    assert body.truth.pose[2] < -0.05  # the larger wheels are on the left


@pytest.mark.parametrize("outline", [None, WEDGE], ids=["box", "wedge"])
def test_it_touches_where_the_planar_robot_does_and_is_stopped(outline: Any) -> None:
    config = ACSAR.with_(footprint=outline)
    body, planar = MujocoBody(config), PlanarBody(config)
    for world in (PILLAR, WALL):
        assert touches_at(body, world) == pytest.approx(touches_at(planar, world), abs=0.006)
    drive(body, AHEAD, 2 * SECOND)
    front = max(x for x, _ in config.outline)
    assert body.truth.pose[0] == pytest.approx(1.0 - front, abs=0.02)
    body.reset(Scene())
    body.feel()
    assert not body.truth.contact


def test_an_episode_remembers_nothing_of_the_previous_episode() -> None:
    """Bit-equal, after an episode in another world, of another robot, that ended at a wall."""
    scene = Scene(start=(0.3, -0.2, 1.0), goal=(2.0, 0.0), world=PILLAR)
    fresh, used = MujocoBody(ACSAR), MujocoBody(ACSAR)
    used.reset(Scene(world=WALL, physics=PHYSICS._replace(mass=6.0, half_track=0.16)))
    drive(used, AHEAD, 3 * SECOND)
    for body in (fresh, used):
        body.reset(scene)
        drive(body, AHEAD, 60)
        drive(body, (3.0, 7.0, 7.0, 3.0), 60)
    assert (fresh.truth, fresh.wheel_angles) == (used.truth, used.wheel_angles)


def test_pictures_show_obstacles_and_goal() -> None:
    body = MujocoBody(ACSAR)
    plain = body.image(64, 48)
    assert plain.shape == (48, 64, 3)
    body.reset(Scene(goal=(0.8, 0.0), world=World(np.array([[1.2, 0.5, 0.2]]))))
    picture = body.image(64, 48).astype(int)
    assert (np.abs(picture - plain).max(axis=2) > 30).mean() > 0.02
    red, green, _ = np.moveaxis(picture, 2, 0)
    assert (green > red + 40).any()  # the goal's disc
    body.close()
    body.close()


def test_without_opengl_a_line_explains_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise mujoco.FatalError("no context")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(ConfigError, match="MUJOCO_GL"):
        MujocoBody(ACSAR).image(8, 6)


def test_without_mujoco_a_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "acsar_gym.physics.mujoco")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r"acsar_gym\[mujoco\]"):
        make_body("mujoco", ACSAR)
