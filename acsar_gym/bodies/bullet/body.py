"""The skid-steer robot in PyBullet: one rigid body, pushed by the tyre forces of `dynamics.model`.

PyBullet's own contact friction can't model skid steering (its friction axes are fixed in the
world), so all contacts with the floor are frictionless and the four tyre forces are applied as one
force and one torque on the chassis.
"""

from __future__ import annotations

import math
import weakref

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.base import GroundTruth, Image
from acsar_gym.bodies.bullet import model
from acsar_gym.bodies.bullet.engine import connected, pybullet
from acsar_gym.bodies.bullet.statics import Statics
from acsar_gym.config import RobotConfig
from acsar_gym.dynamics import GRAVITY, Physics, physics
from acsar_gym.dynamics import model as dynamics
from acsar_gym.dynamics.power import motor_power
from acsar_gym.dynamics.timing import substep
from acsar_gym.jit import record_of
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene, World

Floats = NDArray[np.float64]
# Functions that every firmware loop calls; local names avoid a look-up in the module each time.
_pose_of, _velocity_of = pybullet.getBasePositionAndOrientation, pybullet.getBaseVelocity
_apply_force, _apply_torque = pybullet.applyExternalForce, pybullet.applyExternalTorque
_simulate, _WORLD = pybullet.stepSimulation, pybullet.WORLD_FRAME
GOAL_COLOUR = (0.15, 0.68, 0.38, 0.85)


class BulletBody:
    """A PyBullet simulation with a floor, a robot and the obstacles of a world.

    Args:
        config: of the robot.
        window: whether to open PyBullet's own window.

    Raises:
        RenderError: a window is asked for, and there is no display.
    """

    def __init__(self, config: RobotConfig, *, window: bool = False) -> None:
        self._config = config
        self._dt = substep(config)
        self._configured = physics(config)
        self._client = connected(window)
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self._client)
        self._seen = window
        self._build(None)
        self.reset(Scene())

    def _build(self, world: World | None) -> None:
        """Make an empty simulation with a floor, the robot and the obstacles of a world."""
        client = self._client
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self._dt, deterministicOverlappingPairs=1, physicsClientId=client
        )
        self._floor = model.floor(client)
        self._robot = model.robot(self._config, client)
        self._statics = Statics(client, world)
        self._goal = -1
        if self._seen:
            self._statics.paint()
        self._touched = False

    def reset(self, scene: Scene) -> None:
        """Put the robot at rest at the scene's start, with the scene's world, physics and goal."""
        if scene.world is not self._statics.world:
            self._build(scene.world)
        self._equip(scene.physics or self._configured)
        client, (x, y, theta) = self._client, scene.start
        height = self._config.wheel_radius
        upright = (0.0, 0.0, math.sin(theta / 2.0), math.cos(theta / 2.0))
        pybullet.resetBasePositionAndOrientation(
            self._robot, (x, y, height), upright, physicsClientId=client
        )
        pybullet.resetBaseVelocity(
            self._robot, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=client
        )
        self._touched = False
        self._mark(scene.goal)
        self.wheel_angles: Speeds = ZERO
        self.wheel_speeds: Speeds = ZERO

    def _equip(self, own: Physics) -> None:
        """Set the robot's physics for the episode that begins."""
        model.weigh(self._robot, own, self._client)
        self._physics = record_of(own)
        self._push, self._twist = own.mass / self._dt, own.yaw_inertia / self._dt

    def _mark(self, goal: tuple[float, float] | None) -> None:
        """Put the goal marker at a point of the world [m]."""
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
        """Simulate one firmware loop: tyre force and torque, then one engine step."""
        robot, client = self._robot, self._client
        position, (qx, qy, qz, qw) = _pose_of(robot, client)
        (vx, vy, _), (_, _, rate) = _velocity_of(robot, client)
        (nx, ny, new_rate), self.wheel_speeds, self.wheel_angles = dynamics.robot_step(
            1.0 - 2.0 * (qy * qy + qz * qz),
            2.0 * (qw * qz + qx * qy),
            (vx, vy, rate),
            self.wheel_speeds,
            self.wheel_angles,
            set_points,
            self._physics,
            self._dt,
        )
        force = (self._push * (nx - vx), self._push * (ny - vy), 0.0)
        torque = (0.0, 0.0, self._twist * (new_rate - rate))
        _apply_force(robot, -1, force, position, _WORLD, client)
        _apply_torque(robot, -1, torque, _WORLD, client)
        _simulate(client)

    def feel(self) -> None:
        """Check whether the robot touches an obstacle now: overlaps it, or is pushed by it."""
        if self._statics and not self._touched:
            points = pybullet.getContactPoints(bodyA=self._robot, physicsClientId=self._client)
            self._touched = any(
                p[2] in self._statics and (p[8] <= 0.0 or p[9] > 0.0) for p in points
            )

    def engine_step(self) -> None:
        """Call PyBullet's stepSimulation alone, for benchmarks."""
        pybullet.stepSimulation(self._client)

    def rays(self, place: tuple[float, float], bearings: Floats, reach: float) -> Floats:
        """Measure ranges with PyBullet's own rays, for tests and benchmarks.

        A ray may stop up to a millimetre beside a cylinder's surface; environments don't use it.

        Args:
            place: x, y in the frame of the world [m].
            bearings: (rays,) in the frame of the world [rad].
            reach: longest range [m].

        Returns:
            (rays,) [m].
        """
        (x, y), height = place, self._config.lidar_z_offset
        ends = np.column_stack([x + reach * np.cos(bearings), y + reach * np.sin(bearings)])
        starts = [(x, y, height)] * len(ends)
        found = pybullet.rayTestBatch(
            starts, [(*end, height) for end in ends.tolist()], physicsClientId=self._client
        )
        return np.array([hit[2] * reach for hit in found])

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the robot, in the frame of the world."""
        robot, client = self._robot, self._client
        (x, y, _), orientation = pybullet.getBasePositionAndOrientation(robot, client)
        (vx, vy, _), (_, _, rate) = pybullet.getBaseVelocity(robot, client)
        theta = pybullet.getEulerFromQuaternion(orientation)[2]
        forward = vx * math.cos(theta) + vy * math.sin(theta)
        return GroundTruth((x, y, theta), (forward, rate), self._touched)

    @property
    def power(self) -> float:
        """Mechanical power of the motors now [W]; see `dynamics.power`."""
        _, (qx, qy, qz, qw) = _pose_of(self._robot, self._client)
        (vx, vy, _), (_, _, rate) = _velocity_of(self._robot, self._client)
        cos, sin = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qw * qz + qx * qy)
        return motor_power(cos, sin, (vx, vy, rate), self.wheel_speeds, self._physics)

    def image(self, width: int, height: int) -> Image:
        """Take a picture with PyBullet's camera from behind and above: (height, width, 3), RGB."""
        self._seen = True
        self._statics.paint()
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
        """Disconnect from PyBullet; idempotent."""
        self._disconnect()
