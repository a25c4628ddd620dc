"""Worlds like those of BARN (Perille et al. 2020), made by its cellular automaton.

A field of 30 x 30 cells of 0.15 m, with a cylinder in each filled cell, behind a walled corridor of
5 m. Layout and frame are those of the published worlds: start (-2, 3) heading along +y, goal 10 m
ahead.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import WorldError, optional
from acsar_gym.worlds.grid import Grid, search
from acsar_gym.worlds.registry import GeneratorError
from acsar_gym.worlds.search import shortest_path
from acsar_gym.worlds.world import Floats, Region, World

CELLS = 30
SIDE = 0.15
"""Side of a cell [m]."""
CYLINDER = 0.075
"""Radius of a cylinder [m]."""
FIELD = (-4.425, 5.175)
"""Centre of cell (0, 0) [m]."""
ROBOT_CELLS = 5
"""Side of the square robot that must be able to cross [cells]."""
ROBOT_RADIUS = ROBOT_CELLS * SIDE / 2.0
"""Half of that side [m]: this robot's centre keeps this distance from the cylinders."""
FILLED = (25, 209)
"""Least and most cells filled in the published worlds, without the first and the last row."""
LENGTHS = (10.0, 13.9)
"""Least and greatest length of the published worlds' paths [m]."""
START = Region(-2.0, 3.0, 0.0, math.pi / 2.0)
GOAL = Region(-2.0, 13.0)
AT_ONCE = 64
"""Fields that are made and checked together."""
MOST_ROUNDS = 1000
MOST_TRIED = 50
"""So many fields that BARN's robot can cross are tried before a larger footprint is rejected."""


def barn(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a world that BARN's 5 x 5-cell robot can cross, and a footprint of this radius, too.

    The path is made like the published ones: a shortest one over cells from any free cell of the
    first column to any of the last one, with the start before and the goal behind it.

    Args:
        rng: of the world.
        difficulty: 0 to 1; picks the share of cells filled before smoothing: 0.15, 0.2, 0.25 or
            0.3.
        radius: of the disc around the footprint [m].

    Raises:
        GeneratorError: the footprint is too large.
    """
    fill = 0.15 + 0.05 * min(int(4.0 * difficulty), 3)
    passes = int(rng.integers(2, 5))
    tried = 0
    for _ in range(MOST_ROUNDS):
        for cells, room in _crossable(_fields(rng, fill, passes)):
            tried += 1
            path = _path(rng, room)
            world = World(_cylinders(cells), start=START, goal=GOAL, path=path)
            if LENGTHS[0] <= world.length <= LENGTHS[1] and _lets_through(world, radius):
                return world
        if tried > MOST_TRIED:
            break
    raise GeneratorError(
        f"no BARN world lets a footprint of radius {radius:g} m through; use a lower difficulty, "
        "or another kind of world"
    )


def _lets_through(world: World, radius: float) -> bool:
    """Whether a footprint can cross that may be larger than BARN's robot."""
    try:
        return radius <= ROBOT_RADIUS or len(shortest_path(world, radius)) > 0
    except WorldError:
        return False


def _path(rng: np.random.Generator, room: NDArray[np.bool_]) -> Floats:
    """(points, 2): from the start through the cells that the robot can reach to the goal [m]."""
    entries, exits = np.flatnonzero(room[:, 0]), np.flatnonzero(room[:, -1])
    first, last = int(rng.choice(entries)), int(rng.choice(exits))
    grid = Grid(room, *FIELD, SIDE)
    cells = search(grid, first * CELLS, last * CELLS + CELLS - 1)
    way = np.zeros((0, 2)) if cells is None else grid.centres(cells)
    return np.concatenate([[[START.x, START.y]], way, [[GOAL.x, GOAL.y]]])


def _fields(rng: np.random.Generator, fill: float, passes: int) -> NDArray[np.bool_]:
    """(fields, 30, 30): random cells, smoothed; the first and the last row are walls."""
    cells = rng.random((AT_ONCE, CELLS, CELLS)) < fill
    cells[:, 0] = cells[:, -1] = True
    for _ in range(passes):
        cells = _smoothed(cells)
    cells[:, 0] = cells[:, -1] = True
    return cells


def _smoothed(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Smooth fields: five or more of its eight neighbours fill a cell, one or none clears it."""
    padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1), (1, 1)))
    around = sum(
        padded[:, i : i + CELLS, j : j + CELLS]
        for i in range(3)
        for j in range(3)
        if (i, j) != (1, 1)
    )
    smoothed: NDArray[np.bool_] = (around >= 5) | (cells & (around > 1))
    return smoothed


def _crossable(
    fields: NDArray[np.bool_],
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Fields that BARN's robot can cross, with as many filled cells as published ones.

    Yields the field's cells, and those in which the robot's centre may be: cells that are connected
    with the first and the last column.
    """
    with optional("a world with obstacles", "scipy"):
        from scipy.ndimage import label  # noqa: PLC0415 - slow to import

    filled, free = fields[:, 1:-1].sum(axis=(1, 2)), _room(fields)
    as_published = (filled >= FILLED[0]) & (filled <= FILLED[1])
    likely = as_published & np.all(free.any(axis=1), axis=1)
    for field in np.flatnonzero(likely):
        regions, _ = label(free[field])
        through = set(regions[:, 0].tolist()) & set(regions[:, -1].tolist()) - {0}
        if through:
            yield fields[field], regions == min(through)


def _room(fields: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells in which the centre of BARN's robot may be."""
    half = ROBOT_CELLS // 2
    padded = np.pad(fields, ((0, 0), (half, half), (half, half)))
    filled = np.zeros_like(fields)
    for i in range(ROBOT_CELLS):
        for j in range(ROBOT_CELLS):
            filled |= padded[:, i : i + CELLS, j : j + CELLS]
    return ~filled


def _cylinders(cells: NDArray[np.bool_]) -> Floats:
    """(circles, 3): the field's cylinders, and those of the corridor's three walls."""
    field = np.argwhere(cells) * SIDE + FIELD
    xs = FIELD[0] + SIDE * np.arange(CELLS)
    ys = 0.225 + SIDE * np.arange(33)
    back = np.column_stack([xs, np.full(CELLS, 0.075)])
    sides = [np.column_stack([np.full(33, x), ys]) for x in (xs[0], xs[-1])]
    centres = np.concatenate([back, *sides, field])
    return np.column_stack([centres, np.full(len(centres), CYLINDER)])
