"""The skid-steer robot in PyBullet.

One rigid body, pushed by the tyre forces of `physics.model`.
"""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
import weakref
from collections.abc import Iterator
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
)
from acsar_gym.errors import MissingExtraError, RenderError
from acsar_gym.jit import record_of
from acsar_gym.physics import GRAVITY, Physics, body, compute_physics
from acsar_gym.physics import model as dynamics
from acsar_gym.physics.body import GroundTruth, Image
from acsar_gym.physics.model import loop_period, motor_power
from acsar_gym.protocol import ZERO, Speeds
from acsar_gym.worlds import Scene, World


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
except ImportError:
    raise MissingExtraError("the PyBullet robot", "bullet") from None


def connect_engine(window: bool) -> int:
    """Connect to a new PyBullet simulation.

    Args:
        window: whether it has a window.

    Returns:
        PyBullet's number of the connection.

    Raises:
        RenderError: a window is asked for, and there is no display.
    """
    if not window:
        return int(pybullet.connect(pybullet.DIRECT))
    if not body.has_display():
        raise RenderError("PyBullet's window needs a display; drive without a window here")
    client = int(pybullet.connect(pybullet.GUI))
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    return client


@contextlib.contextmanager
def write_mesh(outline: Outline, low: float, high: float) -> Iterator[str]:
    """Write a temporary Wavefront file with a prism for each convex piece of an outline.

    PyBullet reads shapes of many corners from files only. It uses the convex hull of each object
    in a file, so each piece is an object, and notches stay open. Its hulls are 1 mm larger on
    every side. The file is deleted after the block.

    Args:
        outline: corners in the base frame [m].
        low: least height [m].
        high: largest height [m].

    Yields:
        Name of the file.
    """
    with tempfile.TemporaryDirectory(prefix="acsar_gym_") as folder:
        file = Path(folder) / "footprint.obj"
        file.write_text("\n".join(_lines(convex_pieces(outline), low, high)), encoding="ascii")
        yield str(file)


def _lines(pieces: list[Outline], low: float, high: float) -> Iterator[str]:
    """Wavefront lines: corners of both ends, then the faces, whose corners count from 1."""
    first = 1
    for number, piece in enumerate(pieces):
        count = len(piece)
        yield f"o piece{number}"
        for z in (low, high):
            yield from (f"v {x!r} {y!r} {z!r}" for x, y in piece)
        yield _face(range(first + count, first + 2 * count))
        yield _face(reversed(range(first, first + count)))
        for n in range(count):
            one, other = first + n, first + (n + 1) % count
            yield _face((one, other, other + count, one + count))
        first += 2 * count


def _face(corners: range | Iterator[int] | tuple[int, ...]) -> str:
    """Wavefront line of a face."""
    return "f " + " ".join(map(str, corners))


MAX_SHAPES = 16
"""Shapes of a compound, at most; PyBullet's limit."""
OBSTACLE_HEIGHT = 0.6
"""Height of every obstacle [m]."""
WALL_THICKNESS = 0.002
"""Thickness of a segment's wall [m]."""
FRAME_KEYS = ("Positions", "Orientations")
"""Keys to which PyBullet adds a prefix, another for collision shapes than for visual ones."""
OBSTACLE_COLOUR = (0.42, 0.45, 0.5, 1.0)

Rows = NDArray[np.float64]


class StaticObstacles:
    """The obstacles of one world, or none. They are never changed or removed.

    PyBullet leaks the shapes of bodies that are removed, but not those of a simulation that is
    reset, so another world needs another simulation. Visual shapes take ten times as long to make
    as collision shapes, so `paint` makes them when they are needed.
    """

    def __init__(self, client: int, world: World | None) -> None:
        self._client = client
        self.world = world
        self._compounds = [] if world is None else list(_compounds(world))
        self._painted = False
        hidden = self._hidden() if self._compounds else -1
        self._bodies = {self._touchable(options, hidden) for options in self._compounds}

    def _hidden(self) -> int:
        """A tiny shape below the floor.

        Without a visual shape PyBullet would make a slow one itself.
        """
        return int(
            pybullet.createVisualShape(
                pybullet.GEOM_BOX,
                halfExtents=(1e-3, 1e-3, 1e-3),
                visualFramePosition=(0.0, 0.0, -1.0),
                physicsClientId=self._client,
            )
        )

    def _touchable(self, options: dict[str, Any], visual: int) -> int:
        """Make the body of a compound's collision shapes.

        A rigid body in maximal coordinates takes a third of the time of PyBullet's multibodies.
        """
        named = {
            f"collisionFrame{key}" if key in FRAME_KEYS else key: options[key] for key in options
        }
        shape = pybullet.createCollisionShapeArray(**named, physicsClientId=self._client)
        return int(
            pybullet.createMultiBody(
                0.0, shape, visual, useMaximalCoordinates=1, physicsClientId=self._client
            )
        )

    def paint(self) -> None:
        """Make the obstacles visible to PyBullet's camera and window; idempotent."""
        if self._painted:
            return
        self._painted = True
        for options in self._compounds:
            named = {
                f"visualFrame{key}" if key in FRAME_KEYS else key: options[key] for key in options
            }
            colours = [OBSTACLE_COLOUR] * len(options["shapeTypes"])
            shape = pybullet.createVisualShapeArray(
                **named, rgbaColors=colours, physicsClientId=self._client
            )
            pybullet.createMultiBody(0.0, -1, shape, physicsClientId=self._client)

    def __contains__(self, body: int) -> bool:
        return body in self._bodies

    def __len__(self) -> int:
        return len(self._bodies)


def _compounds(world: World) -> Iterator[dict[str, Any]]:
    """Arguments of PyBullet's createCollisionShapeArray for every compound."""
    for circles in _neighbours(world.circles, world.circles[:, :2]):
        yield _cylinders(circles)
    middles = (world.segments[:, :2] + world.segments[:, 2:]) / 2.0
    for segments in _neighbours(world.segments, middles):
        yield _walls(segments)


def _neighbours(rows: Rows, places: Rows) -> Iterator[Rows]:
    """Split rows into groups that are near each other and small enough for a compound."""
    if len(rows) > MAX_SHAPES:
        axis = int(np.ptp(places[:, 1]) > np.ptp(places[:, 0]))
        order = np.argsort(places[:, axis], kind="stable")
        half = MAX_SHAPES * math.ceil(len(rows) / MAX_SHAPES / 2)
        for part in (order[:half], order[half:]):
            yield from _neighbours(rows[part], places[part])
    elif len(rows):
        yield rows


def _cylinders(circles: Rows) -> dict[str, Any]:
    """PyBullet's arguments for circles, as upright cylinders."""
    return {
        "shapeTypes": [pybullet.GEOM_CYLINDER] * len(circles),
        "radii": np.maximum(circles[:, 2], 1e-3).tolist(),
        "lengths": [OBSTACLE_HEIGHT] * len(circles),
        "Positions": [(x, y, OBSTACLE_HEIGHT / 2.0) for x, y, _ in circles.tolist()],
    }


def _walls(segments: Rows) -> dict[str, Any]:
    """PyBullet's arguments for segments, as thin upright boxes."""
    along = segments[:, 2:] - segments[:, :2]
    lengths, angles = np.hypot(along[:, 0], along[:, 1]), np.arctan2(along[:, 1], along[:, 0])
    middles = ((segments[:, :2] + segments[:, 2:]) / 2.0).tolist()
    return {
        "shapeTypes": [pybullet.GEOM_BOX] * len(segments),
        "halfExtents": [
            (max(n / 2.0, 1e-3), WALL_THICKNESS / 2.0, OBSTACLE_HEIGHT / 2.0)
            for n in lengths.tolist()
        ],
        "Positions": [(x, y, OBSTACLE_HEIGHT / 2.0) for x, y in middles],
        "Orientations": [
            (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0)) for angle in angles.tolist()
        ],
    }


CHASSIS_COLOUR = (0.16, 0.35, 0.58, 1.0)
DECK_COLOUR = (0.85, 0.87, 0.9, 1.0)
WHEEL_COLOUR = (0.12, 0.12, 0.13, 1.0)
FOOT_PLACES = 100
"""Places between a hub and the middle of the robot that are tried for a foot."""
LEAST_FOOT = 1e-3
"""Radius of the smallest foot [m]."""
CLEARANCE = 0.02
"""Height of the chassis above the floor [m]."""


def make_floor(client: int) -> int:
    """Make a frictionless plane; returns PyBullet's number of its body."""
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    plane_id = int(pybullet.createMultiBody(0.0, plane, physicsClientId=client))
    pybullet.changeDynamics(plane_id, -1, lateralFriction=0.0, physicsClientId=client)
    return plane_id


def make_robot(config: RobotConfig, client: int) -> int:
    """Make a rigid body of chassis and four wheels, its origin at the height of the axles.

    The chassis is a box, or upright convex prisms where the footprint is a polygon. The wheels'
    collision shapes are small spheres ("feet") that touch the floor below the hubs: one contact
    each, at the right place, and nothing beyond the footprint. Returns PyBullet's number.
    """
    body, radius = config.body, config.wheel_radius
    bottom = min(CLEARANCE, radius) - radius
    top = max(body.height - radius, bottom + 0.01)
    polygon = config.footprint
    prisms = write_mesh(polygon, bottom, top) if polygon else contextlib.nullcontext("")
    with prisms as file:
        body_id = int(
            pybullet.createMultiBody(
                body.mass,
                _touchable(config, bottom, top, file, client),
                _visual(config, bottom, top, file, client),
                (0.0, 0.0, radius),
                physicsClientId=client,
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


def set_mass(body_id: int, own: Physics, client: int) -> None:
    """Set the robot's mass and inertia."""
    pybullet.changeDynamics(
        body_id,
        -1,
        mass=own.mass,
        localInertiaDiagonal=(own.yaw_inertia, own.yaw_inertia, own.yaw_inertia),
        physicsClientId=client,
    )


def _touchable(config: RobotConfig, bottom: float, top: float, file: str, client: int) -> int:
    """Make the collision shape: a box or the prisms of a file, and a foot below each hub."""
    feet, foot = _feet(config)
    z = foot - config.wheel_radius
    is_box = not file
    (half_x, half_y), none = config.outline[0], (0.0, 0.0, 0.0)
    middle = (0.0, 0.0, (top + bottom) / 2.0) if is_box else none
    return int(
        pybullet.createCollisionShapeArray(
            shapeTypes=[pybullet.GEOM_BOX if is_box else pybullet.GEOM_MESH]
            + [pybullet.GEOM_SPHERE] * 4,
            halfExtents=[(half_x, half_y, (top - bottom) / 2.0)] + [none] * 4,
            radii=[0.0] + [foot] * 4,
            fileNames=["" if is_box else file] + [""] * 4,
            meshScales=[(1.0, 1.0, 1.0)] * 5,
            collisionFramePositions=[middle, *((x, y, z) for x, y in feet)],
            physicsClientId=client,
        )
    )


def _feet(config: RobotConfig) -> tuple[list[Point], float]:
    """Centres and radius [m] of the feet, such that none is outside the footprint.

    They are below the hubs, or as near to them as the footprint allows.
    """
    outline, radius = config.outline, config.wheel_radius
    feet, room = [], []
    for x, y, _ in _hubs(config):
        shares = [share / FOOT_PLACES for share in range(FOOT_PLACES, 0, -1)]
        inside = (s for s in shares if contains_point(outline, s * x, s * y))
        share = next(
            (s for s in inside if border_distance(outline, s * x, s * y) >= LEAST_FOOT), 0.0
        )
        feet.append((share * x, share * y))
        room.append(border_distance(outline, *feet[-1]))
    return feet, min(radius, *room)


def _hubs(config: RobotConfig, z: float = 0.0) -> list[tuple[float, float, float]]:
    """Wheel centres in the base frame, order front_right, front_left, rear_left, rear_right."""
    a, b = config.wheelbase / 2.0, config.wheel_separation / 2.0
    return [(a, -b, z), (a, b, z), (-a, b, z), (-a, -b, z)]


class _Shape(NamedTuple):
    """A visual shape: a box of half sizes, a cylinder of (radius, length) along z, or a file."""

    box: tuple[float, float, float] | None
    cylinder: tuple[float, float]
    at: tuple[float, float, float]
    colour: tuple[float, float, float, float]
    turn: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    file: str = ""

    @property
    def kind(self) -> int:
        """PyBullet's number of the kind of shape."""
        if self.file:
            return int(pybullet.GEOM_MESH)
        return int(pybullet.GEOM_BOX if self.box else pybullet.GEOM_CYLINDER)


def _shapes(config: RobotConfig, bottom: float, top: float, file: str) -> list[_Shape]:
    """The visual shapes: chassis and deck, or a polygon's prisms, then LiDAR and four tyres."""
    body, flat = config.body, (0.0, 0.0)
    tyre = max(0.02, body.width - config.wheel_separation)
    inner = max(0.02, config.wheel_separation - tyre - 0.01)
    sideways = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))
    chassis = (body.length / 2, inner / 2, (top - bottom) / 2)
    deck = (body.length / 2.2, inner / 2.2, 0.004)
    hull = [
        _Shape(chassis, flat, (0.0, 0.0, (top + bottom) / 2), CHASSIS_COLOUR),
        _Shape(deck, flat, (0.0, 0.0, top + 0.004), DECK_COLOUR),
    ]
    prisms = [_Shape(None, flat, (0.0, 0.0, 0.0), CHASSIS_COLOUR, file=file)]
    return [
        *(hull if config.footprint is None else prisms),
        _Shape(None, (0.035, 0.04), (body.length / 4, 0.0, top + 0.028), WHEEL_COLOUR),
        *(
            _Shape(None, (config.wheel_radius, tyre), hub, WHEEL_COLOUR, sideways)
            for hub in _hubs(config)
        ),
    ]


def _visual(config: RobotConfig, bottom: float, top: float, file: str, client: int) -> int:
    """Make the visual shape; returns PyBullet's number of it."""
    shapes = _shapes(config, bottom, top, file)
    return int(
        pybullet.createVisualShapeArray(
            shapeTypes=[s.kind for s in shapes],
            fileNames=[s.file for s in shapes],
            meshScales=[(1.0, 1.0, 1.0) for _ in shapes],
            halfExtents=[s.box or (0.0, 0.0, 0.0) for s in shapes],
            radii=[s.cylinder[0] for s in shapes],
            lengths=[s.cylinder[1] for s in shapes],
            rgbaColors=[s.colour for s in shapes],
            visualFramePositions=[s.at for s in shapes],
            visualFrameOrientations=[s.turn for s in shapes],
            physicsClientId=client,
        )
    )


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
        self._dt = loop_period(config)
        self._configured = compute_physics(config)
        self._client = connect_engine(window)
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
        self._floor = make_floor(client)
        self._robot = make_robot(self._config, client)
        self._statics = StaticObstacles(client, world)
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
        set_mass(self._robot, own, self._client)
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
