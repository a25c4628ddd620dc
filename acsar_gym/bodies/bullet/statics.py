"""A world's obstacles as PyBullet bodies: a few static compounds of up to 16 shapes each.

Every body costs time in every step of the engine, and a compound near the robot costs more, so a
compound has obstacles that are near each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.bullet.engine import pybullet
from acsar_gym.worlds import World

MOST_SHAPES = 16
"""Shapes of a compound, at most; PyBullet's limit."""
HEIGHT = 0.6
"""Height of every obstacle [m]."""
THICKNESS = 0.002
"""Thickness of a segment's wall [m]."""
FRAME = ("Positions", "Orientations")
"""Keys to which PyBullet adds a prefix, another for collision shapes than for visual ones."""
COLOUR = (0.42, 0.45, 0.5, 1.0)

Rows = NDArray[np.float64]


class Statics:
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
        named = {f"collisionFrame{key}" if key in FRAME else key: options[key] for key in options}
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
            named = {f"visualFrame{key}" if key in FRAME else key: options[key] for key in options}
            colours = [COLOUR] * len(options["shapeTypes"])
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
    if len(rows) > MOST_SHAPES:
        axis = int(np.ptp(places[:, 1]) > np.ptp(places[:, 0]))
        order = np.argsort(places[:, axis], kind="stable")
        half = MOST_SHAPES * math.ceil(len(rows) / MOST_SHAPES / 2)
        for part in (order[:half], order[half:]):
            yield from _neighbours(rows[part], places[part])
    elif len(rows):
        yield rows


def _cylinders(circles: Rows) -> dict[str, Any]:
    """PyBullet's arguments for circles, as upright cylinders."""
    return {
        "shapeTypes": [pybullet.GEOM_CYLINDER] * len(circles),
        "radii": np.maximum(circles[:, 2], 1e-3).tolist(),
        "lengths": [HEIGHT] * len(circles),
        "Positions": [(x, y, HEIGHT / 2.0) for x, y, _ in circles.tolist()],
    }


def _walls(segments: Rows) -> dict[str, Any]:
    """PyBullet's arguments for segments, as thin upright boxes."""
    along = segments[:, 2:] - segments[:, :2]
    lengths, angles = np.hypot(along[:, 0], along[:, 1]), np.arctan2(along[:, 1], along[:, 0])
    middles = ((segments[:, :2] + segments[:, 2:]) / 2.0).tolist()
    return {
        "shapeTypes": [pybullet.GEOM_BOX] * len(segments),
        "halfExtents": [
            (max(n / 2.0, 1e-3), THICKNESS / 2.0, HEIGHT / 2.0) for n in lengths.tolist()
        ],
        "Positions": [(x, y, HEIGHT / 2.0) for x, y in middles],
        "Orientations": [
            (0.0, 0.0, math.sin(angle / 2.0), math.cos(angle / 2.0)) for angle in angles.tolist()
        ],
    }
