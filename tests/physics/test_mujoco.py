"""MuJoCo's robot: the URDF's, on a ground of its own, with the names and episodes of the others."""

from __future__ import annotations

import math
import sys
from typing import Any

import mujoco
import numpy as np
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.physics import Physics, compute_physics
from acsar_gym.physics import mujoco as room
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.body import Body
from acsar_gym.physics.model import closed_form_yaw_rate
from acsar_gym.physics.mujoco import MujocoBody
from acsar_gym.physics.planar import PlanarBody
from acsar_gym.protocol import Speeds
from acsar_gym.worlds import Scene, World

ACSAR = RobotConfig.preset("acsar")
AHEAD: Speeds = (8.0, 8.0, 8.0, 8.0)
SPIN: Speeds = (8.0, -8.0, -8.0, 8.0)
SECOND = 200
"""Firmware loops."""
WEDGE: Any = ((0.3, 0.0), (-0.2, 0.25), (-0.2, -0.25))
OBSTACLES = {
    "pillar ahead": World(np.array([[1.0, 0.0, 0.2]])),
    "pillar at a corner": World(np.array([[1.0, 0.3, 0.15]])),
    "wall across": World(segments=np.array([[1.0, -1.0, 1.0, 1.0]])),
    "end of a wall": World(segments=np.array([[0.9, 0.0, 2.0, 0.1]])),
}


def drive(body: Body, set_points: Speeds, loops: int) -> None:
    for _ in range(loops):
        body.step(set_points)


def other(**values: float) -> Physics:
    """The configured robot with other numbers."""
    return compute_physics(ACSAR)._replace(**values)


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
    made, urdf = MujocoBody(ACSAR)._model, mujoco.MjSpec.from_file(str(room.URDF))
    urdf.body("base_footprint").add_freejoint()
    raw = urdf.compile()
    for name in ("base_footprint", "base_link", "lidar_link", *room.WHEELS):
        one, same = made.body(name), raw.body(name)
        assert one.mass == pytest.approx(same.mass, rel=1e-5)
        assert sorted(one.inertia) == pytest.approx(sorted(same.inertia), rel=0.02)
        assert one.pos == pytest.approx(same.pos, abs=1e-9)
        assert one.ipos == pytest.approx(same.ipos, abs=1e-9)
    for name in ("base_link", *room.WHEELS):
        one, same = (m.geom(m.body(name).geomadr[0]) for m in (made, raw))
        assert one.size == pytest.approx(same.size)
        assert one.pos == pytest.approx(same.pos, abs=1e-9)


@pytest.mark.parametrize("name", ["acsar", "husky", "jackal"])
def test_it_weighs_what_it_should_and_rolls_straight(name: str) -> None:
    config = RobotConfig.preset(name)
    body, planar = MujocoBody(config), PlanarBody(config)
    assert body._model.body_subtreemass[0] == pytest.approx(config.body.mass)
    for each in (body, planar):
        each.reset(Scene(start=(1.0, -2.0, 0.7)))
        drive(each, (5.0, 5.0, 5.0, 5.0), 2 * SECOND)
    assert body.truth.pose == pytest.approx(planar.truth.pose, abs=0.01)
    assert body.wheel_speeds == pytest.approx(planar.wheel_speeds, rel=0.01)


def test_it_turns_otherwise_than_our_tyres_alike_in_both_directions() -> None:
    """Nothing in it is tuned to the closed form."""
    rates, body = [], MujocoBody(ACSAR)
    for turn in (SPIN, (-8.0, 8.0, 8.0, -8.0)):
        body.reset(Scene())
        drive(body, turn, SECOND)
        angle = body.truth.pose[2]
        drive(body, turn, SECOND // 2)
        rates.append(math.remainder(body.truth.pose[2] - angle, math.tau) * 2.0)
    left, right = rates[0], -rates[1]
    assert left == pytest.approx(right, rel=0.05)
    formula = 8.0 * ACSAR.wheel_radius / (ACSAR.wheel_separation / 2.0)
    assert 1.3 < formula / left < 3.0
    assert left != pytest.approx(closed_form_yaw_rate(SPIN, ACSAR), rel=0.1)


@pytest.mark.parametrize("friction", [0.05, 0.1])
def test_the_friction_that_was_drawn_bounds_the_acceleration(friction: float) -> None:
    body, own = MujocoBody(ACSAR), compute_physics(ACSAR)
    body.reset(Scene(physics=other(grip=own.grip / ACSAR.body.friction * friction)))
    drive(body, AHEAD, 40)
    assert body.truth.twist[0] == pytest.approx(friction * 9.81 * 0.2, rel=0.1)


def test_mass_radii_and_track_that_were_drawn_are_the_robots() -> None:
    body, own = MujocoBody(ACSAR), compute_physics(ACSAR)
    drawn = other(mass=6.0, grip=1.5 * own.grip, half_track=0.17, left_radius=0.055)
    body.reset(Scene(physics=drawn))
    model = body._model
    assert model.body_subtreemass[0] == pytest.approx(6.0)
    wheels = [model.body(name) for name in room.WHEELS]
    assert [wheel.pos[1] for wheel in wheels] == pytest.approx([-0.17, 0.17, 0.17, -0.17])
    radii = [model.geom(wheel.geomadr[0]).size[0] for wheel in wheels]
    assert radii == pytest.approx([0.05, 0.055, 0.055, 0.05])
    assert model.geom(wheels[0].geomadr[0]).friction[0] == pytest.approx(ACSAR.body.friction)
    drive(body, AHEAD, 2 * SECOND)
    assert body.truth.pose[2] < -0.05  # the larger wheels are on the left


@pytest.mark.parametrize("outline", [None, WEDGE], ids=["box", "wedge"])
def test_it_touches_where_the_planar_robot_does_and_is_stopped(outline: Any) -> None:
    config = ACSAR.with_(footprint=outline)
    body, planar = MujocoBody(config), PlanarBody(config)
    for name, world in OBSTACLES.items():
        assert touches_at(body, world) == pytest.approx(touches_at(planar, world), abs=0.006)
        if name == "wall across":
            drive(body, AHEAD, 2 * SECOND)
            front = max(x for x, _ in config.outline)
            assert body.truth.pose[0] == pytest.approx(1.0 - front, abs=0.02)
    body.reset(Scene())
    body.feel()
    assert not body.truth.contact


def test_an_episode_remembers_nothing_of_the_one_before() -> None:
    """Bit-equal, after an episode in another world, of another robot, that ended at a wall."""
    scene = Scene(start=(0.3, -0.2, 1.0), goal=(2.0, 0.0), world=OBSTACLES["pillar at a corner"])
    fresh, used = MujocoBody(ACSAR), MujocoBody(ACSAR)
    used.reset(Scene(world=OBSTACLES["wall across"], physics=other(mass=6.0, half_track=0.16)))
    drive(used, AHEAD, 3 * SECOND)
    for _ in range(2):
        fresh.reset(scene)
        used.reset(scene)
        for turn in (AHEAD, SPIN, (3.0, 7.0, 7.0, 3.0)):
            drive(fresh, turn, 60)
            drive(used, turn, 60)
        assert (fresh.truth, fresh.wheel_angles) == (used.truth, used.wheel_angles)
        assert fresh._data.qpos.tobytes() == used._data.qpos.tobytes()


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


def test_without_opengl_one_line_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise mujoco.FatalError("no context")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(ConfigError, match="MUJOCO_GL"):
        MujocoBody(ACSAR).image(8, 6)


def test_without_mujoco_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "acsar_gym.physics.mujoco")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingExtraError, match=r"acsar_gym\[mujoco\]"):
        make_body("mujoco", ACSAR)
