"""Distance to the goal around known obstacles: the navigation function of a costmap.

Each cell costs 1 a metre, and more near obstacles. The cost of the cheapest way to the goal, T,
solves |grad T| = cost, see `acsar_gym.worlds.ways`. Nav2's NavFn planner interpolates it, too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from acsar_gym.baselines.costmap import CELL, Costmap
from acsar_gym.errors import optional
from acsar_gym.jit import loop
from acsar_gym.tasks.base import Floats
from acsar_gym.worlds.ways import Costs, costs_of, sweep

AROUND = 1.5
"""How far the field reaches around start, robot, goal and all that is known [m]."""
COSTS = Costs(lethal=60.0, tight=8.0, heavy=4.0)
"""Costs of cells near obstacles."""


@dataclass(frozen=True, slots=True)
class Potential:
    """Cost of the cheapest way to the goal, as equivalent metres, on a grid."""

    values: Floats
    """(nx, ny), at the cells' centres."""
    distances: Floats
    """(nx, ny): from the nearest occupied cell [m]."""
    x: float
    """x of cell (0, 0) [m]."""
    y: float

    def at(self, x: float, y: float) -> float:
        """The potential at a point, interpolated."""
        return float(interpolated(self.values, self.x, self.y, x, y))

    def way(self, x: float, y: float, length: float) -> Floats:
        """(n, 2): the way down the potential from a point, so long at most, every half cell [m]."""
        return descend(self.values, self.x, self.y, x, y, math.ceil(length / (0.5 * CELL)))


def potential(
    known: Costmap,
    robot: tuple[float, float],
    goal: tuple[float, float],
    radii: tuple[float, float],
) -> Potential:
    """Compute the potential of a goal.

    Args:
        known: the map.
        robot: where the robot is [m].
        goal: the goal [m].
        radii: of the circle within the footprint, and of the one around it [m].
    """
    with optional("the baseline navfn", "scipy"):
        from scipy.ndimage import distance_transform_edt  # noqa: PLC0415 - slow to import

    occupied = known.odds > 0.0
    part = _window(occupied, known, (robot, goal))
    x, y = known.x + part[0].start * CELL, known.y + part[1].start * CELL
    occupied = occupied[part]
    distances = np.full(occupied.shape, 1e3)
    if occupied.any():
        distances = distance_transform_edt(~occupied, sampling=CELL)
    values = np.full(occupied.shape, 1e9)
    i, j = round((goal[0] - x) / CELL), round((goal[1] - y) / CELL)
    sweep(values, costs_of(distances, radii, COSTS) * CELL, i, j)
    return Potential(values, distances, x, y)


def _window(
    occupied: np.ndarray[tuple[int, int], np.dtype[np.bool_]],
    known: Costmap,
    ends: tuple[tuple[float, float], tuple[float, float]],
) -> tuple[slice, slice]:
    """The part of the map around what is occupied, the robot and the goal."""
    more = math.ceil(AROUND / CELL)
    parts = []
    for axis, first in ((0, known.x), (1, known.y)):
        filled = np.flatnonzero(occupied.any(axis=1 - axis))
        cells = [round((end[axis] - first) / CELL) for end in ends]
        cells += [int(filled[0]), int(filled[-1])] if len(filled) else []
        size = occupied.shape[axis]
        low, high = min(max(min(cells) - more, 0), size - 2), max(min(max(cells) + more, size), 2)
        parts.append(slice(low, high))
    return parts[0], parts[1]


@loop
def interpolated(values: Floats, left: float, low: float, x: float, y: float) -> float:
    """A field between the centres of its cells; outside it goes on with the slope of distance."""
    u, v = (x - left) / CELL, (y - low) / CELL
    most_u, most_v = values.shape[0] - 1.001, values.shape[1] - 1.001
    p, q = min(max(u, 0.0), most_u), min(max(v, 0.0), most_v)
    i, j = int(p), int(q)
    a, b = p - i, q - j
    inner = (1.0 - a) * ((1.0 - b) * values[i, j] + b * values[i, j + 1]) + a * (
        (1.0 - b) * values[i + 1, j] + b * values[i + 1, j + 1]
    )
    outside = CELL * math.sqrt((u - p) * (u - p) + (v - q) * (v - q))
    value: float = inner + outside
    return value


@loop
def descend(values: Floats, left: float, low: float, x: float, y: float, most: int) -> Floats:
    """Points down a field's gradient, every half cell, (n, 2) [m]; ends at the minimum."""
    way = np.empty((most + 1, 2))
    way[0, 0], way[0, 1] = x, y
    for n in range(most):
        here = interpolated(values, left, low, x, y)
        gx = interpolated(values, left, low, x + CELL, y) - interpolated(
            values, left, low, x - CELL, y
        )
        gy = interpolated(values, left, low, x, y + CELL) - interpolated(
            values, left, low, x, y - CELL
        )
        size = math.sqrt(gx * gx + gy * gy)
        if here < CELL or size < 1e-9:
            return way[: n + 1]
        x -= 0.5 * CELL * gx / size
        y -= 0.5 * CELL * gy / size
        way[n + 1, 0], way[n + 1, 1] = x, y
    return way
