"""What a robot has seen: a grid of cells around it, kept by its odometry.

The grid is a torus: cell (i, j) of the odometry frame is element [i % CELLS, j % CELLS]. It holds
the CELLS x CELLS cells around the robot; what leaves this window is forgotten. A cell has a count,
which grows where measurements end and shrinks where they pass through, as in Moravec & Elfes, "High
resolution maps from wide angle sonar" (ICRA 1985), and the cost of a metre for the robot's centre,
as the inflation layer of ROS's costmap_2d has it. All lengths are in units of the footprint's
radius, so that a map means the same for every robot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, subroutine
from acsar_gym.lidar.scan import Rays
from acsar_gym.trigonometry import cos_sin

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]
CELLS = 128
"""Cells along a side of the grid."""
LAST_CELL = CELLS - 1
"""CELLS is a power of two: i & LAST_CELL is i % CELLS, and faster."""
CELL_SIDE = 0.25
"""Side of a cell, in radii of the footprint."""
CELL_SHIFT = 0.37
"""The odometry frame's origin lies so far inside of its cell, in cells, so that places with round
numbers don't lie between two cells."""
COUNT_FREE, COUNT_OCCUPIED, COUNT_MOST = 1, 6, 10
"""The count of a cell that is free, that from which on it is occupied, and the largest one; 0 is
that of a cell which hasn't been seen."""
OCCUPIED = 16
"""Added to the count of a cell that is occupied."""
HIT, MISS = 3, 2
"""A measurement that ends in a cell adds HIT to its count, and one that passes through subtracts
MISS; an occupied cell stays so until it is free. Odometry drifts, so what isn't there any more has
to go within a second or two."""
SHARED_RAYS = 4
"""Every so many-th ray clears the cells that it passes, another one at each scan."""
STAMP_REACH = 6
"""Cells around an occupied one that cost more: where COST_FADE leaves half a COST_UNIT."""
STAMP_WIDTH = 16
"""Columns of a stamp; those that are beyond its reach are 0. So many bytes are raised at once."""
COST_UNIT = 0.25
"""Of the costs in cells: the cost of a metre is 1 + COST_UNIT * the cell's number."""
COST_LETHAL = 60.0
"""Added to the cost of a metre where the footprint touches an obstacle in any heading."""
COST_TIGHT, COST_NEAR = 8.0, 2.0
"""Added where it touches one in some heading, at most; and at one radius from an obstacle."""
COST_FADE = 0.25
"""Further away the cost falls by a factor of e in this distance, in radii."""


class Grid(NamedTuple):
    """The cells of one robot."""

    counts: Bytes
    """(CELLS, CELLS): how often each was hit, see `COUNT_FREE` and `OCCUPIED`."""
    costs: Bytes
    """(CELLS, CELLS): of a metre, see `COST_UNIT`."""


def make_stamp(inner: float, outer: float) -> Bytes:
    """Make the costs around an occupied cell.

    Returns:
        (2 STAMP_REACH + 1, STAMP_WIDTH).
    """
    steps = np.arange(-STAMP_REACH, STAMP_REACH + 1) * CELL_SIDE
    distances, share = np.hypot(steps[:, None], steps), inner / outer
    costs = COST_NEAR * np.exp(-(np.maximum(distances, 1.0) - 1.0) / COST_FADE)
    costs += COST_TIGHT * np.clip((1.0 - distances) / (1.0 - share + 1e-3), 0.0, 1.0)
    costs[distances < share] = COST_LETHAL
    stamp = np.zeros((2 * STAMP_REACH + 1, STAMP_WIDTH), np.uint8)
    stamp[:, : 2 * STAMP_REACH + 1] = np.round(costs / COST_UNIT)
    return stamp


@jit
def cell_at(place: float, side: float) -> int:
    """Number of the cell, along one axis, that a place lies in."""
    return int(math.floor(place / side + CELL_SHIFT))  # noqa: RUF046 - a float when compiled


@jit
def cell_centre(cell: int, side: float) -> float:
    """Centre of a cell along one axis [m]."""
    return (cell + 0.5 - CELL_SHIFT) * side


@subroutine
def move_window(grid: Grid, from_i: int, from_j: int, to_i: int, to_j: int) -> None:
    """Forget the cells that leave the window as its middle moves from one cell to another."""
    half = CELLS // 2
    if abs(to_i - from_i) >= CELLS or abs(to_j - from_j) >= CELLS:
        grid.counts[:] = grid.costs[:] = 0
        return
    step = 1 if to_i > from_i else -1
    for i in range(from_i, to_i, step):
        row = (i + half if step > 0 else i - half - 1) & LAST_CELL
        grid.counts[row, :] = grid.costs[row, :] = 0
    step = 1 if to_j > from_j else -1
    for j in range(from_j, to_j, step):
        row = (j + half if step > 0 else j - half - 1) & LAST_CELL
        grid.counts[:, row] = grid.costs[:, row] = 0


@subroutine
def raise_costs(grid: Grid, stamp: Bytes, i: int, j: int, middle: tuple[int, int]) -> None:
    """Raise the costs around a cell that is occupied now."""
    half, costs, low = CELLS // 2, grid.costs, (j - STAMP_REACH) & LAST_CELL
    most = max(abs(i - middle[0]), abs(j - middle[1]))
    if most < half - STAMP_REACH and low + STAMP_WIDTH <= CELLS:  # whole rows, which is faster
        for k in range(2 * STAMP_REACH + 1):
            p = (i - STAMP_REACH + k) & LAST_CELL
            for n in range(STAMP_WIDTH):
                costs[p, low + n] = max(costs[p, low + n], stamp[k, n])
        return
    for di in range(-STAMP_REACH, STAMP_REACH + 1):
        p = i + di
        if p < middle[0] - half or p >= middle[0] + half:
            continue
        for dj in range(-STAMP_REACH, STAMP_REACH + 1):
            q = j + dj
            if q < middle[1] - half or q >= middle[1] + half:
                continue
            cost = stamp[di + STAMP_REACH, dj + STAMP_REACH]
            if cost > costs[p & LAST_CELL, q & LAST_CELL]:  # noqa: PLR1730 - a byte
                costs[p & LAST_CELL, q & LAST_CELL] = cost


@subroutine
def lower_costs(grid: Grid, stamp: Bytes, i: int, j: int, middle: tuple[int, int]) -> None:
    """Compute the costs around a cell anew that isn't occupied any more."""
    half = CELLS // 2
    for p in range(i - STAMP_REACH, i + STAMP_REACH + 1):
        for q in range(j - STAMP_REACH, j + STAMP_REACH + 1):
            inside = abs(p - middle[0] + 0.5) < half and abs(q - middle[1] + 0.5) < half
            if inside:
                grid.costs[p & LAST_CELL, q & LAST_CELL] = 0
    for p in range(i - 2 * STAMP_REACH, i + 2 * STAMP_REACH + 1):
        if p < middle[0] - half or p >= middle[0] + half:
            continue
        for q in range(j - 2 * STAMP_REACH, j + 2 * STAMP_REACH + 1):
            if q < middle[1] - half or q >= middle[1] + half:
                continue
            if grid.counts[p & LAST_CELL, q & LAST_CELL] >= OCCUPIED:
                raise_costs(grid, stamp, p, q, middle)


@subroutine
def add_scan(  # noqa: PLR0913, PLR0917 - compiled, so no keywords
    grid: Grid,
    stamp: Bytes,
    side: float,
    pose: tuple[float, float, float],
    middle: tuple[int, int],
    ranges: Floats,
    rays: Rays,
    turn: int,
    moving: Bytes,
) -> None:
    """Count the measurements of a scan.

    Args:
        grid: of the robot; it changes.
        stamp: see `make_stamp`.
        side: of a cell [m].
        pose: of the robot by odometry, x [m], y [m], theta [rad].
        middle: the cell that the robot is in.
        ranges: (rays,): the scan [m].
        rays: of the LiDAR.
        turn: which rays clear cells; counts up from scan to scan.
        moving: (rays,): not 0 where a ray meets what moves, which isn't remembered.
    """
    counts = grid.counts
    first_i, first_j = middle[0] - CELLS // 2, middle[1] - CELLS // 2
    cos, sin = cos_sin(pose[2])
    from_x = pose[0] + cos * rays.mount_x - sin * rays.mount_y
    from_y = pose[1] + sin * rays.mount_x + cos * rays.mount_y
    u, v = from_x / side + CELL_SHIFT - first_i, from_y / side + CELL_SHIFT - first_j  # in cells
    for ray in range(len(ranges)):
        distance = ranges[ray]
        c, s = cos_sin(pose[2] + rays.start + ray * rays.step)
        if (ray + turn) % SHARED_RAYS == 0:
            a, b = u, v
            for _ in range(1, int(min(distance / side, CELLS)) - 1):
                a, b = a + c, b + s
                if not (0.0 <= a < CELLS and 0.0 <= b < CELLS):
                    break
                i, j = int(a) + first_i, int(b) + first_j
                p, q = i & LAST_CELL, j & LAST_CELL
                count = int(counts[p, q])
                if count == COUNT_FREE:
                    continue
                left = max(count % OCCUPIED - MISS, COUNT_FREE)
                counts[p, q] = left if left == COUNT_FREE else left + count // OCCUPIED * OCCUPIED
                if count >= OCCUPIED and left == COUNT_FREE:
                    lower_costs(grid, stamp, i, j, middle)
        if distance < rays.farthest - 1e-3 and moving[ray] == 0:
            a, b = u + c * distance / side, v + s * distance / side
            if not (0.0 <= a < CELLS and 0.0 <= b < CELLS):
                continue
            i, j = int(a) + first_i, int(b) + first_j
            p, q = i & LAST_CELL, j & LAST_CELL
            before = int(counts[p, q])
            count = min(max(before % OCCUPIED, COUNT_FREE) + HIT, COUNT_MOST)
            occupied = before >= OCCUPIED or count >= COUNT_OCCUPIED
            counts[p, q] = count + OCCUPIED if occupied else count
            if occupied and before < OCCUPIED:
                raise_costs(grid, stamp, i, j, middle)
