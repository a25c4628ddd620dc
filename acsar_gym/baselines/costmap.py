"""An occupancy map kept from the scans: what a ROS user's costmap holds.

Log odds of each cell: a ray's end makes a cell likelier to be occupied, its way makes those that it
crosses less so (Moravec & Elfes 1985; Nav2's obstacle layer marks and clears likewise). Each
cell also keeps the mean place of what was met in it, so that the map is finer than its cells.
"""

from __future__ import annotations

import math

import numpy as np

from acsar_gym.jit import loop
from acsar_gym.tasks.base import Floats

CELL = 0.05
"""Side of a cell [m]."""
MARGIN = 5.0
"""How far the map reaches around the line from start to goal [m]."""
HIT, MISS, LEAST, MOST = 1.0, -0.1, -1.0, 4.0
"""Change of a cell's log odds by a ray's end and by a ray across it, and their bounds."""
OPEN = 0.1
"""A ray clears no cell within this distance of its end [m]."""


class Costmap:
    """Occupied cells in the odometry frame.

    Attributes: `odds`, (nx, ny), log odds of cells; `x`, `y`, centre of cell (0, 0) [m].

    Args:
        goal: of the episode, whose start is the origin [m].
    """

    def __init__(self, goal: tuple[float, float]) -> None:
        low = [math.floor((min(0.0, end) - MARGIN) / CELL) for end in goal]
        high = [math.ceil((max(0.0, end) + MARGIN) / CELL) for end in goal]
        self.x, self.y = low[0] * CELL, low[1] * CELL
        self.odds = np.zeros((high[0] - low[0] + 1, high[1] - low[1] + 1))
        self._places = np.zeros((*self.odds.shape, 3))

    def update(self, origin: tuple[float, float], ends: Floats, met: Floats) -> None:
        """Enter a scan.

        Args:
            origin: of the LiDAR, in the odometry frame [m].
            ends: (rays, 2): ends of the rays, in the odometry frame [m].
            met: (rays,): 1 for a ray that has met something, otherwise 0.
        """
        mark(self.odds, self._places, (self.x, self.y), origin, ends, met)

    def points(self, x: float, y: float, reach: float) -> Floats:
        """(n, 2): what was met within a square of this half side around a point [m]."""
        i, j = round((x - self.x) / CELL), round((y - self.y) / CELL)
        n = math.ceil(reach / CELL)
        part = np.s_[max(i - n, 0) : max(i + n + 1, 0), max(j - n, 0) : max(j + n + 1, 0)]
        places: Floats = self._places[part][self.odds[part] > 0.0][:, :2]
        return places


@loop
def mark(
    odds: Floats,
    places: Floats,
    corner: tuple[float, float],
    origin: tuple[float, float],
    ends: Floats,
    met: Floats,
) -> None:
    """Enter the rays of one scan into the log odds and mean places of cells, see `Costmap`."""
    nx, ny = odds.shape
    for ray in range(len(ends)):
        dx, dy = ends[ray, 0] - origin[0], ends[ray, 1] - origin[1]
        length = math.sqrt(dx * dx + dy * dy)
        last_i, last_j = -1, -1
        for step in range(int((length - OPEN) / (0.5 * CELL))):
            share = 0.5 * CELL * step / length
            i = math.floor((origin[0] + share * dx - corner[0]) / CELL + 0.5)
            j = math.floor((origin[1] + share * dy - corner[1]) / CELL + 0.5)
            if (i != last_i or j != last_j) and 0 <= i < nx and 0 <= j < ny:
                odds[i, j] = max(odds[i, j] + MISS, LEAST)
            last_i, last_j = i, j
    for ray in range(len(ends)):
        i = math.floor((ends[ray, 0] - corner[0]) / CELL + 0.5)
        j = math.floor((ends[ray, 1] - corner[1]) / CELL + 0.5)
        if met[ray] > 0.0 and 0 <= i < nx and 0 <= j < ny:
            if odds[i, j] <= 0.0:
                places[i, j, 2] = 0.0
            odds[i, j] = min(max(odds[i, j], 0.0) + HIT, MOST)
            count = min(places[i, j, 2] + 1.0, 10.0)
            places[i, j, 0] += (ends[ray, 0] - places[i, j, 0]) / count
            places[i, j, 1] += (ends[ray, 1] - places[i, j, 1]) / count
            places[i, j, 2] = count
