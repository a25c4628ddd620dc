"""The skid-steer robot in PyBullet: one rigid body, pushed by the tyre forces of `dynamics.py`.

PyBullet's own contact friction can't skid-steer (its friction axes are fixed in the world), so all
contacts with the floor are frictionless and the four tyre forces are applied as one force and one
torque on the chassis.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from acsar_gym import dynamics
from acsar_gym.bodies.base import GroundTruth, Image
from acsar_gym.config import RobotConfig
from acsar_gym.errors import MissingExtraError, RenderError
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Swallow the banner that PyBullet's C code prints when it is imported."""
    saved = os.dup(2)
    try:
        with open(os.devnull, "w") as sink:
            os.dup2(sink.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


try:
    with _quiet_stderr():
        import pybullet
except ImportError:
    raise MissingExtraError("the PyBullet robot", "bullet") from None

CHASSIS_COLOUR = (0.16, 0.35, 0.58, 1.0)
DECK_COLOUR = (0.85, 0.87, 0.9, 1.0)
WHEEL_COLOUR = (0.12, 0.12, 0.13, 1.0)
GOAL_COLOUR = (0.15, 0.68, 0.38, 0.85)
CLEARANCE = 0.02
"""Height of the chassis above the floor [m]."""


class BulletBody:
    """One PyBullet client with a floor and a robot.

    `window` opens PyBullet's own window; RenderError where there is no display.
    """

    def __init__(self, config: RobotConfig, *, window: bool = False) -> None:
        self._config = config
        self._params = dynamics.params(config)
        self._flat_params = tuple(self._params)
        self._client = _connect(window)
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self._client)
        self._push = self._params.mass / self._params.dt
        self._twist = self._params.yaw_inertia / self._params.dt
        self._goal = -1
        self._build()
        self.reset(Scene())

    def _build(self) -> None:
        client = self._client
        pybullet.setGravity(0.0, 0.0, -dynamics.GRAVITY, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self._params.dt, deterministicOverlappingPairs=1, physicsClientId=client
        )
        self._floor = _floor(client)
        self._robot = _robot(self._config, client)

    def reset(self, scene: Scene) -> None:
        """At rest at the scene's start, with the goal's marker in place."""
        client, (x, y, theta) = self._client, scene.start
        height = self._config.wheel_radius
        upright = (0.0, 0.0, math.sin(theta / 2.0), math.cos(theta / 2.0))
        pybullet.resetBasePositionAndOrientation(
            self._robot, (x, y, height), upright, physicsClientId=client
        )
        pybullet.resetBaseVelocity(
            self._robot, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=client
        )
        self._mark(scene.goal)
        self.wheel_angles: Speeds = ZERO
        self.wheel_speeds: Speeds = ZERO

    def _mark(self, goal: tuple[float, float] | None) -> None:
        if goal is None:
            return
        if self._goal < 0:
            disc = pybullet.createVisualShape(
                pybullet.GEOM_CYLINDER,
                radius=0.15,
                length=0.01,
                rgbaColor=GOAL_COLOUR,
                physicsClientId=self._client,
            )
            self._goal = pybullet.createMultiBody(0.0, -1, disc, physicsClientId=self._client)
        pybullet.resetBasePositionAndOrientation(
            self._goal, (*goal, 0.006), (0.0, 0.0, 0.0, 1.0), physicsClientId=self._client
        )

    def step(self, set_points: Speeds) -> None:
        """One loop period: tyre force and torque, then one engine step."""
        robot, client = self._robot, self._client
        position, (qx, qy, qz, qw) = pybullet.getBasePositionAndOrientation(robot, client)
        (vx, vy, _), (_, _, rate) = pybullet.getBaseVelocity(robot, client)
        (nx, ny, new_rate), self.wheel_speeds, self.wheel_angles = dynamics.robot_step(
            1.0 - 2.0 * (qy * qy + qz * qz),
            2.0 * (qw * qz + qx * qy),
            (vx, vy, rate),
            self.wheel_speeds,
            self.wheel_angles,
            set_points,
            self._flat_params,
        )
        force = (self._push * (nx - vx), self._push * (ny - vy), 0.0)
        torque = (0.0, 0.0, self._twist * (new_rate - rate))
        pybullet.applyExternalForce(robot, -1, force, position, pybullet.WORLD_FRAME, client)
        pybullet.applyExternalTorque(robot, -1, torque, pybullet.WORLD_FRAME, client)
        pybullet.stepSimulation(client)

    def engine_step(self) -> None:
        """PyBullet's stepSimulation alone, which benchmarks compare with."""
        pybullet.stepSimulation(self._client)

    @property
    def truth(self) -> GroundTruth:
        """Pose, twist, and contact with anything but the floor."""
        robot, client = self._robot, self._client
        (x, y, _), orientation = pybullet.getBasePositionAndOrientation(robot, client)
        (vx, vy, _), (_, _, rate) = pybullet.getBaseVelocity(robot, client)
        theta = pybullet.getEulerFromQuaternion(orientation)[2]
        touched = pybullet.getContactPoints(bodyA=robot, physicsClientId=client)
        contact = any(point[2] != self._floor for point in touched)
        forward = vx * math.cos(theta) + vy * math.sin(theta)
        return GroundTruth((x, y, theta), (forward, rate), contact)

    def image(self, width: int, height: int) -> Image | None:
        """PyBullet's camera, behind and above the robot."""
        x, y, theta = self.truth.pose
        view = pybullet.computeViewMatrixFromYawPitchRoll(
            cameraTargetPosition=(x, y, 0.0),
            distance=2.2,
            yaw=math.degrees(theta) - 90.0,
            pitch=-38.0,
            roll=0.0,
            upAxisIndex=2,
        )
        lens = pybullet.computeProjectionMatrixFOV(50.0, width / height, 0.05, 30.0)
        _, _, pixels, _, _ = pybullet.getCameraImage(
            width,
            height,
            view,
            lens,
            lightDirection=(1.0, -1.0, 4.0),
            lightDistance=12.0,
            shadow=1,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=self._client,
        )
        return np.ascontiguousarray(np.reshape(pixels, (height, width, 4))[:, :, :3], np.uint8)

    def close(self) -> None:
        """Disconnect the client; twice is once."""
        self._disconnect()


def _connect(window: bool) -> int:
    if not window:
        return int(pybullet.connect(pybullet.DIRECT))
    if sys.platform.startswith("linux") and not _has_display(os.environ.get("DISPLAY", "")):
        raise RenderError("render_mode='human' needs a display; use render_mode='rgb_array'")
    client = int(pybullet.connect(pybullet.GUI))
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    return client


def _has_display(name: str) -> bool:
    """Whether there is an X server; PyBullet would end the whole process without one."""
    local = re.fullmatch(r"(?:unix)?:(\d+)(?:\.\d+)?", name)
    return Path(f"/tmp/.X11-unix/X{local[1]}").exists() if local else bool(name)  # noqa: S108


def _floor(client: int) -> int:
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    floor = int(pybullet.createMultiBody(0.0, plane, physicsClientId=client))
    pybullet.changeDynamics(floor, -1, lateralFriction=0.0, physicsClientId=client)
    return floor


def _robot(config: RobotConfig, client: int) -> int:
    """Chassis box and four wheels in one rigid body, its origin at the height of the axles.

    The wheels' collision shapes are spheres: one contact each, at the right place.
    """
    body, radius = config.body, config.wheel_radius
    bottom = min(CLEARANCE, radius) - radius
    top = max(body.height - radius, bottom + 0.01)
    half = (body.length / 2.0, body.width / 2.0, (top - bottom) / 2.0)
    collision = pybullet.createCollisionShapeArray(
        shapeTypes=[pybullet.GEOM_BOX] + [pybullet.GEOM_SPHERE] * 4,
        halfExtents=[half] + [(0.0, 0.0, 0.0)] * 4,
        radii=[0.0] + [radius] * 4,
        collisionFramePositions=[(0.0, 0.0, (top + bottom) / 2.0), *_hubs(config)],
        physicsClientId=client,
    )
    robot = int(
        pybullet.createMultiBody(
            body.mass,
            collision,
            _visual(config, bottom, top, client),
            (0.0, 0.0, radius),
            physicsClientId=client,
        )
    )
    planar = dynamics.params(config).yaw_inertia
    pybullet.changeDynamics(
        robot,
        -1,
        lateralFriction=0.0,
        rollingFriction=0.0,
        spinningFriction=0.0,
        restitution=0.0,
        linearDamping=0.0,
        angularDamping=0.0,
        localInertiaDiagonal=(planar, planar, planar),
        physicsClientId=client,
    )
    return robot


def _hubs(config: RobotConfig) -> list[tuple[float, float, float]]:
    """Wheel centres in the base frame, order front_right, front_left, rear_left, rear_right."""
    a, b = config.wheelbase / 2.0, config.wheel_separation / 2.0
    return [(a, -b, 0.0), (a, b, 0.0), (-a, b, 0.0), (-a, -b, 0.0)]


class _Shape(NamedTuple):
    """One visual shape: a box of half extents, or a cylinder of (radius, length) along z."""

    box: tuple[float, float, float] | None
    cylinder: tuple[float, float]
    at: tuple[float, float, float]
    colour: tuple[float, float, float, float]
    turn: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)


def _shapes(config: RobotConfig, bottom: float, top: float) -> list[_Shape]:
    """A narrow chassis between four tyres, a lighter deck, and the LiDAR's drum."""
    body, flat = config.body, (0.0, 0.0)
    tyre = max(0.02, body.width - config.wheel_separation)
    inner = max(0.02, config.wheel_separation - tyre - 0.01)
    sideways = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))
    chassis = (body.length / 2, inner / 2, (top - bottom) / 2)
    deck = (body.length / 2.2, inner / 2.2, 0.004)
    return [
        _Shape(chassis, flat, (0.0, 0.0, (top + bottom) / 2), CHASSIS_COLOUR),
        _Shape(deck, flat, (0.0, 0.0, top + 0.004), DECK_COLOUR),
        _Shape(None, (0.035, 0.04), (body.length / 4, 0.0, top + 0.028), WHEEL_COLOUR),
        *(
            _Shape(None, (config.wheel_radius, tyre), hub, WHEEL_COLOUR, sideways)
            for hub in _hubs(config)
        ),
    ]


def _visual(config: RobotConfig, bottom: float, top: float, client: int) -> int:
    shapes = _shapes(config, bottom, top)
    return int(
        pybullet.createVisualShapeArray(
            shapeTypes=[pybullet.GEOM_BOX if s.box else pybullet.GEOM_CYLINDER for s in shapes],
            halfExtents=[s.box or (0.0, 0.0, 0.0) for s in shapes],
            radii=[s.cylinder[0] for s in shapes],
            lengths=[s.cylinder[1] for s in shapes],
            rgbaColors=[s.colour for s in shapes],
            visualFramePositions=[s.at for s in shapes],
            visualFrameOrientations=[s.turn for s in shapes],
            physicsClientId=client,
        )
    )
