"""A world's obstacles as PyBullet bodies: a few static compounds of up to 16 shapes each.

A body costs time in every step of the engine, and a compound that comes near the robot costs more,
so neighbours go together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acsar_gym.bodies.bullet.engine import pybullet
from acsar_gym.worlds import World

MOST_SHAPES = 16
"""Of a compound, as PyBullet allows."""
HEIGHT = 0.6
"""Of every obstacle [m]."""
THICKNESS = 0.002
"""Of a segment's wall [m]."""
COLOUR = (0.42, 0.45, 0.5, 1.0)

Rows = NDArray[np.float64]


class Statics:
    """The obstacles of one world; empty where there is none."""

    def __init__(self, client: int) -> None:
        self._client = client
        self._world: World | None = None
        self._bodies: set[int] = set()

    def build(self, world: World | None) -> None:
        """Replace the obstacles, unless they stand already."""
        if world is self._world:
            return
        for body in self._bodies:
            pybullet.removeBody(body, physicsClientId=self._client)
        self._world = world
        self._bodies = set() if world is None else set(self._built(world))

    def _built(self, world: World) -> Iterator[int]:
        for circles in _neighbours(world.circles, world.circles[:, :2]):
            yield self._compound(*_cylinders(circles))
        middles = (world.segments[:, :2] + world.segments[:, 2:]) / 2.0
        for segments in _neighbours(world.segments, middles):
            yield self._compound(*_walls(segments))

    def _compound(self, options: dict[str, object], visual: dict[str, object]) -> int:
        """Rigid bodies in maximal coordinates cost a third of what PyBullet's multibodies do."""
        client, count = self._client, len(options["shapeTypes"])  # type: ignore[arg-type]
        return int(
            pybullet.createMultiBody(
                0.0,
                pybullet.createCollisionShapeArray(**options, physicsClientId=client),
                pybullet.createVisualShapeArray(
                    **visual, rgbaColors=[COLOUR] * count, physicsClientId=client
                ),
                useMaximalCoordinates=1,
                physicsClientId=client,
            )
        )

    def __contains__(self, body: int) -> bool:
        return body in self._bodies

    def __len__(self) -> int:
        return len(self._bodies)


def _neighbours(rows: Rows, places: Rows) -> Iterator[Rows]:
    """Rows in groups of neighbours, each small enough for a compound."""
    if len(rows) > MOST_SHAPES:
        axis = int(np.ptp(places[:, 1]) > np.ptp(places[:, 0]))
        order = np.argsort(places[:, axis], kind="stable")
        half = MOST_SHAPES * math.ceil(len(rows) / MOST_SHAPES / 2)
        for part in (order[:half], order[half:]):
            yield from _neighbours(rows[part], places[part])
    elif len(rows):
        yield rows


def _cylinders(circles: Rows) -> tuple[dict[str, object], dict[str, object]]:
    """Collision and visual shapes of upright cylinders."""
    kinds, radii = [pybullet.GEOM_CYLINDER] * len(circles), np.maximum(circles[:, 2], 1e-3).tolist()
    places = [(x, y, HEIGHT / 2.0) for x, y, _ in circles.tolist()]
    shapes = {"shapeTypes": kinds, "radii": radii, "lengths": [HEIGHT] * len(circles)}
    return (
        {**shapes, "collisionFramePositions": places},
        {**shapes, "visualFramePositions": places},
    )


def _walls(segments: Rows) -> tuple[dict[str, object], dict[str, object]]:
    """Collision and visual shapes of thin upright boxes."""
    along = segments[:, 2:] - segments[:, :2]
    lengths, angles = np.hypot(along[:, 0], along[:, 1]), np.arctan2(along[:, 1], along[:, 0])
    middles = ((segments[:, :2] + segments[:, 2:]) / 2.0).tolist()
    places = [(x, y, HEIGHT / 2.0) for x, y in middles]
    turns = [(0.0, 0.0, math.sin(a / 2.0), math.cos(a / 2.0)) for a in angles.tolist()]
    halves = [(max(n / 2.0, 1e-3), THICKNESS / 2.0, HEIGHT / 2.0) for n in lengths.tolist()]
    shapes = {"shapeTypes": [pybullet.GEOM_BOX] * len(segments), "halfExtents": halves}
    return (
        {**shapes, "collisionFramePositions": places, "collisionFrameOrientations": turns},
        {**shapes, "visualFramePositions": places, "visualFrameOrientations": turns},
    )
