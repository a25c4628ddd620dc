"""The robot and the floor as PyBullet bodies."""

from __future__ import annotations

import contextlib
import math
from typing import NamedTuple

from acsar_gym.bodies.bullet.engine import pybullet
from acsar_gym.bodies.bullet.prism import mesh
from acsar_gym.config import RobotConfig
from acsar_gym.config.footprint import Point, border_distance, contains
from acsar_gym.dynamics import Physics

CHASSIS_COLOUR = (0.16, 0.35, 0.58, 1.0)
DECK_COLOUR = (0.85, 0.87, 0.9, 1.0)
WHEEL_COLOUR = (0.12, 0.12, 0.13, 1.0)
FEET = 100
"""Places between a hub and the middle of the robot that are tried for a foot."""
LEAST_FOOT = 1e-3
"""Radius of the smallest foot [m]."""
CLEARANCE = 0.02
"""Height of the chassis above the floor [m]."""


def floor(client: int) -> int:
    """Make a frictionless plane; returns PyBullet's number of its body."""
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    plane_id = int(pybullet.createMultiBody(0.0, plane, physicsClientId=client))
    pybullet.changeDynamics(plane_id, -1, lateralFriction=0.0, physicsClientId=client)
    return plane_id


def robot(config: RobotConfig, client: int) -> int:
    """Make a rigid body of chassis and four wheels, its origin at the height of the axles.

    The chassis is a box, or upright convex prisms where the footprint is a polygon. The wheels'
    collision shapes are small spheres ("feet") that touch the floor below the hubs: one contact
    each, at the right place, and nothing beyond the footprint. Returns PyBullet's number.
    """
    body, radius = config.body, config.wheel_radius
    bottom = min(CLEARANCE, radius) - radius
    top = max(body.height - radius, bottom + 0.01)
    polygon = config.footprint
    prisms = mesh(polygon, bottom, top) if polygon else contextlib.nullcontext("")
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


def weigh(body_id: int, own: Physics, client: int) -> None:
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
        shares = [share / FEET for share in range(FEET, 0, -1)]
        inside = (s for s in shares if contains(outline, s * x, s * y))
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
