"""Bodies against closed forms, against each other, and at obstacles. PyBullet's memory."""

from __future__ import annotations

import gc
import math
from typing import Any

import mujoco
import numpy as np
import psutil
import pytest

from acsar_gym import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.physics import compute_physics
from acsar_gym.physics.bodies import make_body
from acsar_gym.physics.body import Body
from acsar_gym.physics.mujoco import URDF, WHEELS, MujocoBody
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene, World, walk
from acsar_gym.worlds.crowd import Crowd

ACSAR = RobotConfig.preset("acsar")
ENGINES = pytest.mark.parametrize("name", ["bullet", "mujoco"])
AHEAD: Speeds = (8.0, 8.0, 8.0, 8.0)
SECOND = 200
"""Firmware loops."""
TURNS: list[Speeds] = [(4.0, -4.0, -4.0, 4.0), (8.0, 4.0, 4.0, 8.0), (3.0, 7.0, 7.0, 3.0)]
WEDGE: Any = ((0.3, 0.0), (-0.2, 0.25), (-0.2, -0.25))
WALL = World(segments=np.array([[1.0, -1.0, 1.0, 1.0]]))
OBSTACLES = [
    WALL,
    World(np.array([[1.0, 0.1, 0.2]])),
    World(segments=np.array([[0.8, -0.3, 1.4, 1.0]])),
]


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


@pytest.mark.parametrize("name", ["planar", "bullet"])
def test_steady_turns_are_the_closed_form_at_every_heading(name: str) -> None:
    """With the turn factor, and with the radii of the wheels."""
    config = RobotConfig(left_wheel_radius_multiplier=0.96, right_wheel_radius_multiplier=1.02)
    body = make_body(name, config.with_(body={"turn_factor": 1.6}))
    for eighth in range(8):
        body.reset(Scene(start=(1.0, -2.0, math.pi / 4 * eighth + 0.1)))
        set_points = TURNS[eighth % 3]
        drive(body, set_points, 2 * SECOND)
        theta = body.truth.pose[2]
        drive(body, set_points, SECOND)
        rate = math.remainder(body.truth.pose[2] - theta, math.tau)
        right_speed, left_speed = set_points[:2]
        expected = 0.05 * (right_speed * 1.02 - left_speed * 0.96) / 0.3 / 1.6
        assert rate == pytest.approx(expected, rel=0.01)
    body.close()


@ENGINES
def test_reset_body_repeats_a_fresh_body_bit_for_bit(name: str) -> None:
    """After an episode in another world that ended at a wall."""
    fresh = make_body(name, ACSAR)
    used = make_body(name, ACSAR)
    used.reset(Scene(world=WALL))
    drive(used, AHEAD, 3 * SECOND)
    truths = []
    for body in (fresh, used):
        body.reset(Scene(start=(0.3, -0.2, 1.0), goal=(2.0, 0.0), world=OBSTACLES[1]))
        for set_points in (*TURNS, ZERO):
            drive(body, set_points, 50)
            truths.append((body.truth, body.wheel_angles))
        body.close()
    assert truths[:4] == truths[4:]


@ENGINES
def test_image_shows_obstacles_goal_and_movers(name: str) -> None:
    body: Any = make_body(name, ACSAR)
    plain = body.image(64, 48)
    assert plain.shape == (48, 64, 3)

    crossing = walk([[1.5, -0.4], [1.5, 8.0]])
    world = World(np.array([[1.2, 0.5, 0.2]]), movers=[crossing])
    body.reset(Scene(goal=(0.8, 0.0), world=world))
    body.place_movers(Crowd(world, ACSAR, 0.0))
    picture = body.image(64, 48).astype(int)
    assert (np.abs(picture - plain).max(axis=2) > 30).mean() > 0.02
    red, green, blue = np.moveaxis(picture, 2, 0)
    assert (green > red + 40).any()  # the goal's disc
    violet = (red > 1.5 * green) & (blue > 1.1 * red)  # the mover, on the right
    assert violet[:, :32].sum() < violet[:, 32:].sum() > 40
    for _ in range(2):
        body.close()


@ENGINES
@pytest.mark.parametrize("outline", [None, WEDGE], ids=["box", "wedge"])
def test_body_touches_where_the_planar_robot_does_and_is_stopped(name: str, outline: Any) -> None:
    config = ACSAR.with_(footprint=outline)
    body = make_body(name, config)
    planar = make_body("planar", config)
    for world in OBSTACLES:
        assert touches_at(body, world) == pytest.approx(touches_at(planar, world), abs=0.006)
    body.reset(Scene(world=WALL))
    drive(body, AHEAD, 3 * SECOND)
    front = max(x for x, _ in config.outline)
    assert body.truth.pose[0] == pytest.approx(1.0 - front, abs=0.02)
    body.reset(Scene())
    body.feel()
    assert not body.truth.contact
    body.close()


@pytest.mark.slow
def test_bullet_memory_is_flat_over_resets_to_other_worlds() -> None:
    body = make_body("bullet", RobotConfig())
    rng = np.random.default_rng(0)

    def reset_often(count: int) -> int:
        for _ in range(count):
            circles = np.column_stack([rng.uniform(1.0, 5.0, (40, 2)), np.full(40, 0.1)])
            body.reset(Scene(world=World(circles)))
            body.step(AHEAD)
        gc.collect()
        return int(psutil.Process().memory_info().rss)

    warm = reset_often(100)
    assert reset_often(400) - warm < 1_000_000
    body.close()


# MuJoCo's robot: the URDF's, on its own ground


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
        drive(made, AHEAD, 2 * SECOND)
    assert body.truth.pose == pytest.approx(planar.truth.pose, abs=0.01)
    assert body.wheel_speeds == pytest.approx(planar.wheel_speeds, rel=0.01)


def test_mujoco_robot_has_the_physics_of_its_scene() -> None:
    physics = compute_physics(ACSAR)
    body = MujocoBody(ACSAR)
    body.reset(Scene(physics=physics._replace(grip=physics.grip / ACSAR.body.friction * 0.1)))
    drive(body, AHEAD, 40)
    assert body.truth.twist[0] == pytest.approx(0.1 * 9.81 * 0.2, rel=0.1)
    body.reset(Scene(physics=physics._replace(mass=6.0, left_radius=0.055)))
    assert body._model.body_subtreemass[0] == pytest.approx(6.0)
    drive(body, AHEAD, 2 * SECOND)
    assert body.truth.pose[2] < -0.05  # the larger wheels are on the left


def test_mujoco_compiles_a_world_again_after_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def add_bad_box(spec: Any, world: World) -> None:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(-1.0, 1.0, 1.0))

    body = MujocoBody(ACSAR)
    with monkeypatch.context() as patch:
        patch.setattr("acsar_gym.physics.mujoco.add_obstacles", add_bad_box)
        with pytest.raises(ValueError, match="size"):
            body.reset(Scene(world=WALL))
    assert 0.5 < touches_at(body, WALL) < 1.0


def test_mujoco_image_without_opengl_explains_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: Any) -> None:
        raise mujoco.FatalError("no context")

    monkeypatch.setattr(mujoco, "Renderer", fail)
    with pytest.raises(ConfigError, match="MUJOCO_GL"):
        MujocoBody(ACSAR).image(8, 6)
