"""The robot's URDF in MuJoCo: a second opinion on the ground.

The other bodies share the tyres of `physics.model`. Here four wheels roll and slide by MuJoCo's own
contacts, and nothing is fitted to our model, so that a policy or a fit which leans on that model is
found out. Motors follow the config's motor model, by a speed controller: what a wheel does to the
ground is MuJoCo's. No other file imports MuJoCo.

`Physics.kappa` (the turn factor) and `Physics.slip_speed` are of our tyres, and have no effect.
"""

from __future__ import annotations

import contextlib
import ctypes
import math
import os
from typing import Any

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import convex_pieces
from acsar_gym.config.physics import Physics
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.physics import model
from acsar_gym.physics.body import (
    CHASSIS_CLEARANCE,
    GOAL_PAINT,
    MOVER_HEIGHT,
    MOVER_PAINT,
    OBSTACLE_HEIGHT,
    OBSTACLE_PAINT,
    WALL_THICKNESS,
    Image,
    has_display,
    prepare_opengl,
    wrap_angle,
)
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.resources import ASSETS
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.crowd import VX, VY, Crowd, Y
from acsar_gym.worlds.world import MAX_COORDINATE

if not has_display():  # MuJoCo chooses how to draw when it is imported, and fails without EGL
    with contextlib.suppress(OSError):
        ctypes.CDLL("libEGL.so.1")
        os.environ.setdefault("MUJOCO_GL", "egl")
with require_extra("the MuJoCo robot", "mujoco"):
    import mujoco

URDF = ASSETS / "robots" / "acsar.urdf"
WHEELS = ("front_right_wheel", "front_left_wheel", "rear_left_wheel", "rear_right_wheel")
MAX_TIME_STEP = 0.002
"""Longest step of the engine, MuJoCo's default [s]; a firmware loop has a whole number of them."""
IMPEDANCE_RATIO = 10.0
"""How much harder friction is than the contact's normal; with 1, wheels at rest creep."""
SERVO_TIME = 0.005  # time constant of the speed controller of a motor [s]
SETTLING_TIME = 0.3  # after which a robot that was put on the floor stands still [s]
ANGLE_DECIMALS = 6
"""Decimals of a wheel's angle [rad]: a wheel at rest trembles, and an encoder must not see it."""
FLOOR, OBSTACLES = 1, 2  # bits of what a shape may touch
PUSH = (-1000.0, -200.0)
"""Stiffness [1/s^2] and damping [1/s] of the contact between a mover and the robot, negated as
MuJoCo has them: the robot is pushed at the mover's speed, and one that is squeezed between a mover
and a wall isn't flung away."""
MOVER_MASS = 1e5  # so heavy that the robot doesn't slow it down [kg]
HIDDEN = 3
"""A group of shapes that MuJoCo doesn't draw by default."""
FLOOR_COLOUR = (0.8, 0.82, 0.84, 1.0)


class MujocoBody:
    """A MuJoCo simulation with a floor, a robot and the obstacles of a world.

    Args:
        config: of the robot.
    """

    def __init__(self, config: RobotConfig) -> None:
        self._config = config
        self._configured = model.compute_physics(config)
        self._substeps = math.ceil(model.loop_period(config) / MAX_TIME_STEP - 1e-9)
        self._renderer: Any = None
        self._pictured: tuple[int, int] | None = None
        self._compile(self._configured, None)
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """Put the robot at rest at the scene's start, with the scene's world, physics and goal."""
        own = scene.physics or self._configured
        if _pick_body(own) != _pick_body(self._physics) or scene.world is not self._world:
            self._compile(own, scene.world)
        self._physics: Physics = own
        mujoco.mj_resetData(self._model, self._data)
        (x, y, theta), pose = scene.start, self._data.qpos
        pose[:3] = x, y, self._rest[2]
        heading = (math.cos(theta / 2.0), 0.0, 0.0, math.sin(theta / 2.0))
        mujoco.mju_mulQuat(pose[3:7], heading, self._rest[3:])
        self._data.mocap_pos[0] = (*(scene.goal or (0.0, 0.0)), 0.006 if scene.goal else -1.0)
        mujoco.mj_forward(self._model, self._data)
        self._motors: Speeds = ZERO
        self.wheel_angles: Speeds = ZERO
        self.wheel_speeds: Speeds = ZERO
        self._touched = False

    def _compile(self, own: Physics, world: World | None) -> None:
        """Make the model of a robot in a world."""
        self._free_renderer()
        spec = make_robot(self._config, own)
        spec.option.timestep = model.loop_period(self._config) / self._substeps
        add_obstacles(spec, world)
        add_movers(spec, world)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        joints = [self._model.joint(f"{wheel}_joint") for wheel in WHEELS]
        self._angles = [int(joint.qposadr[0]) for joint in joints]
        self._rates = [int(joint.dofadr[0]) for joint in joints]
        self._world, self._physics = world, own
        # Let it settle on its wheels, far away from obstacles: every reset begins at rest.
        self._data.qpos[0] = 3.0 * MAX_COORDINATE
        self._data.qpos[2] = max(own.left_radius, own.right_radius) - self._config.wheel_radius
        mujoco.mj_step(self._model, self._data, round(SETTLING_TIME / spec.option.timestep))
        self._rest = self._data.qpos[:7].copy()

    def step(self, set_points: Speeds) -> None:
        """Simulate one firmware loop with these set points of the four wheel speeds [rad/s]."""
        own, motors = self._physics, self._motors
        top, follow = own.max_speed, model.wheel_speed
        self._motors = (
            follow(motors[0], set_points[0], own.gain_a, own.blend_a, own.deadband_a, top),
            follow(motors[1], set_points[1], own.gain_b, own.blend_b, own.deadband_b, top),
            follow(motors[2], set_points[2], own.gain_c, own.blend_c, own.deadband_c, top),
            follow(motors[3], set_points[3], own.gain_d, own.blend_d, own.deadband_d, top),
        )
        data = self._data
        data.ctrl[0::2] = data.ctrl[1::2] = self._motors
        mujoco.mj_step(self._model, data, self._substeps)
        a, b, c, d = data.qvel[self._rates].tolist()
        self.wheel_speeds = (a, b, c, d)
        a, b, c, d = data.qpos[self._angles].round(ANGLE_DECIMALS).tolist()
        self.wheel_angles = (a, b, c, d)

    def place_movers(self, crowd: Crowd) -> None:
        """Put the movers where they are; at their velocities they go on until the next tick."""
        count = 2 * len(crowd.states)
        self._data.qpos[-count:] = crowd.states[:, : Y + 1].ravel()
        self._data.qvel[-count:] = crowd.states[:, VX : VY + 1].ravel()

    def feel(self) -> None:
        """Check whether the robot touches a standing obstacle now; obstacles also stop it."""
        world = self._world
        if world is not None and world.obstacles and not self._touched:
            contact = self._data.contact
            # Shapes of the world come first: the floor, then the obstacles.
            others = contact.geom.min(axis=1)
            hit = (others > 0) & (others <= world.obstacles) & (contact.dist <= 0.0)
            self._touched = bool(hit.any())

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the robot, in the frame of the world."""
        x, y, _, qw, qx, qy, qz = self._data.qpos[:7].tolist()
        vx, vy, _, _, _, rate = self._data.qvel[:6].tolist()
        theta = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        forward = vx * math.cos(theta) + vy * math.sin(theta)
        return GroundTruth((x, y, wrap_angle(theta)), (forward, rate), self._touched)

    @property
    def power(self) -> float:
        """Mechanical power that the motors give to the ground now [W]; see `model.motor_power`."""
        powers = -self._data.qfrc_constraint[self._rates] * self._data.qvel[self._rates]
        return float(np.maximum(powers, 0.0).sum())

    def image(self, width: int, height: int) -> Image:
        """Take a picture with MuJoCo's camera from behind and above: (height, width, 3), RGB.

        Raises:
            ConfigError: there is no OpenGL.
        """
        try:
            if self._pictured != (width, height):
                self._free_renderer()
                prepare_opengl()
                self._model.vis.global_.offwidth = width
                self._model.vis.global_.offheight = height
                self._renderer = mujoco.Renderer(self._model, height, width)
                self._pictured = (width, height)
            mujoco.mj_kinematics(self._model, self._data)
            camera = mujoco.MjvCamera()
            x, y, theta = self.truth.pose
            camera.lookat[:] = (x, y, 0.0)
            camera.distance, camera.elevation, camera.azimuth = 2.2, -38.0, math.degrees(theta)
            self._renderer.update_scene(self._data, camera)
            picture: Image = self._renderer.render()
        except (mujoco.FatalError, AttributeError, ImportError, OSError, RuntimeError) as error:
            raise ConfigError(
                "MuJoCo's camera needs OpenGL: install EGL or OSMesa, set MUJOCO_GL=egl or osmesa"
            ) from error
        return picture

    def _free_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = self._pictured = None

    def close(self) -> None:
        """Free the camera; idempotent."""
        self._free_renderer()


def _pick_body(own: Physics) -> tuple[float, ...]:
    """The numbers of which `make_robot` makes a body; the others act from outside."""
    tyres = own.left_radius, own.right_radius, own.grip
    return *tyres, own.half_wheelbase, own.half_track, own.mass


def make_robot(config: RobotConfig, own: Physics) -> Any:
    """Make the URDF's robot on a floor, with the sizes, masses and friction of another robot.

    Shapes are placed as the config says, masses are shared out as in the URDF, and inertia follows
    from shapes; the URDF's own robot comes out as it went in. An invisible prism of the footprint
    is what touches obstacles.

    Each wheel has a geared motor with a proportional and integral speed controller. Seen from the
    wheel its rotor is as heavy as the load, as gears are chosen for. This matters: MuJoCo solves
    friction with the inertia that it finds at each contact, and lets the robot turn the slower the
    lighter its rotors are and the better its tyres grip.
    """
    spec, shape = mujoco.MjSpec.from_file(str(URDF)), mujoco.mjtGeom
    spec.compiler.discardvisual = False
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = IMPEDANCE_RATIO
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_light(pos=(1.0, -1.0, 4.0), dir=(-0.2, 0.2, -1.0))
    spec.worldbody.add_geom(
        type=shape.mjGEOM_PLANE,
        size=(0.0, 0.0, 1.0),
        contype=0,
        conaffinity=FLOOR,
        rgba=FLOOR_COLOUR,
    )
    spec.body("base_footprint").add_freejoint()
    goal = spec.worldbody.add_body(mocap=True)
    goal.add_geom(
        type=shape.mjGEOM_CYLINDER,
        size=(0.15, 0.005, 0.0),
        mass=0.0,
        contype=0,
        conaffinity=0,
        rgba=GOAL_PAINT,
    )
    body, radius = config.body, config.wheel_radius
    heavier = own.mass / sum(one.mass for one in spec.bodies)
    bottom = min(CHASSIS_CLEARANCE, radius) - radius
    top = max(body.height - radius, bottom + 0.01)
    tyre = max(0.02, body.width - config.wheel_separation)
    width = max(0.02, config.wheel_separation - tyre - 0.01)

    base = spec.body("base_link")
    base.pos[2] = radius
    chassis = base.geoms[0]
    chassis.size, chassis.pos = (
        (body.length / 2.0, width / 2.0, (top - bottom) / 2.0),
        (0.0, 0.0, (top + bottom) / 2.0),
    )
    chassis.contype = chassis.conaffinity = 0
    chassis.mass = base.mass * heavier
    for number, piece in enumerate(convex_pieces(config.outline)):
        mesh = spec.add_mesh(name=f"footprint_{number}")
        mesh.uservert = [at for z in (bottom, top) for x, y in piece for at in (x, y, z)]
        base.add_geom(
            type=shape.mjGEOM_MESH,
            meshname=mesh.name,
            mass=0.0,
            group=HIDDEN,
            contype=FLOOR | OBSTACLES,
            conaffinity=0,
        )
    lidar = spec.body("lidar_link")
    lidar.pos = (config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset)
    lidar.mass *= heavier
    lidar.inertia *= heavier

    friction = own.grip * 4.0 / (own.mass * model.GRAVITY)
    a, b = own.half_wheelbase, own.half_track
    for name, (x, y) in zip(WHEELS, [(a, -b), (a, b), (-a, b), (-a, -b)], strict=True):
        wheel, joint = spec.body(name), spec.joint(f"{name}_joint")
        wheel.pos = (x, y, 0.0)
        geom = wheel.geoms[0]
        geom.size = (own.right_radius if y < 0.0 else own.left_radius, tyre / 2.0, 0.0)
        geom.contype, geom.conaffinity, geom.priority = FLOOR, 0, 1
        geom.friction[0] = friction
        geom.mass = wheel.mass * heavier
        joint.actfrclimited = False
        joint.armature = own.mass / 4.0 * radius**2
        damping = joint.armature / SERVO_TIME
        proportional, integral = (
            spec.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            for _ in range(2)
        )
        proportional.set_to_velocity(kv=damping)
        integral.set_to_intvelocity(kp=damping / (4.0 * SERVO_TIME))
        integral.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
    return spec


def add_obstacles(spec: Any, world: World | None) -> None:
    """Add the circles and segments of a world, as cylinders and thin boxes."""
    shape, middle = mujoco.mjtGeom, OBSTACLE_HEIGHT / 2.0
    common = {"contype": 0, "conaffinity": OBSTACLES, "rgba": OBSTACLE_PAINT}
    for x, y, radius in () if world is None else world.circles.tolist():
        size = (max(radius, 1e-3), middle, 0.0)
        spec.worldbody.add_geom(type=shape.mjGEOM_CYLINDER, size=size, pos=(x, y, middle), **common)
    for x1, y1, x2, y2 in () if world is None else world.segments.tolist():
        angle, length = math.atan2(y2 - y1, x2 - x1), math.hypot(x2 - x1, y2 - y1)
        spec.worldbody.add_geom(
            type=shape.mjGEOM_BOX,
            size=(max(length / 2.0, 1e-3), WALL_THICKNESS / 2.0, middle),
            pos=((x1 + x2) / 2.0, (y1 + y2) / 2.0, middle),
            quat=(math.cos(angle / 2.0), 0.0, 0.0, math.sin(angle / 2.0)),
            **common,
        )


def add_movers(spec: Any, world: World | None) -> None:
    """Add the movers of a world, after the robot: heavy cylinders that slide over the floor."""
    shape, slide = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtJoint.mjJNT_SLIDE
    for mover in () if world is None else world.movers:
        x, y = mover.position(0.0)
        body = spec.worldbody.add_body(pos=(x, y, MOVER_HEIGHT / 2.0))
        body.add_joint(type=slide, axis=(1.0, 0.0, 0.0), ref=x)
        body.add_joint(type=slide, axis=(0.0, 1.0, 0.0), ref=y)
        body.add_geom(
            type=shape,
            size=(mover.radius, MOVER_HEIGHT / 2.0, 0.0),
            mass=MOVER_MASS,
            contype=0,
            conaffinity=OBSTACLES,
            condim=1,
            priority=1,
            solref=PUSH,
            rgba=MOVER_PAINT,
        )
