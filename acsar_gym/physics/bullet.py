"""The skid-steer robot in PyBullet: one rigid body, pushed by the tyre forces of `physics.model`.

PyBullet's own contact friction can't model skid steering (its friction axes are fixed in the
world), so all contacts with the floor are frictionless and the four tyre forces are applied as one
force and one torque on the chassis. No other file imports PyBullet.
"""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import (
    Outline,
    Point,
    border_distance,
    contains_point,
    convex_pieces,
    outline_radius,
)
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.jit import loop, record_of
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
)
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.truth import GroundTruth
from acsar_gym.worlds import Scene, World
from acsar_gym.worlds.crowd import Crowd, X, Y
from acsar_gym.worlds.movers import MAX_MOVER_SPEED


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Hide the banner that PyBullet's C code prints when it is imported."""
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
except ImportError as error:
    raise MissingExtraError("the PyBullet robot", "bullet") from error

Floats = NDArray[np.float64]
Point3 = tuple[float, float, float]
Motion = tuple[Point3, tuple[float, float, float, float], Point3, Point3]
"""Position, orientation (x, y, z, w), velocity and angular velocity, in the frame of the world."""
# Functions that every firmware loop calls; local names avoid a look-up in the module each time.
_pose_of, _velocity_of = pybullet.getBasePositionAndOrientation, pybullet.getBaseVelocity
_apply_force, _apply_torque = pybullet.applyExternalForce, pybullet.applyExternalTorque
_simulate, _WORLD = pybullet.stepSimulation, pybullet.WORLD_FRAME
_push_robot = model.push_robot
MAX_SHAPES = 16  # shapes of a compound, at most; PyBullet's limit
FRAME_KEYS = ("Positions", "Orientations")
"""Keys to which PyBullet adds a prefix, another for collision shapes than for visual ones."""
FOOT_PLACES = 100  # places between a hub and the middle of the robot that are tried for a foot
LEAST_FOOT = 1e-3  # radius of the smallest foot [m]
PUSH_STIFFNESS, PUSH_DAMPING = 1e4, 2e3
"""Of the contact between a mover and the robot [N/m, N s/m]: the robot is pushed at the mover's
speed, and one that is squeezed between a mover and a wall isn't flung away."""
BELOW = (0.0, 0.0, -5.0)  # where movers wait that are far away from the robot [m]
UPRIGHT, STANDSTILL = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
NEAR_MARGIN = 0.5  # movers that may come so near to the robot in a tick are in the simulation [m]
CHASSIS_COLOUR = (0.16, 0.35, 0.58, 1.0)
DECK_COLOUR = (0.85, 0.87, 0.9, 1.0)
WHEEL_COLOUR = (0.12, 0.12, 0.13, 1.0)


class BulletBody:
    """A PyBullet simulation with a floor, a robot and the obstacles of a world.

    Args:
        config: of the robot.
        window: whether to open PyBullet's own window.

    Raises:
        ConfigError: a window is asked for, and there is no display.
    """

    def __init__(self, config: RobotConfig, *, window: bool = False) -> None:
        self._config = config
        self._dt = model.loop_period(config)
        self._configured = model.compute_physics(config)
        if window and not has_display():
            raise ConfigError("PyBullet's window needs a display; drive without a window here")
        if window:
            prepare_opengl()
        self._client = int(pybullet.connect(pybullet.GUI if window else pybullet.DIRECT))
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self._client)
        if window:
            pybullet.configureDebugVisualizer(
                pybullet.COV_ENABLE_GUI, 0, physicsClientId=self._client
            )
        self._seen = window
        outer = outline_radius(config.outline)
        self._near = outer + MAX_MOVER_SPEED * config.period + NEAR_MARGIN
        self._motion: Motion | None = None
        self._build(None)
        self.reset(Scene())

    def _build(self, world: World | None) -> None:
        """Make an empty simulation with a floor, the robot and the obstacles of a world."""
        client = self._client
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setGravity(0.0, 0.0, -model.GRAVITY, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self._dt, deterministicOverlappingPairs=1, physicsClientId=client
        )
        plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        floor = int(pybullet.createMultiBody(0.0, plane, physicsClientId=client))
        pybullet.changeDynamics(floor, -1, lateralFriction=0.0, physicsClientId=client)
        self._robot = make_robot(self._config, client)
        self._statics = StaticObstacles(client, world)
        self._movers = MovingObstacles(client, world)
        self._goal = -1
        if self._seen:
            self._statics.paint()
        self._touched = False

    def reset(self, scene: Scene) -> None:
        """Put the robot at rest at the scene's start, with the scene's world, physics and goal."""
        if scene.world is not self._statics.world:
            self._build(scene.world)
        self._movers.park()
        self._crowd: Crowd | None = None
        physics, client = scene.physics or self._configured, self._client
        x, y, theta = scene.start
        inertia = (physics.yaw_inertia, physics.yaw_inertia, physics.yaw_inertia)
        pybullet.changeDynamics(
            self._robot, -1, mass=physics.mass, localInertiaDiagonal=inertia, physicsClientId=client
        )
        self._physics = record_of(physics)
        upright = (0.0, 0.0, math.sin(theta / 2.0), math.cos(theta / 2.0))
        pybullet.resetBasePositionAndOrientation(
            self._robot, (x, y, self._config.wheel_radius), upright, physicsClientId=client
        )
        pybullet.resetBaseVelocity(
            self._robot, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), physicsClientId=client
        )
        self._touched, self._motion = False, None
        if scene.goal is not None:
            if self._goal < 0:
                disc = pybullet.createVisualShape(
                    pybullet.GEOM_CYLINDER,
                    radius=0.15,
                    length=0.01,
                    rgbaColor=GOAL_PAINT,
                    physicsClientId=client,
                )
                self._goal = pybullet.createMultiBody(0.0, -1, disc, physicsClientId=client)
            pybullet.resetBasePositionAndOrientation(
                self._goal, (*scene.goal, 0.006), (0.0, 0.0, 0.0, 1.0), physicsClientId=client
            )
        self.wheel_angles: Speeds = ZERO
        self.wheel_speeds: Speeds = ZERO

    def step(self, set_points: Speeds) -> None:
        """Simulate one firmware loop: tyre force and torque, then one engine step."""
        robot, client = self._robot, self._client
        position, orientation, velocity, spin = self._motion or self._read_motion()
        force, torque, self.wheel_speeds, self.wheel_angles = _push_robot(
            orientation,
            velocity,
            spin,
            self.wheel_speeds,
            self.wheel_angles,
            set_points,
            self._physics,
            self._dt,
        )
        _apply_force(robot, -1, force, position, _WORLD, client)
        _apply_torque(robot, -1, torque, _WORLD, client)
        _simulate(client)
        self._motion = None

    def _read_motion(self) -> Motion:
        """Read from PyBullet how the robot moves, and keep it until the next step."""
        robot, client = self._robot, self._client
        self._motion = motion = (*_pose_of(robot, client), *_velocity_of(robot, client))
        return motion

    def place_movers(self, crowd: Crowd) -> None:
        """Put movers where they are, at their velocities; without pictures only those near by."""
        self._crowd = crowd
        (x, y, _), *_ = self._motion or self._read_motion()
        self._movers.place(crowd, x, y, math.inf if self._seen else self._near)

    def feel(self) -> None:
        """Check whether the robot touches a standing obstacle: overlaps it, or is pushed by it."""
        obstacles = self._statics.bodies
        if obstacles and not self._touched:
            points = pybullet.getContactPoints(bodyA=self._robot, physicsClientId=self._client)
            self._touched = any(p[2] in obstacles and (p[8] <= 0.0 or p[9] > 0.0) for p in points)

    def engine_step(self) -> None:
        """Call PyBullet's stepSimulation alone, for benchmarks."""
        pybullet.stepSimulation(self._client)
        self._motion = None

    def rays(self, place: tuple[float, float], bearings: Floats, reach: float) -> Floats:
        """Measure ranges with PyBullet's own rays, for tests and benchmarks.

        A ray may stop up to a millimetre beside a cylinder's surface; environments don't use it.
        """
        (x, y), height = place, self._config.lidar_z_offset
        ends = np.column_stack([x + reach * np.cos(bearings), y + reach * np.sin(bearings)])
        starts = [(x, y, height)] * len(ends)
        hits = pybullet.rayTestBatch(
            starts, [(*end, height) for end in ends.tolist()], physicsClientId=self._client
        )
        return np.array([hit[2] * reach for hit in hits])

    @property
    def truth(self) -> GroundTruth:
        """Ground truth of the robot, in the frame of the world."""
        (x, y, _), orientation, (vx, vy, _), (_, _, rate) = self._motion or self._read_motion()
        theta = pybullet.getEulerFromQuaternion(orientation)[2]
        forward = vx * math.cos(theta) + vy * math.sin(theta)
        return GroundTruth((x, y, theta), (forward, rate), self._touched)

    @property
    def power(self) -> float:
        """Mechanical power of the motors now [W]; see `physics.model.motor_power`."""
        _, (qx, qy, qz, qw), (vx, vy, _), (_, _, rate) = self._motion or self._read_motion()
        cos, sin = 1.0 - 2.0 * (qy * qy + qz * qz), 2.0 * (qw * qz + qx * qy)
        return model.motor_power(cos, sin, (vx, vy, rate), self.wheel_speeds, self._physics)

    def image(self, width: int, height: int) -> Image:
        """Take a picture with PyBullet's camera from behind and above: (height, width, 3), RGB."""
        self._seen = True
        self._statics.paint()
        if self._crowd is not None:
            self.place_movers(self._crowd)
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


def make_robot(config: RobotConfig, client: int) -> int:
    """Make a rigid body of chassis and four wheels, its origin at the height of the axles.

    The chassis is a box, or upright convex prisms where the footprint is a polygon. The wheels'
    collision shapes are small spheres ("feet") that touch the floor below the hubs: one contact
    each, at the right place, and nothing beyond the footprint. Returns PyBullet's number.
    """
    body, radius = config.body, config.wheel_radius
    bottom = min(CHASSIS_CLEARANCE, radius) - radius
    top = max(body.height - radius, bottom + 0.01)
    polygon = config.footprint
    with write_mesh(polygon, bottom, top) if polygon else contextlib.nullcontext("") as file:
        feet, foot = place_feet(config)
        (half_x, half_y), none = config.outline[0], (0.0, 0.0, 0.0)
        chassis = none if polygon else (0.0, 0.0, (top + bottom) / 2.0)
        touchable = pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_MESH if polygon else pybullet.GEOM_BOX]
            + [pybullet.GEOM_SPHERE] * 4,
            halfExtents=[(half_x, half_y, (top - bottom) / 2.0)] + [none] * 4,
            radii=[0.0] + [foot] * 4,
            fileNames=[file] + [""] * 4,
            meshScales=[(1.0, 1.0, 1.0)] * 5,
            collisionFramePositions=[chassis, *((x, y, foot - radius) for x, y in feet)],
            physicsClientId=client,
        )
        shapes = _visual_shapes(config, bottom, top, file)
        visible = pybullet.createVisualShapeArray(
            shapeTypes=[s.kind for s in shapes],
            fileNames=[s.file for s in shapes],
            meshScales=[(1.0, 1.0, 1.0) for _ in shapes],
            halfExtents=[s.box for s in shapes],
            radii=[s.radius for s in shapes],
            lengths=[s.length for s in shapes],
            rgbaColors=[s.colour for s in shapes],
            visualFramePositions=[s.at for s in shapes],
            visualFrameOrientations=[s.turn for s in shapes],
            physicsClientId=client,
        )
        body_id = int(
            pybullet.createMultiBody(
                body.mass, touchable, visible, (0.0, 0.0, radius), physicsClientId=client
            )
        )
    pybullet.changeDynamics(
        body_id,
        -1,
        lateralFriction=0.0,
        rollingFriction=0.0,
        spinningFriction=0.0,
        restitution=0.0,
        linearDamping=0.0,
        angularDamping=0.0,
        physicsClientId=client,
    )
    return body_id


def place_feet(config: RobotConfig) -> tuple[list[Point], float]:
    """Centres and radius [m] of the feet, such that none is outside the footprint.

    They are below the hubs, or as near to them as the footprint allows.
    """
    outline, feet = config.outline, []
    for x, y in wheel_hubs(config):
        shares = (share / FOOT_PLACES for share in range(FOOT_PLACES, 0, -1))
        inside = (s for s in shares if contains_point(outline, s * x, s * y))
        fits = (s for s in inside if border_distance(outline, s * x, s * y) >= LEAST_FOOT)
        share = next(fits, 0.0)
        feet.append((share * x, share * y))
    return feet, min(config.wheel_radius, *(border_distance(outline, *foot) for foot in feet))


def wheel_hubs(config: RobotConfig) -> list[Point]:
    """Wheel centres in the base frame, order front_right, front_left, rear_left, rear_right."""
    a, b = config.wheelbase / 2.0, config.wheel_separation / 2.0
    return [(a, -b), (a, b), (-a, b), (-a, -b)]


class _Shape(NamedTuple):
    """A visual shape: a box of half sizes, a cylinder along z, or a file."""

    kind: int
    at: Point3
    colour: tuple[float, float, float, float]
    box: Point3 = (0.0, 0.0, 0.0)
    radius: float = 0.0
    length: float = 0.0
    turn: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    file: str = ""


def _visual_shapes(config: RobotConfig, bottom: float, top: float, file: str) -> list[_Shape]:
    """Chassis and deck, or a polygon's prisms, then LiDAR and four tyres."""
    body = config.body
    tyre = max(0.02, body.width - config.wheel_separation)
    inner = max(0.02, config.wheel_separation - tyre - 0.01)
    middle, over, lidar = (0.0, 0.0, (top + bottom) / 2), (0.0, 0.0, top + 0.004), body.length / 4
    chassis, deck = (
        (body.length / 2, inner / 2, (top - bottom) / 2),
        (body.length / 2.2, inner / 2.2),
    )
    box, cylinder = pybullet.GEOM_BOX, pybullet.GEOM_CYLINDER
    if file:
        hull = [_Shape(pybullet.GEOM_MESH, (0.0, 0.0, 0.0), CHASSIS_COLOUR, file=file)]
    else:
        hull = [
            _Shape(box, middle, CHASSIS_COLOUR, chassis),
            _Shape(box, over, DECK_COLOUR, (*deck, 0.004)),
        ]
    sideways = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))
    wheel = _Shape(
        cylinder,
        (0.0, 0.0, 0.0),
        WHEEL_COLOUR,
        radius=config.wheel_radius,
        length=tyre,
        turn=sideways,
    )
    return [
        *hull,
        _Shape(cylinder, (lidar, 0.0, top + 0.028), WHEEL_COLOUR, radius=0.035, length=0.04),
        *(wheel._replace(at=(x, y, 0.0)) for x, y in wheel_hubs(config)),
    ]


@contextlib.contextmanager
def write_mesh(outline: Outline, low: float, high: float) -> Iterator[str]:
    """Write a temporary Wavefront file with an upright prism for each convex piece of an outline.

    PyBullet reads shapes of many corners from files only. It uses the convex hull of each object
    in a file, so each piece is an object, and notches stay open. Its hulls are 1 mm larger on
    every side. The file is deleted after the block.
    """
    lines, first = [], 1  # of corners, which count from 1
    for number, piece in enumerate(convex_pieces(outline)):
        count = len(piece)
        lines.append(f"o piece{number}")
        lines += [f"v {x!r} {y!r} {z!r}" for z in (low, high) for x, y in piece]
        under, upper = range(first, first + count), range(first + count, first + 2 * count)
        around = zip(under, (*under[1:], first), strict=True)
        sides = [(one, other, other + count, one + count) for one, other in around]
        lines += ["f " + " ".join(map(str, face)) for face in (upper, reversed(under), *sides)]
        first += 2 * count
    with tempfile.TemporaryDirectory(prefix="acsar_gym_") as folder:
        file = Path(folder) / "footprint.obj"
        file.write_text("\n".join(lines), encoding="ascii")
        yield str(file)


class StaticObstacles:
    """The obstacles of one world, or none, as static compounds of up to 16 shapes each.

    Every body costs time in every step of the engine, and a compound near the robot costs more, so
    a compound has obstacles that are near each other. They are never changed or removed: PyBullet
    leaks the shapes of bodies that are removed, but not those of a simulation that is reset, so
    another world needs another simulation. Visual shapes take ten times as long to make as
    collision shapes, so `paint` makes them when they are needed.

    Attributes: `world`; `bodies`, PyBullet's numbers of the compounds.
    """

    def __init__(self, client: int, world: World | None) -> None:
        self._client = client
        self.world = world
        self._compounds = [] if world is None else _compounds(world)
        self._painted = False
        self.bodies: set[int] = set()
        # A tiny shape below the floor: without a visual one PyBullet would make a slow one itself.
        hidden = -1
        if self._compounds:
            hidden = pybullet.createVisualShape(
                pybullet.GEOM_BOX,
                halfExtents=(1e-3, 1e-3, 1e-3),
                visualFramePosition=(0.0, 0.0, -1.0),
                physicsClientId=client,
            )
        for options in self._compounds:
            named = {f"collisionFrame{k}" if k in FRAME_KEYS else k: options[k] for k in options}
            shape = pybullet.createCollisionShapeArray(**named, physicsClientId=client)
            # A body in maximal coordinates takes a third of the time of PyBullet's multibodies.
            body = pybullet.createMultiBody(
                0.0, shape, hidden, useMaximalCoordinates=1, physicsClientId=client
            )
            self.bodies.add(int(body))

    def paint(self) -> None:
        """Make the obstacles visible to PyBullet's camera and window; idempotent."""
        for options in () if self._painted else self._compounds:
            named = {f"visualFrame{k}" if k in FRAME_KEYS else k: options[k] for k in options}
            colours = [OBSTACLE_PAINT] * len(options["shapeTypes"])
            shape = pybullet.createVisualShapeArray(
                **named, rgbaColors=colours, physicsClientId=self._client
            )
            pybullet.createMultiBody(0.0, -1, shape, physicsClientId=self._client)
        self._painted = True


class MovingObstacles:
    """The movers of one world, or none: fixed bodies with a velocity.

    PyBullet moves such a body on by itself, lets nothing stop it, and pushes the robot at its
    speed. Those far away from the robot wait below the floor: to place a body takes time.
    """

    def __init__(self, client: int, world: World | None) -> None:
        self._client = client
        self._bodies = [] if world is None else [self._make(one.radius) for one in world.movers]
        self._placed: list[int] = []
        """Numbers of those above the floor."""

    def _make(self, radius: float) -> int:
        client = self._client
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_CYLINDER, radius=radius, height=MOVER_HEIGHT, physicsClientId=client
        )
        visible = pybullet.createVisualShape(
            pybullet.GEOM_CYLINDER,
            radius=radius,
            length=MOVER_HEIGHT,
            rgbaColor=MOVER_PAINT,
            physicsClientId=client,
        )
        body = int(pybullet.createMultiBody(0.0, shape, visible, BELOW, physicsClientId=client))
        pybullet.changeDynamics(
            body,
            -1,
            lateralFriction=0.0,
            contactStiffness=PUSH_STIFFNESS,
            contactDamping=PUSH_DAMPING,
            physicsClientId=client,
        )
        return body

    def place(self, crowd: Crowd, x: float, y: float, reach: float) -> None:
        """Put those where they are whose hulls are within reach of a place [m], away the others."""
        near = list_near(crowd.states, crowd.radii, x, y, reach)
        self.park(near)
        for number in near:
            x, y, vx, vy = crowd.states[number, :4].tolist()
            self._move(number, (x, y, MOVER_HEIGHT / 2.0), (vx, vy, 0.0))
        self._placed = near

    def park(self, kept: Sequence[int] = ()) -> None:
        """Put those away that are above the floor, but for some."""
        for number in self._placed:
            if number not in kept:
                self._move(number, BELOW, STANDSTILL)
        self._placed = []

    def _move(self, number: int, position: Point3, velocity: Point3) -> None:
        body, client = self._bodies[number], self._client
        pybullet.resetBasePositionAndOrientation(body, position, UPRIGHT, client)
        pybullet.resetBaseVelocity(body, velocity, STANDSTILL, client)


@loop
def list_near(states: Floats, radii: Floats, x: float, y: float, reach: float) -> list[int]:
    """Numbers of the movers whose hulls are within reach of a place [m]."""
    return [
        m
        for m in range(len(radii))
        if math.hypot(states[m, X] - x, states[m, Y] - y) < radii[m] + reach
    ]


def _compounds(world: World) -> list[dict[str, Any]]:
    """Arguments of PyBullet's createCollisionShapeArray for every compound."""
    found: list[dict[str, Any]] = [
        {
            "shapeTypes": [pybullet.GEOM_CYLINDER] * len(circles),
            "radii": np.maximum(circles[:, 2], 1e-3).tolist(),
            "lengths": [OBSTACLE_HEIGHT] * len(circles),
            "Positions": [(x, y, OBSTACLE_HEIGHT / 2.0) for x, y, _ in circles.tolist()],
        }
        for circles in _group_neighbours(world.circles, world.circles[:, :2])
    ]
    middles = (world.segments[:, :2] + world.segments[:, 2:]) / 2.0
    for segments in _group_neighbours(world.segments, middles):
        along = segments[:, 2:] - segments[:, :2]
        lengths, angles = np.hypot(along[:, 0], along[:, 1]), np.arctan2(along[:, 1], along[:, 0])
        centres = ((segments[:, :2] + segments[:, 2:]) / 2.0).tolist()
        walls = {
            "shapeTypes": [pybullet.GEOM_BOX] * len(segments),
            "halfExtents": [
                (max(n / 2.0, 1e-3), WALL_THICKNESS / 2.0, OBSTACLE_HEIGHT / 2.0)
                for n in lengths.tolist()
            ],
            "Positions": [(x, y, OBSTACLE_HEIGHT / 2.0) for x, y in centres],
            "Orientations": [
                (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0))
                for angle in angles.tolist()
            ],
        }
        found.append(walls)
    return found


def _group_neighbours(rows: Floats, places: Floats) -> Iterator[Floats]:
    """Split rows into groups that are near each other and small enough for a compound."""
    if len(rows) > MAX_SHAPES:
        axis = int(np.ptp(places[:, 1]) > np.ptp(places[:, 0]))
        order = np.argsort(places[:, axis], kind="stable")
        half = MAX_SHAPES * math.ceil(len(rows) / MAX_SHAPES / 2)
        for part in (order[:half], order[half:]):
            yield from _group_neighbours(rows[part], places[part])
    elif len(rows):
        yield rows
