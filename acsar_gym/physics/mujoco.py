"""The robot's URDF in MuJoCo: a second opinion on the ground.

The other bodies share the tyres of `physics.model`. Here four wheels roll and slide by MuJoCo's own
contacts, and nothing is fitted to our model, so that it exposes a policy or a fit that depends on
that model. Motors follow the config's motor model, by a speed controller: what a wheel does to the
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
from acsar_gym.config.physics import Physics
from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.physics import model
from acsar_gym.physics.body import (
    GOAL_PAINT,
    GOAL_RADIUS,
    MOVER_HEIGHT,
    MOVER_PAINT,
    OBSTACLE_HEIGHT,
    OBSTACLE_PAINT,
    WALL_THICKNESS,
    Body,
    Chassis,
    Image,
    Paint,
    has_display,
    prepare_opengl,
    wheel_hubs,
)
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.resources import ASSETS
from acsar_gym.worlds import Pose, Scene, World
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
"""Longest step of the engine, MuJoCo's default [s]. A firmware loop has a whole number of them."""
IMPEDANCE_RATIO = 10.0
"""How much harder friction is than the contact's normal. With 1, wheels at rest creep."""
SERVO_TIME = 0.005
"""Time constant of the speed controller of a motor [s]."""
SETTLING_TIME = 0.3
"""Time after which a robot that was put on the floor is at rest [s]."""
ANGLE_DECIMALS = 6
"""Decimals of a wheel's angle [rad]: a wheel at rest trembles, and an encoder must not see it."""
FLOOR = 1
OBSTACLES = 2
"""Bits of what a shape may touch."""
PUSH = (-1000.0, -200.0)
"""Stiffness [1/s^2] and damping [1/s] of the contact between a mover and the robot, negated as
MuJoCo has them: the robot is pushed at the mover's speed, and a robot that is squeezed between a
mover and a wall isn't flung away."""
MOVER_MASS = 1e5
"""Mass of a mover, so large that the robot doesn't slow it down [kg]."""
HIDDEN = 3
"""A group of shapes that MuJoCo doesn't draw by default."""
FLOOR_COLOUR: Paint = (0.8, 0.82, 0.84, 1.0)
SHAPE = mujoco.mjtGeom


class MujocoBody(Body):
    """A MuJoCo simulation with a floor, a robot and the obstacles of a world.

    Args:
        config: Robot configuration.
    """

    def __init__(self, config: RobotConfig) -> None:
        super().__init__(config)
        self._substeps = math.ceil(self._dt / MAX_TIME_STEP - 1e-9)
        self._renderer: Any = None
        self._compile(self._configured, None)
        self.reset(Scene())

    def reset(self, scene: Scene) -> None:
        """Put the robot at rest at the scene's start, with the scene's world, physics and goal."""
        super().reset(scene)
        # Compiling takes a while: a model is kept if only numbers outside of it differ.
        if pick_body(self._physics) != self._compiled or scene.world is not self._world:
            self._compile(self._physics, scene.world)
        # The lag of the motors has its own state: under load the wheels turn at other speeds.
        self._motors: Speeds = ZERO

        mujoco.mj_resetData(self._model, self._data)
        x, y, theta = scene.start
        pose = self._data.qpos
        pose[:3] = (x, y, self._rest[2])
        # The pose at rest leans a little on its wheels, so it is turned, not replaced.
        mujoco.mju_mulQuat(pose[3:7], turn_about_z(theta), self._rest[3:])
        # Without a goal its disc waits below the floor.
        self._data.mocap_pos[0] = (*scene.goal, 0.006) if scene.goal else (0.0, 0.0, -1.0)
        mujoco.mj_forward(self._model, self._data)

    def _compile(self, physics: Physics, world: World | None) -> None:
        """Make the model of a robot in a world."""
        # The renderer holds the old model.
        self.close()
        spec = make_robot(self._config, physics)
        spec.option.timestep = self._dt / self._substeps
        if world is not None:
            add_obstacles(spec, world)
            add_movers(spec, world)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        # Only now: after an error the next reset compiles again.
        self._world = world
        self._compiled = pick_body(physics)
        # Places of the wheels' angles and rates in the state, which are read every loop.
        joints = [self._model.joint(f"{wheel}_joint") for wheel in WHEELS]
        self._angles = [int(joint.qposadr[0]) for joint in joints]
        self._rates = [int(joint.dofadr[0]) for joint in joints]

        # Let it settle on its wheels, far away from obstacles: every reset starts at rest.
        largest = max(physics.left_radius, physics.right_radius)
        self._data.qpos[0] = 3.0 * MAX_COORDINATE
        self._data.qpos[2] = largest - self._config.wheel_radius
        mujoco.mj_step(self._model, self._data, round(SETTLING_TIME / spec.option.timestep))
        self._rest = self._data.qpos[:7].copy()

    def step(self, set_points: Speeds) -> None:
        """Simulate one firmware loop with these set points of the four wheel speeds [rad/s]."""
        data = self._data
        self._motors = model.turn_wheels(self._motors, set_points, self._physics)

        # Two actuators a wheel: the proportional and the integral part of its controller.
        data.ctrl[0::2] = data.ctrl[1::2] = self._motors
        mujoco.mj_step(self._model, data, self._substeps)
        a, b, c, d = data.qvel[self._rates].tolist()
        self.wheel_speeds = (a, b, c, d)
        a, b, c, d = data.qpos[self._angles].round(ANGLE_DECIMALS).tolist()
        self.wheel_angles = (a, b, c, d)

    def place_movers(self, crowd: Crowd) -> None:
        """Put the movers where they are. At their velocities they go on until the next tick."""
        # The movers' joints were added last, two for each mover.
        count = 2 * len(crowd.states)
        self._data.qpos[-count:] = crowd.states[:, : Y + 1].ravel()
        self._data.qvel[-count:] = crowd.states[:, VX : VY + 1].ravel()

    def feel(self) -> None:
        """Check whether the robot touches a standing obstacle now. Obstacles also stop it."""
        world = self._world
        if world is not None and world.obstacles and not self._touched:
            contact = self._data.contact
            # Shapes of the world come first: the floor, then the obstacles.
            shapes = contact.geom.min(axis=1)
            hit = (shapes > 0) & (shapes <= world.obstacles) & (contact.dist <= 0.0)
            self._touched = bool(hit.any())

    def _locate(self) -> tuple[Pose, model.Velocity]:
        x, y, _, qw, qx, qy, qz = self._data.qpos[:7].tolist()
        # A free joint's linear velocity is in the world frame, its spin in the body frame.
        vx, vy, _, _, _, rate = self._data.qvel[:6].tolist()
        # MuJoCo's quaternions start with w, those of `physics.model` end with it.
        cos, sin = model.heading_of((qx, qy, qz, qw))
        return (x, y, math.atan2(sin, cos)), (vx, vy, rate)

    @property
    def power(self) -> float:
        """Mechanical power that the motors give to the ground now [W]. See `model.motor_power`."""
        # A wheel that the ground pushes brakes, and its motor recovers nothing.
        powers = -self._data.qfrc_constraint[self._rates] * self._data.qvel[self._rates]
        return float(np.maximum(powers, 0.0).sum())

    def image(self, width: int, height: int) -> Image:
        """Take a picture with MuJoCo's camera from behind and above: (height, width, 3), RGB.

        Raises:
            ConfigError: There is no OpenGL.
        """
        # The same view as PyBullet's.
        camera = mujoco.MjvCamera()
        x, y, theta = self.truth.pose
        camera.lookat[:] = (x, y, 0.0)
        camera.distance = 2.2
        camera.elevation = -38.0
        camera.azimuth = math.degrees(theta)

        try:
            renderer = self._open_renderer(width, height)
            # The pose may have been set since the last step.
            mujoco.mj_kinematics(self._model, self._data)
            renderer.update_scene(self._data, camera)
            picture: Image = renderer.render()
        except (mujoco.FatalError, AttributeError, ImportError, OSError, RuntimeError) as error:
            raise ConfigError(
                "MuJoCo's camera needs OpenGL: install EGL or OSMesa, set MUJOCO_GL=egl or osmesa"
            ) from error
        return picture

    def _open_renderer(self, width: int, height: int) -> Any:
        """Return the renderer of the last picture, or another for pictures of another size."""
        renderer = self._renderer
        if renderer is None or (renderer.width, renderer.height) != (width, height):
            self.close()
            prepare_opengl()
            # MuJoCo draws off-screen only up to this size.
            self._model.vis.global_.offwidth = width
            self._model.vis.global_.offheight = height
            self._renderer = mujoco.Renderer(self._model, height, width)
        return self._renderer

    def close(self) -> None:
        """Free the camera. Idempotent."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def pick_body(physics: Physics) -> tuple[float, ...]:
    """Return the numbers of which `make_robot` makes a body. The others act from outside."""
    return (
        physics.left_radius,
        physics.right_radius,
        physics.grip,
        physics.half_wheelbase,
        physics.half_track,
        physics.mass,
    )


def turn_about_z(angle: float) -> tuple[float, float, float, float]:
    """Return MuJoCo's quaternion (w, x, y, z) of a turn about the vertical axis [rad]."""
    return math.cos(angle / 2.0), 0.0, 0.0, math.sin(angle / 2.0)


def make_robot(config: RobotConfig, physics: Physics) -> Any:
    """Make the URDF's robot on a floor, with the sizes, masses and friction of another robot.

    Shapes are placed as the config defines, masses are shared out as in the URDF, and inertia
    follows from shapes. The URDF's own robot comes out as it went in. An invisible prism of the
    footprint is what touches obstacles.
    """
    spec = mujoco.MjSpec.from_file(str(URDF))
    # MuJoCo would drop shapes that touch nothing, but pictures show them.
    spec.compiler.discardvisual = False
    # Wheels and chassis get other sizes, and their inertia has to follow.
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    # With a pyramidal cone, grip would depend on the direction in which a wheel slides.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = IMPEDANCE_RATIO
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_light(pos=(1.0, -1.0, 4.0), dir=(-0.2, 0.2, -1.0))

    # Two shapes touch if the contype of either has a bit of the other shape's conaffinity. Floor
    # and obstacles have only the latter, so they ignore each other.
    spec.worldbody.add_geom(
        type=SHAPE.mjGEOM_PLANE,
        size=(0.0, 0.0, 1.0),
        contype=0,
        conaffinity=FLOOR,
        rgba=FLOOR_COLOUR,
    )
    spec.body("base_footprint").add_freejoint()
    # The goal's disc touches nothing.
    spec.worldbody.add_body(mocap=True).add_geom(
        type=SHAPE.mjGEOM_CYLINDER,
        size=(GOAL_RADIUS, 0.005, 0.0),
        mass=0.0,
        contype=0,
        conaffinity=0,
        rgba=GOAL_PAINT,
    )

    # Scale the URDF's masses, so that they add up to the robot's mass.
    heavier = physics.mass / sum(body.mass for body in spec.bodies)
    chassis = Chassis.of(config)
    set_chassis(spec, config, chassis, heavier)
    lidar = spec.body("lidar_link")
    lidar.pos = (config.lidar_x_offset, config.lidar_y_offset, config.lidar_z_offset)
    lidar.mass *= heavier
    lidar.inertia *= heavier
    hubs = wheel_hubs(physics.half_wheelbase, physics.half_track)
    for name, (x, y) in zip(WHEELS, hubs, strict=True):
        wheel = spec.body(name)
        wheel.pos = (x, y, 0.0)
        geom = wheel.geoms[0]
        geom.size = (physics.right_radius if y < 0.0 else physics.left_radius, chassis.tyre / 2, 0)
        geom.mass = wheel.mass * heavier
        # The coefficient that gives a wheel with a quarter of the weight this grip.
        geom.friction[0] = physics.grip * 4.0 / (physics.mass * model.GRAVITY)
        # Wheels touch only the floor: obstacles meet the footprint, as in the other bodies.
        geom.contype = FLOOR
        geom.conaffinity = 0
        # With equal priorities the larger friction of wheel and floor would count.
        geom.priority = 1
        # A quarter of the robot's mass, as inertia about the axle [kg m^2].
        add_motor(spec, name, inertia=physics.mass / 4.0 * config.wheel_radius**2)
    return spec


def set_chassis(spec: Any, config: RobotConfig, chassis: Chassis, heavier: float) -> None:
    """Set the size of the chassis, and add the prism of its footprint."""
    base = spec.body("base_link")
    base.pos[2] = config.wheel_radius
    box = base.geoms[0]
    box.size = (config.body.length / 2, chassis.width / 2, (chassis.top - chassis.bottom) / 2)
    box.pos = (0.0, 0.0, (chassis.top + chassis.bottom) / 2.0)
    box.mass = base.mass * heavier
    box.contype = box.conaffinity = 0

    # The chassis is seen, the prism of the footprint touches.
    mesh = spec.add_mesh(name="footprint")
    corners = [(x, y, z) for z in (chassis.bottom, chassis.top) for x, y in config.outline]
    mesh.uservert = np.ravel(corners)
    base.add_geom(
        type=SHAPE.mjGEOM_MESH,
        meshname=mesh.name,
        mass=0.0,
        group=HIDDEN,
        contype=FLOOR | OBSTACLES,
        conaffinity=0,
    )


def add_motor(spec: Any, wheel: str, *, inertia: float) -> None:
    """Add a geared motor with a proportional and integral speed controller.

    Seen from the wheel its rotor is as heavy as the load, as gears are chosen for. This matters:
    MuJoCo solves friction with the inertia that it finds at each contact, and lets the robot turn
    the slower the lighter its rotors are and the better its tyres grip.
    """
    joint = spec.joint(f"{wheel}_joint")
    joint.actfrclimited = False
    joint.armature = inertia
    damping = inertia / SERVO_TIME
    target = {"target": joint.name, "trntype": mujoco.mjtTrn.mjTRN_JOINT}
    spec.add_actuator(**target).set_to_velocity(kv=damping)
    # The integral part holds a speed against the ground's resistance.
    integral = spec.add_actuator(**target)
    # This gain damps rotor and controller critically: a larger gain would overshoot.
    integral.set_to_intvelocity(kp=damping / (4.0 * SERVO_TIME))
    integral.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE


def add_obstacles(spec: Any, world: World) -> None:
    """Add the circles and segments of a world, as cylinders and thin boxes."""
    middle = OBSTACLE_HEIGHT / 2.0
    common = {"contype": 0, "conaffinity": OBSTACLES, "rgba": OBSTACLE_PAINT}
    for x, y, radius in world.circles.tolist():
        spec.worldbody.add_geom(
            type=SHAPE.mjGEOM_CYLINDER,
            size=(max(radius, 1e-3), middle, 0.0),
            pos=(x, y, middle),
            **common,
        )

    for x1, y1, x2, y2 in world.segments.tolist():
        length = math.hypot(x2 - x1, y2 - y1)
        spec.worldbody.add_geom(
            type=SHAPE.mjGEOM_BOX,
            size=(max(length / 2.0, 1e-3), WALL_THICKNESS / 2.0, middle),
            pos=((x1 + x2) / 2.0, (y1 + y2) / 2.0, middle),
            quat=turn_about_z(math.atan2(y2 - y1, x2 - x1)),
            **common,
        )


def add_movers(spec: Any, world: World) -> None:
    """Add the movers of a world, after the robot: heavy cylinders that slide over the floor."""
    for mover in world.movers:
        x, y = mover.position(0.0)

        body = spec.worldbody.add_body(pos=(x, y, MOVER_HEIGHT / 2.0))
        # With `ref` a joint's position is the place in the world, as `place_movers` sets it.
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(1.0, 0.0, 0.0), ref=x)
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=(0.0, 1.0, 0.0), ref=y)
        body.add_geom(
            type=SHAPE.mjGEOM_CYLINDER,
            size=(mover.radius, MOVER_HEIGHT / 2.0, 0.0),
            mass=MOVER_MASS,
            contype=0,
            conaffinity=OBSTACLES,
            # Without friction a mover pushes the robot, but doesn't drag it along its side.
            condim=1,
            priority=1,
            solref=PUSH,
            rgba=MOVER_PAINT,
        )
