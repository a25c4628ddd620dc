"""The robot and the floor as PyBullet bodies."""

from __future__ import annotations

import math
from typing import NamedTuple

from acsar_gym.bodies.bullet.engine import pybullet
from acsar_gym.config import RobotConfig
from acsar_gym.dynamics import Physics

CHASSIS_COLOUR = (0.16, 0.35, 0.58, 1.0)
DECK_COLOUR = (0.85, 0.87, 0.9, 1.0)
WHEEL_COLOUR = (0.12, 0.12, 0.13, 1.0)
CLEARANCE = 0.02
"""Height of the chassis above the floor [m]."""


def floor(client: int) -> int:
    """A frictionless plane; returns its body."""
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    plane_id = int(pybullet.createMultiBody(0.0, plane, physicsClientId=client))
    pybullet.changeDynamics(plane_id, -1, lateralFriction=0.0, physicsClientId=client)
    return plane_id


def robot(config: RobotConfig, client: int) -> int:
    """Chassis box and four wheels in one rigid body, its origin at the height of the axles.

    The wheels' collision shapes are small spheres that touch the floor below the hubs: one contact
    each, at the right place, and nothing beyond the footprint.
    """
    body, radius = config.body, config.wheel_radius
    bottom = min(CLEARANCE, radius) - radius
    top = max(body.height - radius, bottom + 0.01)
    foot = _foot(config)
    length, width = config.footprint
    half = (length / 2.0, width / 2.0, (top - bottom) / 2.0)
    collision = pybullet.createCollisionShapeArray(
        shapeTypes=[pybullet.GEOM_BOX] + [pybullet.GEOM_SPHERE] * 4,
        halfExtents=[half] + [(0.0, 0.0, 0.0)] * 4,
        radii=[0.0] + [foot] * 4,
        collisionFramePositions=[(0.0, 0.0, (top + bottom) / 2.0), *_hubs(config, foot - radius)],
        physicsClientId=client,
    )
    body_id = int(
        pybullet.createMultiBody(
            body.mass,
            collision,
            _visual(config, bottom, top, client),
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
    """Give the robot its mass and inertia."""
    pybullet.changeDynamics(
        body_id,
        -1,
        mass=own.mass,
        localInertiaDiagonal=(own.yaw_inertia, own.yaw_inertia, own.yaw_inertia),
        physicsClientId=client,
    )


def _foot(config: RobotConfig) -> float:
    """Radius of the spheres below the hubs, so that none sticks out of the footprint [m]."""
    length, width = config.footprint
    beside, ahead = (width - config.wheel_separation) / 2.0, (length - config.wheelbase) / 2.0
    return min(config.wheel_radius, beside, ahead)


def _hubs(config: RobotConfig, z: float = 0.0) -> list[tuple[float, float, float]]:
    """Wheel centres in the base frame, order front_right, front_left, rear_left, rear_right."""
    a, b = config.wheelbase / 2.0, config.wheel_separation / 2.0
    return [(a, -b, z), (a, b, z), (-a, b, z), (-a, -b, z)]


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
