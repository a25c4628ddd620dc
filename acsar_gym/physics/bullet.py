"""The skid-steer robot in PyBullet: one rigid body, pushed by the tyre forces of `physics.model`.

PyBullet's own contact friction can't model skid steering (its friction axes are fixed in the
world), so all contacts with the floor are frictionless and the four tyre forces are applied as one
force and one torque on the chassis. No other file imports PyBullet.
"""

from __future__ import annotations

import contextlib
import functools
import math
import os
import tempfile
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import (
    Outline,
    Point,
    border_distance,
    contains_point,
    outline_radius,
)
from acsar_gym.errors import ConfigError, MissingExtraError
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
from acsar_gym.protocol import Speeds
from acsar_gym.worlds import Pose, Scene, World
from acsar_gym.worlds.crowd import Crowd, X, Y
from acsar_gym.worlds.movers import MAX_MOVER_SPEED


@contextlib.contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Hide the banner that PyBullet's C code prints when it is imported."""
    # C code writes to the descriptor, which redirecting `sys.stderr` doesn't change.
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

Point3 = tuple[float, float, float]

ORIGIN: Point3 = (0.0, 0.0, 0.0)
"""Also the velocity of a body at rest."""
UPRIGHT: model.Quaternion = (0.0, 0.0, 0.0, 1.0)
SIDEWAYS: model.Quaternion = (math.sin(math.pi / 4), 0.0, 0.0, math.cos(math.pi / 4))
BELOW: Point3 = (0.0, 0.0, -5.0)
"""Where movers wait that are far away from the robot [m]."""
NEAR_MARGIN = 0.5
"""Movers that may come so near to the robot in a tick are in the simulation [m]."""
PUSH_STIFFNESS = 1e4
PUSH_DAMPING = 2e3
"""Of the contact between a mover and the robot [N/m, N s/m]: the robot is pushed at the mover's
speed, and a robot that is squeezed between a mover and a wall isn't flung away."""
MAX_SHAPES = 16
"""Most shapes of a compound, PyBullet's limit."""
MIN_SIZE = 1e-3
"""Smallest radius or half length of an obstacle, and radius of a foot [m]."""
FOOT_PLACES = 100
"""Places between a hub and the middle of the robot that are tried for a foot."""
OTHER = 2
DISTANCE = 8
FORCE = 9
"""Columns of a contact: number of the other body, distance [m] and normal force [N]."""
CHASSIS_COLOUR: Paint = (0.16, 0.35, 0.58, 1.0)
DECK_COLOUR: Paint = (0.85, 0.87, 0.9, 1.0)
WHEEL_COLOUR: Paint = (0.12, 0.12, 0.13, 1.0)


class Engine:
    """A connection to PyBullet, whose functions are methods: `engine.setGravity(...)`."""

    def __init__(self, mode: int) -> None:
        self.number = int(pybullet.connect(mode))
        self.close = weakref.finalize(self, pybullet.disconnect, self.number)

    def __getattr__(self, name: str) -> Any:
        """Return a function of PyBullet for this connection."""
        return functools.partial(getattr(pybullet, name), physicsClientId=self.number)


class BulletBody(Body):
    """A PyBullet simulation with a floor, a robot and the obstacles of a world.

    Args:
        config: Robot configuration.
        window: Whether to open PyBullet's own window.

    Raises:
        ConfigError: There is no display for the window.
    """

    def __init__(self, config: RobotConfig, *, window: bool = False) -> None:
        super().__init__(config)
        reach = outline_radius(config.outline)

        # A mover that is farther away can't reach the robot within a tick.
        self._near = reach + MAX_MOVER_SPEED * config.period + NEAR_MARGIN

        if window and not has_display():
            raise ConfigError("PyBullet's window needs a display; drive without a window here")
        if window:
            prepare_opengl()
        self._engine = Engine(pybullet.GUI if window else pybullet.DIRECT)
        if window:
            self._engine.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0)
        self._visible = window
        self._build(None)
        self.reset(Scene())

    def _build(self, world: World | None) -> None:
        """Make an empty simulation with a floor, the robot and the obstacles of a world."""
        engine = self._engine
        engine.resetSimulation()
        engine.setGravity(0.0, 0.0, -model.GRAVITY)
        # Without deterministic pairs the same seed might give other contacts.
        engine.setPhysicsEngineParameter(fixedTimeStep=self._dt, deterministicOverlappingPairs=1)
        floor = engine.createMultiBody(0.0, engine.createCollisionShape(pybullet.GEOM_PLANE))
        # Tyre forces come from `physics.model`: the floor only carries the robot.
        engine.changeDynamics(floor, -1, lateralFriction=0.0)
        self._robot = make_robot(self._config, engine)
        self._obstacles = StandingObstacles(engine, world)
        self._movers = MovingObstacles(engine, world)

        # The reset of the simulation removed the disc, so its number is void.
        self._goal: int | None = None
        if self._visible:
            self._obstacles.paint()

    def reset(self, scene: Scene) -> None:
        """Put the robot at rest at the scene's start, with the scene's world, physics and goal."""
        super().reset(scene)

        # Objects of another world can't be removed without a leak: make another simulation.
        if scene.world is not self._obstacles.world:
            self._build(scene.world)
        # Movers of the last episode must not touch the robot at its new start.
        self._movers.park()
        self._crowd: Crowd | None = None
        self._motion: model.Motion | None = None

        # PyBullet needs inertia about three axes, of which only yaw matters on a flat floor.
        physics = self._physics
        self._engine.changeDynamics(
            self._robot, -1, mass=physics.mass, localInertiaDiagonal=(physics.yaw_inertia,) * 3
        )
        # The origin of the body is at the height of the axles.
        x, y, theta = scene.start
        self._engine.resetBasePositionAndOrientation(
            self._robot, (x, y, self._config.wheel_radius), turn_about_z(theta)
        )
        self._engine.resetBaseVelocity(self._robot, ORIGIN, ORIGIN)
        if scene.goal is not None:
            self._mark_goal(scene.goal)

    def _mark_goal(self, goal: Point) -> None:
        """Put a disc on the floor."""
        if self._goal is None:
            # A disc that can only be seen is made once and then moved.
            disc = Shape(
                pybullet.GEOM_CYLINDER, ORIGIN, GOAL_PAINT, radius=GOAL_RADIUS, length=0.01
            )
            self._goal = show_shapes(self._engine, [disc])
        self._engine.resetBasePositionAndOrientation(self._goal, (*goal, 0.006), UPRIGHT)

    def step(self, set_points: Speeds) -> None:
        """Simulate one firmware loop: tyre force and torque, then one engine step."""
        robot = self._robot
        client = self._engine.number
        position, orientation, velocity, spin = self._motion or self._read_motion()
        force, torque, self.wheel_speeds, self.wheel_angles = model.push_robot(
            orientation,
            velocity,
            spin,
            self.wheel_speeds,
            self.wheel_angles,
            set_points,
            self._record,
            self._dt,
        )

        # Without keywords and `Engine`, which take longer: every firmware loop makes these calls.
        pybullet.applyExternalForce(robot, -1, force, position, pybullet.WORLD_FRAME, client)
        pybullet.applyExternalTorque(robot, -1, torque, pybullet.WORLD_FRAME, client)
        pybullet.stepSimulation(client)
        # The engine has moved the robot, so the motion that was read is out of date.
        self._motion = None

    def _read_motion(self) -> model.Motion:
        """Read from PyBullet how the robot moves, and keep it until the next step."""
        robot = self._robot
        client = self._engine.number
        position, orientation = pybullet.getBasePositionAndOrientation(robot, client)
        motion = (position, orientation, *pybullet.getBaseVelocity(robot, client))
        self._motion = motion
        return motion

    def place_movers(self, crowd: Crowd) -> None:
        """Put movers where they are, at their velocities. Without pictures only those near by."""
        self._crowd = crowd
        x, y, _ = (self._motion or self._read_motion())[0]
        self._movers.place(crowd, x, y, math.inf if self._visible else self._near)

    def feel(self) -> None:
        """Check whether the robot touches a standing obstacle: overlaps it, or is pushed by it."""
        numbers = self._obstacles.numbers
        # A contact is remembered until the reset, so it is looked for once.
        if numbers and not self._touched:
            contacts = pybullet.getContactPoints(
                bodyA=self._robot, physicsClientId=self._engine.number
            )
            self._touched = any(
                contact[OTHER] in numbers and (contact[DISTANCE] <= 0.0 or contact[FORCE] > 0.0)
                for contact in contacts
            )

    def _locate(self) -> tuple[Pose, model.Velocity]:
        (x, y, _), orientation, (vx, vy, _), (_, _, rate) = self._motion or self._read_motion()
        return (x, y, pybullet.getEulerFromQuaternion(orientation)[2]), (vx, vy, rate)

    @property
    def power(self) -> float:
        """Mechanical power of the motors now [W]. See `physics.model.motor_power`."""
        _, orientation, (vx, vy, _), (_, _, rate) = self._motion or self._read_motion()
        cos, sin = model.heading_of(orientation)
        return model.motor_power(cos, sin, (vx, vy, rate), self.wheel_speeds, self._record)

    def image(self, width: int, height: int) -> Image:
        """Take a picture with PyBullet's camera from behind and above: (height, width, 3), RGB."""
        # From now on movers far away are placed as well, because the next picture shows them.
        self._visible = True
        self._obstacles.paint()
        if self._crowd is not None:
            self.place_movers(self._crowd)

        x, y, theta = self.truth.pose
        # From behind the robot and above.
        view = pybullet.computeViewMatrixFromYawPitchRoll(
            cameraTargetPosition=(x, y, 0.0),
            distance=2.2,
            yaw=math.degrees(theta) - 90.0,
            pitch=-38.0,
            roll=0.0,
            upAxisIndex=2,
        )
        pixels = self._engine.getCameraImage(
            width,
            height,
            view,
            pybullet.computeProjectionMatrixFOV(50.0, width / height, 0.05, 30.0),
            lightDirection=(1.0, -1.0, 4.0),
            lightDistance=12.0,
            shadow=1,
            # This renderer runs on the CPU, so pictures need neither a display nor OpenGL.
            renderer=pybullet.ER_TINY_RENDERER,
        )[2]
        # The camera returns RGBA, pictures of envs are RGB.
        return np.ascontiguousarray(np.reshape(pixels, (height, width, 4))[:, :, :3], np.uint8)

    def close(self) -> None:
        """Disconnect from PyBullet. Idempotent."""
        self._engine.close()


class Shape(NamedTuple):
    """A shape of a body: a box, a sphere, a cylinder along z, or the mesh in a file."""

    kind: int
    place: Point3
    """Position in the frame of the body [m]."""
    paint: Paint = OBSTACLE_PAINT
    box: Point3 = ORIGIN
    """Half sizes [m]."""
    radius: float = 0.0
    length: float = 0.0
    turn: model.Quaternion = UPRIGHT
    file: str = ""


def make_shapes(engine: Engine, shapes: Sequence[Shape], *, visual: bool) -> int:
    """Make a compound of shapes, which can be either seen or touched. Returns its number."""
    # As lists: PyBullet crashes on tuples.
    columns = map(list, zip(*shapes, strict=True))
    kinds, places, paints, boxes, radii, lengths, turns, files = columns
    make = engine.createVisualShapeArray if visual else engine.createCollisionShapeArray
    frame = "visual" if visual else "collision"

    # PyBullet wants a value of each kind for every shape, whether it uses it or not.
    number = make(
        shapeTypes=kinds,
        halfExtents=boxes,
        radii=radii,
        lengths=lengths,
        fileNames=files,
        meshScales=[(1.0, 1.0, 1.0)] * len(shapes),
        **{f"{frame}FramePositions": places, f"{frame}FrameOrientations": turns},
        **({"rgbaColors": paints} if visual else {}),
    )
    return int(number)


def show_shapes(engine: Engine, shapes: Sequence[Shape]) -> int:
    """Make a body that can only be seen. Returns its number."""
    return int(engine.createMultiBody(0.0, -1, make_shapes(engine, shapes, visual=True)))


def turn_about_z(angle: float) -> model.Quaternion:
    """Return the orientation of a body that is turned about the vertical axis [rad]."""
    return 0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0)


def make_robot(config: RobotConfig, engine: Engine) -> int:
    """Make a rigid body of chassis and four wheels, its origin at the height of the axles.

    The chassis is a box, or an upright prism if the footprint is a polygon. The wheels' collision
    shapes are small spheres ("feet") that touch the floor below the hubs: one contact each, at the
    right place, and nothing beyond the footprint. Returns PyBullet's number.
    """
    chassis = Chassis.of(config)
    radius = config.wheel_radius
    middle = (0.0, 0.0, (chassis.top + chassis.bottom) / 2.0)
    half_height = (chassis.top - chassis.bottom) / 2.0
    half_x, half_y = config.outline[0]
    polygon = config.footprint
    with write_prism(polygon, chassis) if polygon else contextlib.nullcontext("") as file:
        if polygon:
            touchable = Shape(pybullet.GEOM_MESH, ORIGIN, CHASSIS_COLOUR, file=file)
            visible = [touchable]
        else:
            length = config.body.length
            width = chassis.width
            touchable = Shape(pybullet.GEOM_BOX, middle, box=(half_x, half_y, half_height))
            deck = (length / 2.2, width / 2.2, 0.004)
            visible = [
                Shape(
                    pybullet.GEOM_BOX, middle, CHASSIS_COLOUR, (length / 2, width / 2, half_height)
                ),
                Shape(pybullet.GEOM_BOX, (0.0, 0.0, chassis.top + 0.004), DECK_COLOUR, deck),
            ]
        visible += _lidar_and_wheels(config, chassis)

        # The wheels are seen as cylinders, but touch the floor as spheres.
        feet, foot = place_feet(config)
        spheres = [Shape(pybullet.GEOM_SPHERE, (x, y, foot - radius), radius=foot) for x, y in feet]
        robot = engine.createMultiBody(
            config.body.mass,
            make_shapes(engine, [touchable, *spheres], visual=False),
            make_shapes(engine, visible, visual=True),
            (0.0, 0.0, radius),
        )

    # PyBullet's own friction and damping would brake the robot in addition to its tyres.
    engine.changeDynamics(
        robot,
        -1,
        lateralFriction=0.0,
        rollingFriction=0.0,
        spinningFriction=0.0,
        restitution=0.0,
        linearDamping=0.0,
        angularDamping=0.0,
    )
    return int(robot)


def _lidar_and_wheels(config: RobotConfig, chassis: Chassis) -> list[Shape]:
    """Return what can be seen of the LiDAR and of four tyres."""
    cylinder = Shape(pybullet.GEOM_CYLINDER, ORIGIN, WHEEL_COLOUR)
    lidar = cylinder._replace(
        place=(config.body.length / 4, 0.0, chassis.top + 0.028), radius=0.035, length=0.04
    )
    wheel = cylinder._replace(radius=config.wheel_radius, length=chassis.tyre, turn=SIDEWAYS)
    hubs = wheel_hubs(config.wheelbase / 2.0, config.wheel_separation / 2.0)
    return [lidar, *(wheel._replace(place=(x, y, 0.0)) for x, y in hubs)]


def place_feet(config: RobotConfig) -> tuple[list[Point], float]:
    """Return centres and radius [m] of the feet, such that none is outside the footprint.

    They are below the hubs, or as near to them as the footprint allows.
    """
    outline = config.outline
    feet = []
    for x, y in wheel_hubs(config.wheelbase / 2.0, config.wheel_separation / 2.0):
        places = [(k / FOOT_PLACES * x, k / FOOT_PLACES * y) for k in range(FOOT_PLACES, 0, -1)]
        # The first place from the hub inwards that is within the footprint.
        fitting = (
            place
            for place in places
            if contains_point(outline, *place) and border_distance(outline, *place) >= MIN_SIZE
        )
        feet.append(next(fitting, (0.0, 0.0)))

    # The foot with the least room sets the radius of all, or the robot would lean.
    return feet, min(config.wheel_radius, *(border_distance(outline, *foot) for foot in feet))


@contextlib.contextmanager
def write_prism(outline: Outline, chassis: Chassis) -> Iterator[str]:
    """Write a temporary Wavefront file with an upright prism of the footprint.

    PyBullet reads shapes of many corners from files only. Its hull is 1 mm larger on every side.
    The file is deleted after the block.
    """
    count = len(outline)
    # First the lower, then the upper corners, each counter-clockwise.
    corners = [(x, y, z) for z in (chassis.bottom, chassis.top) for x, y in outline]
    under = range(1, count + 1)  # corners count from 1
    sides = [(k, k % count + 1, k % count + 1 + count, k + count) for k in under]
    # Corners are counter-clockwise as seen from outside, so the lower face is reversed.
    faces = [range(count + 1, 2 * count + 1), reversed(under), *sides]
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners]
    lines += ["f " + " ".join(map(str, face)) for face in faces]
    with tempfile.TemporaryDirectory(prefix="acsar_gym_") as folder:
        file = Path(folder) / "footprint.obj"
        file.write_text("\n".join(lines), encoding="ascii")
        yield str(file)


class StandingObstacles:
    """The obstacles of a world, or none, as static compounds of up to 16 shapes each.

    Every body costs time in every step of the engine, and a compound near the robot costs more, so
    a compound has obstacles that are near each other. They are never changed or removed: PyBullet
    leaks the shapes of bodies that are removed, but not those of a simulation that is reset, so
    another world needs another simulation. Visual shapes take ten times as long to make as
    collision shapes, so `paint` makes them when they are needed.

    Attributes:
        world: World of the obstacles.
        numbers: PyBullet's numbers of the compounds.
    """

    def __init__(self, engine: Engine, world: World | None) -> None:
        self.world = world
        self.numbers: set[int] = set()
        self._engine = engine
        self._unpainted = list_compounds(world) if world else []
        if not self._unpainted:
            return

        # A tiny shape below the floor: without a visual shape PyBullet would make a slow one.
        hidden = engine.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=(1e-3, 1e-3, 1e-3), visualFramePosition=(0.0, 0.0, -1.0)
        )
        for compound in self._unpainted:
            shape = make_shapes(engine, compound, visual=False)
            # A body in maximal coordinates takes a third of the time of PyBullet's multibodies.
            body = engine.createMultiBody(0.0, shape, hidden, useMaximalCoordinates=1)
            self.numbers.add(int(body))

    def paint(self) -> None:
        """Make the obstacles visible to PyBullet's camera and window. Idempotent."""
        for compound in self._unpainted:
            show_shapes(self._engine, compound)
        self._unpainted = []


class MovingObstacles:
    """The movers of a world, or none: fixed bodies with a velocity.

    PyBullet moves such a body on by itself, lets nothing stop it, and pushes the robot at its
    speed. Movers far away from the robot wait below the floor: to place a body takes time.
    """

    def __init__(self, engine: Engine, world: World | None) -> None:
        self._engine = engine
        self._bodies = [self._make(mover.radius) for mover in world.movers] if world else []
        self._placed: list[int] = []
        """Numbers of the movers above the floor."""

    def _make(self, radius: float) -> int:
        engine = self._engine
        touchable = engine.createCollisionShape(
            pybullet.GEOM_CYLINDER, radius=radius, height=MOVER_HEIGHT
        )
        visible = engine.createVisualShape(
            pybullet.GEOM_CYLINDER, radius=radius, length=MOVER_HEIGHT, rgbaColor=MOVER_PAINT
        )

        # A body without mass is moved by its velocity alone, and nothing stops it.
        body = int(engine.createMultiBody(0.0, touchable, visible, BELOW))
        engine.changeDynamics(
            body,
            -1,
            lateralFriction=0.0,
            contactStiffness=PUSH_STIFFNESS,
            contactDamping=PUSH_DAMPING,
        )
        return body

    def place(self, crowd: Crowd, x: float, y: float, reach: float) -> None:
        """Put movers whose hulls are within reach of a place [m] where they are, others away."""
        distances = np.hypot(*(crowd.states[:, [X, Y]] - (x, y)).T)
        # A robot may be touched within its reach, and by a mover's own radius.
        near = np.flatnonzero(distances < crowd.radii + reach).tolist()
        self.park(near)
        for number in near:
            x, y, vx, vy = crowd.states[number, :4].tolist()
            self._move(number, (x, y, MOVER_HEIGHT / 2.0), (vx, vy, 0.0))
        self._placed = near

    def park(self, kept: Sequence[int] = ()) -> None:
        """Put movers that are above the floor away, except for some."""
        for number in self._placed:
            if number not in kept:
                self._move(number, BELOW, ORIGIN)
        self._placed = []

    def _move(self, number: int, position: Point3, velocity: Point3) -> None:
        # Called for each mover in each tick: keywords and `Engine` would take longer.
        body = self._bodies[number]
        client = self._engine.number
        pybullet.resetBasePositionAndOrientation(body, position, UPRIGHT, client)
        pybullet.resetBaseVelocity(body, velocity, ORIGIN, client)


def list_compounds(world: World) -> list[list[Shape]]:
    """Return the shapes of all compounds: circles as cylinders, segments as thin boxes."""
    height = OBSTACLE_HEIGHT / 2.0
    cylinder = Shape(pybullet.GEOM_CYLINDER, ORIGIN, length=OBSTACLE_HEIGHT)
    circles = [
        cylinder._replace(place=(x, y, height), radius=max(radius, MIN_SIZE))
        for x, y, radius in world.circles.tolist()
    ]

    # A segment is a thin box around its middle, turned along it.
    starts, ends = np.hsplit(world.segments, 2)
    middles = (starts + ends) / 2.0
    along = (ends - starts).T
    halves = np.maximum(np.hypot(*along) / 2.0, MIN_SIZE)
    rows = np.column_stack([middles, halves, np.arctan2(*along[::-1])]).tolist()
    walls = [
        Shape(
            pybullet.GEOM_BOX,
            (x, y, height),
            box=(half, WALL_THICKNESS / 2.0, height),
            turn=turn_about_z(angle),
        )
        for x, y, half, angle in rows
    ]
    return [*group_neighbours(circles), *group_neighbours(walls)]


def group_neighbours(shapes: list[Shape]) -> Iterator[list[Shape]]:
    """Split shapes into groups that are near each other and small enough for a compound."""
    if len(shapes) > MAX_SHAPES:
        places = np.array([shape.place for shape in shapes])
        axis = int(np.ptp(places[:, Y]) > np.ptp(places[:, X]))

        # Halve along the longer side, so that compounds are compact.
        ordered = sorted(shapes, key=lambda shape: shape.place[axis])
        # The first half fills whole compounds, so that there are as few as possible.
        half = MAX_SHAPES * math.ceil(len(shapes) / MAX_SHAPES / 2)
        yield from group_neighbours(ordered[:half])
        yield from group_neighbours(ordered[half:])
    elif shapes:
        yield shapes
