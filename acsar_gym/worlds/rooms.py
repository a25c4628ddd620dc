"""A floor of a house: a corridor with rooms on both sides, doors, and furniture."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from acsar_gym.errors import WorldError
from acsar_gym.worlds.shapes import box, outline, wall
from acsar_gym.worlds.world import Floats, Region, World

LENGTH = 10.0
"""Length of the corridor, along x [m]."""
DEPTH = 3.0
"""Depth of the rooms, along y [m]."""
WIDEST_DOOR = 1.3
"""Width of doors at difficulty 0 [m]."""
ROOM_TO_SPARE = 0.2
"""How much wider than the footprint's disc doors are at difficulty 1 [m]."""


def rooms(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make three or four rooms on each side of a corridor; start and goal are in different rooms.

    With difficulty doors narrow from 1.3 m to the footprint's width and 20 cm, and furniture
    increases from none to four pieces a room.
    """
    door = WIDEST_DOOR + difficulty * (2.0 * radius + ROOM_TO_SPARE - WIDEST_DOOR)
    half = rng.uniform(0.6, 0.9)
    walls = [outline(0.0, -half - DEPTH, LENGTH, half + DEPTH)]
    places: list[tuple[float, float, float, float]] = []
    for side in (-1.0, 1.0):
        edges = _edges(rng)
        walls += _walls(rng, edges, side, half, door)
        low, high = sorted((side * half, side * (half + DEPTH)))
        places += [(left, low, right, high) for left, right in pairwise(edges)]
    start, goal = rng.permutation(len(places))[:2].tolist()
    furniture = [_furniture(rng, place, difficulty) for place in places]
    return World(
        np.concatenate([round_ones for round_ones, _ in furniture]),
        np.concatenate([*walls, *(boxes for _, boxes in furniture)]),
        _somewhere(rng, places[start], radius, rng.uniform(-math.pi, math.pi)),
        _somewhere(rng, places[goal], radius, None),
    )


def _edges(rng: np.random.Generator) -> list[float]:
    """Positions of the walls between the rooms of one side, along x [m]."""
    count = int(rng.integers(3, 5))
    inner = (np.arange(1, count) + rng.uniform(-0.15, 0.15, count - 1)) * LENGTH / count
    return [0.0, *inner.tolist(), LENGTH]


def _walls(
    rng: np.random.Generator, edges: list[float], side: float, half: float, door: float
) -> list[Floats]:
    """The wall to the corridor with a door to each room, and walls between rooms, some with one."""
    narrowest = min(right - left for left, right in pairwise(edges))
    if door > min(narrowest - 0.4, DEPTH - 0.6):
        raise WorldError(f"doors of {door:.2f} m are too wide for these rooms")
    begin = [rng.uniform(left + 0.2, right - 0.2 - door) for left, right in pairwise(edges)]
    doors = np.array([[left, left + door] for left in begin])
    found = [wall((0.0, side * half), (LENGTH, side * half), doors)]
    for x in edges[1:-1]:
        at = rng.uniform(0.3, DEPTH - 0.3 - door)
        gaps = np.array([[at, at + door]]) if rng.random() < 0.5 else np.zeros((0, 2))
        found.append(wall((x, side * half), (x, side * (half + DEPTH)), gaps))
    return found


def _furniture(
    rng: np.random.Generator, place: tuple[float, float, float, float], difficulty: float
) -> tuple[Floats, Floats]:
    """Circles and segments of a room's furniture."""
    pieces = int(rng.binomial(4, difficulty))
    low, high = np.array(place[:2]) + 0.45, np.array(place[2:]) - 0.45
    spots = rng.uniform(low, high, (pieces, 2)).tolist()
    as_box = rng.random(pieces) < 0.5
    sizes = rng.uniform(0.2, 0.8, (pieces, 2)).tolist()
    boxes = [box(*s, *z) for s, z, b in zip(spots, sizes, as_box, strict=True) if b]
    circles = [[*s, z[0] / 3.0] for s, z, b in zip(spots, sizes, as_box, strict=True) if not b]
    return np.array(circles).reshape(-1, 3), np.concatenate([np.zeros((0, 4)), *boxes])


def _somewhere(
    rng: np.random.Generator,
    place: tuple[float, float, float, float],
    radius: float,
    theta: float | None,
) -> Region:
    """A random point of a room, away from its walls."""
    low, high = np.array(place[:2]) + radius + 0.1, np.array(place[2:]) - radius - 0.1
    if (high <= low).any():
        raise WorldError(f"a footprint of radius {radius:g} m is too large for these rooms")
    x, y = rng.uniform(low, high).tolist()
    return Region(x, y, 0.0, theta)
