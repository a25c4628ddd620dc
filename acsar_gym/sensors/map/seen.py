"""What a robot has seen: a grid of cells around it, kept by its odometry.

The grid is a torus: cell (i, j) of the odometry frame is element [i % CELLS, j % CELLS]. It holds
the CELLS x CELLS cells around the robot and forgets a cell that leaves this window. A cell has a
count, which grows when measurements end in it and shrinks when they pass through it, as in Moravec
& Elfes, "High resolution maps from wide angle sonar" (ICRA 1985), and the cost of a metre for the
robot's centre, as in the inflation layer of ROS's costmap_2d. All lengths are in units of the
footprint's radius, so that a map means the same for every robot.
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
Pose = tuple[float, float, float]
"""x [m], y [m] and theta [rad] by odometry."""
Place = tuple[float, float]
"""x [m] and y [m] in the odometry frame."""
Measured = tuple[Floats, Floats, float]
"""Bearings [rad] and times [s] of a revolution's measurements, and when it ended [s]."""

# The window: 16 radii to each side of the robot.
CELLS = 128
"""Cells along a side of the grid, a power of two."""
HALF = CELLS // 2
LAST_CELL = CELLS - 1
"""`i & LAST_CELL` is `i % CELLS`, and faster."""
CELL_SIDE = 0.25
"""Side of a cell, in radii of the footprint."""
CELL_SHIFT = 0.37
"""Distance of the odometry frame's origin from the edge of its cell, in cells. It isn't a simple
fraction, so that places with round numbers don't lie on the edge of a cell."""

# A cell is occupied after two hits. Odometry drifts, so an obstacle that is no longer seen
# has to be forgotten within a second or two (docs/experiments.md, "A map, and any robot").
COUNT_FREE = 1
"""Count of a free cell. A cell that has never been seen has 0."""
COUNT_OCCUPIED = 6
"""A cell becomes occupied at this count, and is free again at COUNT_FREE."""
COUNT_MOST = 10
OCCUPIED = 16
"""Added to the count of an occupied cell: a bit above all counts."""
HIT = 3
"""Added to the count of the cell in which a measurement ends."""
MISS = 2
"""Subtracted from the count of each cell that a measurement passes through."""
SHARED_RAYS = 4
"""Each scan clears cells along every fourth ray, in turn, because this takes most of the time."""

# Costs around an occupied cell. COST_NEAR, COST_FADE and COST_TIGHT were chosen in
# clutter:3000-3399 by time and success of the packaged policies (table in docs/experiments.md).
COST_UNIT = 0.25
"""A cell with the number n costs 1 + COST_UNIT * n a metre."""
COST_LETHAL = 60.0
"""Added if the footprint touches the obstacle in any heading. With 8-bit numbers and this unit a
cost can't exceed 63.75."""
COST_TIGHT = 8.0
"""Added, at most, if the footprint touches the obstacle in some headings."""
COST_NEAR = 2.0
"""Added at one radius from the obstacle."""
COST_FADE = 0.25
"""Beyond one radius the cost falls by a factor of e in this distance, in radii."""
STAMP_REACH = 6
"""Cells to each side that cost more. At 1.5 radii COST_FADE leaves about one COST_UNIT."""
STAMP_WIDTH = 16
"""Columns of a stamp: one vector register of bytes. Columns beyond its reach are 0."""
STAMP_SHAPE = (2 * STAMP_REACH + 1, STAMP_WIDTH)


class Grid(NamedTuple):
    """The cells of a robot and their window."""

    counts: Bytes
    """(CELLS, CELLS): Count of each cell, see `COUNT_FREE` and `OCCUPIED`."""
    costs: Bytes
    """(CELLS, CELLS): Cost of a metre, see `COST_UNIT`."""
    stamp: Bytes
    """Costs around an occupied cell, see `make_stamp`."""
    side: float
    """Side of a cell [m]."""
    first_i: int
    """First row of the window. The robot is HALF cells further."""
    first_j: int
    """First column of the window."""


class PlacedScan(NamedTuple):
    """A scan in the odometry frame. Arrays have the shape (rays,)."""

    ranges: Floats
    """[m]"""
    farthest: float
    """Longest range of the LiDAR [m]."""
    x: float
    """Place of the LiDAR [m]."""
    y: float
    start: float
    """Direction of the first ray [rad]."""
    step: float
    """Angle between two rays [rad]."""
    xs: Floats
    """Where each ray ends [m]."""
    ys: Floats
    ages: Floats
    """When each ray was measured, relative to now, so not positive [s]."""
    moving: Bytes
    """1 for a ray that ends in a moving object, which isn't remembered."""
    now: float
    """Time of the pose [s]."""
    stamp: float
    """End of the revolution that the scan was made of [s]."""


def make_stamp(inner: float, outer: float) -> Bytes:
    """Make the costs around an occupied cell, of shape STAMP_SHAPE.

    Args:
        inner: Radius of the largest disc within the footprint [m].
        outer: Radius of the smallest disc around it [m].
    """
    steps = np.arange(-STAMP_REACH, STAMP_REACH + 1) * CELL_SIDE
    distances = np.hypot(steps[:, None], steps)
    share = inner / outer

    costs = COST_NEAR * np.exp(-(np.maximum(distances, 1.0) - 1.0) / COST_FADE)
    costs += COST_TIGHT * np.clip((1.0 - distances) / (1.0 - share + 1e-3), 0.0, 1.0)
    costs[distances < share] = COST_LETHAL

    stamp = np.zeros(STAMP_SHAPE, np.uint8)
    stamp[:, : len(steps)] = np.round(costs / COST_UNIT)
    return stamp


@jit
def length_of(x: float, y: float) -> float:
    """Return the length of a vector. In compiled code this is faster than `math.hypot`."""
    return math.sqrt(x * x + y * y)


@jit
def cell_at(place: float, side: float) -> int:
    """Return the number of the cell, along one axis, in which a place lies."""
    return int(math.floor(place / side + CELL_SHIFT))  # noqa: RUF046 - a float when compiled


@jit
def cell_centre(cell: int, side: float) -> float:
    """Return the centre of a cell along one axis [m]."""
    return (cell + 0.5 - CELL_SHIFT) * side


@jit
def cells_near(cell: int, reach: int, first: int) -> range:
    """Return the cells within `reach` of a cell, along one axis, that lie in the window."""
    return range(max(cell - reach, first), min(cell + reach + 1, first + CELLS))


@jit
def cells_between(first: int, second: int) -> range:
    """Return the cells that a window leaves or enters when its first cell changes."""
    low = min(first, second)
    return range(low, min(max(first, second), low + CELLS))


@subroutine
def move_window(grid: Grid, first_i: int, first_j: int) -> None:
    """Forget the cells that left the window, which started at (first_i, first_j) until now."""
    for i in cells_between(first_i, grid.first_i):
        grid.counts[i & LAST_CELL, :] = 0
        grid.costs[i & LAST_CELL, :] = 0
    for j in cells_between(first_j, grid.first_j):
        grid.counts[:, j & LAST_CELL] = 0
        grid.costs[:, j & LAST_CELL] = 0


@subroutine
def raise_costs(grid: Grid, i: int, j: int) -> None:
    """Raise the costs around a cell that has become occupied."""
    costs = grid.costs

    # Whole rows of the stamp, which is faster, unless they leave the window or wrap around.
    low = (j - STAMP_REACH) & LAST_CELL
    if (
        low + STAMP_WIDTH <= CELLS
        and STAMP_REACH <= i - grid.first_i < CELLS - STAMP_REACH
        and STAMP_REACH <= j - grid.first_j < CELLS - STAMP_REACH
    ):
        for k in range(2 * STAMP_REACH + 1):
            p = (i - STAMP_REACH + k) & LAST_CELL
            for n in range(STAMP_WIDTH):
                costs[p, low + n] = max(costs[p, low + n], grid.stamp[k, n])
        return

    for p in cells_near(i, STAMP_REACH, grid.first_i):
        for q in cells_near(j, STAMP_REACH, grid.first_j):
            cell = p & LAST_CELL, q & LAST_CELL
            costs[cell] = max(costs[cell], grid.stamp[p - i + STAMP_REACH, q - j + STAMP_REACH])


@subroutine
def lower_costs(grid: Grid, i: int, j: int) -> None:
    """Recompute the costs around a cell that is no longer occupied."""
    for p in cells_near(i, STAMP_REACH, grid.first_i):
        for q in cells_near(j, STAMP_REACH, grid.first_j):
            grid.costs[p & LAST_CELL, q & LAST_CELL] = 0
    for p in cells_near(i, 2 * STAMP_REACH, grid.first_i):
        for q in cells_near(j, 2 * STAMP_REACH, grid.first_j):
            if grid.counts[p & LAST_CELL, q & LAST_CELL] >= OCCUPIED:
                raise_costs(grid, p, q)


@subroutine
def place_scan(
    pose: Pose, ranges: Floats, rays: Rays, measured: Measured, now: float
) -> PlacedScan:
    """Compute where the rays of a scan end and when they were measured.

    The ages leave out the robot's turning during the revolution.

    Args:
        pose: The robot's pose by odometry.
        ranges: The scan, (rays,) [m].
        rays: Rays of the LiDAR.
        measured: The revolution that the scan was made of.
        now: Time of the pose [s].
    """
    count = len(ranges)
    cos, sin = cos_sin(pose[2])
    columns = np.empty((3, count))
    bearings, times, stamp = measured
    scan = PlacedScan(
        ranges=ranges,
        farthest=rays.farthest,
        x=pose[0] + cos * rays.mount_x - sin * rays.mount_y,
        y=pose[1] + sin * rays.mount_x + cos * rays.mount_y,
        start=pose[2] + rays.start,
        step=rays.step,
        xs=columns[0],
        ys=columns[1],
        ages=columns[2],
        moving=np.zeros(count, np.uint8),
        now=now,
        stamp=stamp,
    )

    for ray in range(count):
        cos, sin = cos_sin(scan.start + ray * scan.step)
        scan.xs[ray] = scan.x + ranges[ray] * cos
        scan.ys[ray] = scan.y + ranges[ray] * sin

    # A ray that no measurement points at gets the mean age.
    scan.ages[:] = times.mean() - now
    for n in range(len(bearings)):
        ray = int(math.floor((bearings[n] - rays.start) / rays.step + 0.5))  # noqa: RUF046
        if ray < 0 or ray >= count:  # a remainder takes long
            ray %= count
        scan.ages[ray] = times[n] - now
    return scan


@subroutine
def add_scan(grid: Grid, scan: PlacedScan, turn: int) -> None:  # noqa: C901 - the hot loop
    """Count the measurements of a scan.

    Cells are counted in this loop, because passing a Grid to a function counts its references.

    Args:
        grid: Cells of the robot, which change.
        scan: The scan, in which moving objects are marked.
        turn: Number of the scan, which selects the rays that clear cells.
    """
    counts = grid.counts

    # In cells, from the edge of the window.
    eye_u = scan.x / grid.side + CELL_SHIFT - grid.first_i
    eye_v = scan.y / grid.side + CELL_SHIFT - grid.first_j

    for ray in range(len(scan.ranges)):
        distance = scan.ranges[ray]
        cos, sin = cos_sin(scan.start + ray * scan.step)

        # The cells that the ray passes through.
        if (ray + turn) % SHARED_RAYS == 0:
            u = eye_u
            v = eye_v
            for _ in range(int(min(distance / grid.side, CELLS)) - 2):
                u += cos
                v += sin
                if not (0.0 <= u < CELLS and 0.0 <= v < CELLS):
                    break
                i = int(u) + grid.first_i
                j = int(v) + grid.first_j
                cell = i & LAST_CELL, j & LAST_CELL
                count = int(counts[cell])
                if count == COUNT_FREE:
                    continue
                if count % OCCUPIED - MISS > COUNT_FREE:
                    counts[cell] = count - MISS
                    continue
                counts[cell] = COUNT_FREE
                if count >= OCCUPIED:
                    lower_costs(grid, i, j)

        # The cell in which it ends.
        if distance < scan.farthest - 1e-3 and scan.moving[ray] == 0:
            u = eye_u + cos * distance / grid.side
            v = eye_v + sin * distance / grid.side
            if not (0.0 <= u < CELLS and 0.0 <= v < CELLS):
                continue
            i = int(u) + grid.first_i
            j = int(v) + grid.first_j
            cell = i & LAST_CELL, j & LAST_CELL
            count = int(counts[cell])
            was_occupied = count >= OCCUPIED
            count = min(max(count % OCCUPIED, COUNT_FREE) + HIT, COUNT_MOST)
            is_occupied = was_occupied or count >= COUNT_OCCUPIED
            counts[cell] = count + OCCUPIED if is_occupied else count
            if is_occupied and not was_occupied:
                raise_costs(grid, i, j)
