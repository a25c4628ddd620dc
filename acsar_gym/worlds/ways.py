"""How far it is to the goal from anywhere in a world, around its obstacles.

The length T of the way solves |grad T| = cost, on a grid by fast sweeping (Zhao, "A fast sweeping
method for Eikonal equations", Mathematics of Computation 74, 2005). A graph search over eight
neighbours would overrate slanting ways by 8 %.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig, footprint
from acsar_gym.jit import jit, loop
from acsar_gym.worlds.clearance import clearance
from acsar_gym.worlds.grid import RESOLUTION, box_around, cells_in
from acsar_gym.worlds.search import footprint_radius
from acsar_gym.worlds.world import Floats, World

AROUND = 1.0
"""Width of the grid around all obstacles, start and goal [m]."""
MOST_CELLS = 250_000
"""Most cells of a world's grid; larger worlds get larger cells."""
FADES = 0.12
"""Distance over which the cost beyond the outer radius falls to 1/e [m]."""
SWEEPS = 60
"""Most sweeps over a grid."""
DONE = 1e-3
"""Sweeping ends once no cell changes by more than this [m]."""
FAR = 1e9


class Costs(NamedTuple):
    """Costs of a metre near obstacles; far from them it costs 1."""

    lethal: float
    """Nearer than the footprint's inner radius, where it touches the obstacle."""
    tight: float
    """Additional cost just outside of it; it falls to 0 at the outer radius, from where the robot
    can turn."""
    heavy: float
    """Additional cost up to the outer radius, which fades beyond it."""


COSTS = Costs(lethal=15.0, tight=3.0, heavy=0.5)


class Ways(NamedTuple):
    """Lengths of the ways to the goals of some worlds, from the centres of cells.

    Made by `ways_of`; `lengths` reads them.
    """

    values: NDArray[np.float32]
    """(cells of all worlds,): lengths of ways [m], tight places counting as longer."""
    firsts: NDArray[np.int64]
    """(worlds,): each world's first cell."""
    sizes: NDArray[np.int64]
    """(worlds, 2): cells along x and y."""
    corners: Floats
    """(worlds, 3): x and y of the first cell's centre, and a cell's side [m]."""

    def lengths(self, worlds: NDArray[np.int64], x: Floats, y: Floats) -> Floats:
        """Read the lengths of the ways from some places.

        Args:
            worlds: (n,): index of each one's world.
            x: (n,): x in the world's frame [m].
            y: (n,): y in the world's frame [m].

        Returns:
            (n,) [m], interpolated between cells.
        """
        found = np.empty(len(x))
        _read(self.values, self.firsts, self.sizes, self.corners, worlds, x, y, found)
        return found


def ways_of(worlds: Sequence[World], config: RobotConfig) -> Ways:
    """Compute the ways to the goals of worlds.

    Args:
        worlds: with the obstacles and goals.
        config: of the robot, which has the footprint.
    """
    radii = footprint.border_distance(config.outline, 0.0, 0.0), footprint_radius(config)
    grids = [_grid(world) for world in worlds]
    sizes = np.array([size for _, size in grids], np.int64).reshape(-1, 2)
    fields = [_field(world, *grid, radii) for world, grid in zip(worlds, grids, strict=True)]
    firsts = np.concatenate([[0], np.cumsum(sizes.prod(axis=1))[:-1]]).astype(np.int64)
    corners = np.array([corner for corner, _ in grids]).reshape(-1, 3)
    return Ways(np.concatenate(fields, dtype=np.float32), firsts, sizes, corners)


def _grid(world: World) -> tuple[tuple[float, float, float], tuple[int, int]]:
    """The first cell's centre and a cell's side [m], and the cells along x and y."""
    ends = np.array([[end.x, end.y] for end in (world.start, world.goal)])
    box = box_around(world, ends) + np.array([-AROUND, -AROUND, AROUND, AROUND])
    side = RESOLUTION * max(1.0, math.sqrt(cells_in(box, 0.0, RESOLUTION) / MOST_CELLS))
    nx, ny = (math.ceil(width / side) + 1 for width in (box[2:] - box[:2]).tolist())
    return (float(box[0]), float(box[1]), side), (nx, ny)


def _field(
    world: World,
    corner: tuple[float, float, float],
    size: tuple[int, int],
    radii: tuple[float, float],
) -> Floats:
    """(cells,): the lengths of a world's ways."""
    x, y, side = corner
    places = np.indices(size).reshape(2, -1).T * side + np.array([x, y])
    costs = costs_of(clearance(places, world).reshape(size), radii)
    values = np.full(size, FAR)
    sweep(values, costs * side, round((world.goal.x - x) / side), round((world.goal.y - y) / side))
    return values.ravel()


def costs_of(distances: Floats, radii: tuple[float, float], costs: Costs = COSTS) -> Floats:
    """Cost of a metre at some distances from the nearest obstacle.

    Args:
        distances: of any shape [m].
        radii: of the circle within the footprint, and of the one around it [m].
        costs: of nearness.
    """
    inner, outer = radii
    found = 1.0 + costs.heavy * np.exp(-(np.maximum(distances, outer) - outer) / FADES)
    found += costs.tight * np.clip((outer - distances) / (outer - inner + 1e-3), 0.0, 1.0)
    return np.where(distances < inner, costs.lethal, found)


@loop
def sweep(values: Floats, costs: Floats, goal_i: int, goal_j: int) -> None:
    """Solve |grad T| = cost on a grid by Gauss-Seidel sweeps in four directions, in place.

    Args:
        values: (nx, ny), at first larger than any result.
        costs: (nx, ny): cost of crossing each cell.
        goal_i: the goal's cell along x; the nearest one where it lies outside.
        goal_j: the same along y.
    """
    nx, ny = values.shape
    values[min(max(goal_i, 0), nx - 1), min(max(goal_j, 0), ny - 1)] = 0.0
    for number in range(SWEEPS):
        change, forth, up = 0.0, number % 2 == 0, number % 4 < 2
        for m in range(nx):
            i = m if forth else nx - 1 - m
            for n in range(ny):
                j = n if up else ny - 1 - n
                a = min(values[i - 1, j] if i > 0 else FAR, values[i + 1, j] if i < nx - 1 else FAR)
                b = min(values[i, j - 1] if j > 0 else FAR, values[i, j + 1] if j < ny - 1 else FAR)
                new = _crossed(a, b, costs[i, j])
                if new < values[i, j]:
                    change = max(change, values[i, j] - new)
                    values[i, j] = new
        if number >= 3 and change < DONE:
            break


@jit
def _crossed(a: float, b: float, cost: float) -> float:
    """The length at a cell whose neighbours along x and y have these."""
    if abs(a - b) >= cost:
        return min(a, b) + cost
    return 0.5 * (a + b + math.sqrt(2.0 * cost * cost - (a - b) * (a - b)))


@loop
def _read(
    values: NDArray[np.float32],
    firsts: NDArray[np.int64],
    sizes: NDArray[np.int64],
    corners: Floats,
    worlds: NDArray[np.int64],
    x: Floats,
    y: Floats,
    found: Floats,
) -> None:
    """Write the interpolated lengths at places into `found`; outside, those of the edge."""
    for k in range(len(x)):
        world = worlds[k]
        first, ny, side = firsts[world], sizes[world, 1], corners[world, 2]
        u = min(max((x[k] - corners[world, 0]) / side, 0.0), sizes[world, 0] - 1.001)
        v = min(max((y[k] - corners[world, 1]) / side, 0.0), ny - 1.001)
        i, j = int(u), int(v)
        a, b, cell = u - i, v - j, first + i * ny + j
        low = (1.0 - b) * values[cell] + b * values[cell + 1]
        high = (1.0 - b) * values[cell + ny] + b * values[cell + ny + 1]
        found[k] = (1.0 - a) * low + a * high
