"""The way to the goal over what has been seen: A* on the cells, then straight pieces.

What hasn't been seen is free, as planners of mobile robots take it (Stentz, "Optimal and efficient
path planning for partially-known environments", ICRA 1994): the way changes where the robot sees
that it doesn't lead on.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, subroutine
from acsar_gym.sensors.map.seen import (
    CELLS,
    COST_UNIT,
    LAST_CELL,
    Bytes,
    Floats,
    Grid,
    cell_at,
    cell_centre,
)

Ints = NDArray[np.int32]
MOST_POINTS = 64
"""Corners of a way that are kept, from the robot on."""
BUCKETS = 1024
"""More than a step on the grid can cost."""
MOST_ENTRIES = 3 * CELLS * CELLS
"""Of the queue, in one search."""
SCRATCH = 3 * CELLS * CELLS + BUCKETS + 3 * MOST_ENTRIES
"""Numbers that a search writes to."""
UNREACHED = 2**30
STRAIGHT, DIAGONAL = 10, 14
"""Lengths of steps on the grid; a cell's costs multiply them."""
LENGTH_SLACK = 1e-6
"""Pieces are often a whole number of cells long; so much more is rounding [cells]."""
SAMPLE_SHIFT = 0.37
"""Places on a straight piece are looked up so far before its steps' ends, in steps: a diagonal from
one cell's centre to another's has some that are exactly on a corner, where rounding decides."""
LONGEST_PIECE = 40
"""Of a way [cells]."""


@jit
def octile(di: int, dj: int) -> int:
    """Least cost of the steps from a cell to another one, so many rows and columns away."""
    a, b = abs(di), abs(dj)
    return STRAIGHT * max(a, b) + (DIAGONAL - STRAIGHT) * min(a, b)


@subroutine
def search_way(costs: Bytes, middle: tuple[int, int], goal: tuple[int, int], scratch: Ints) -> int:
    """Find the cheapest way over the cells; A* with a bucket queue, as Dial (1969) has it.

    Args:
        costs: (CELLS, CELLS): of the cells.
        middle: of the window: the cell that the robot is in.
        goal: cell of the goal; where it lies outside the window, a way ends at the window's edge.
        scratch: (SCRATCH,): begins with the cells of the way then, from its end to the start, as
            i * CELLS + j within the window.

    Returns:
        Number of cells; 0 where none was found.
    """
    half, size = CELLS // 2, CELLS * CELLS
    first_i, first_j = middle[0] - half, middle[1] - half
    gi, gj = goal[0] - first_i, goal[1] - first_j
    way, best, came = scratch[:size], scratch[size : 2 * size], scratch[2 * size : 3 * size]
    heads, more = scratch[3 * size : 3 * size + BUCKETS], 3 * size + BUCKETS
    nodes = scratch[more : more + MOST_ENTRIES]
    costs_so_far = scratch[more + MOST_ENTRIES : more + 2 * MOST_ENTRIES]
    following = scratch[more + 2 * MOST_ENTRIES :]
    best[:], came[:], heads[:] = UNREACHED, -1, -1
    node = half * CELLS + half
    best[node] = 0
    f = octile(gi - half, gj - half)
    nodes[0], costs_so_far[0], following[0] = node, 0, -1
    heads[f % BUCKETS] = 0
    entries, waiting = 1, 1
    while waiting > 0:
        while heads[f % BUCKETS] < 0:
            f += 1
        entry = heads[f % BUCKETS]
        heads[f % BUCKETS] = following[entry]
        waiting -= 1
        node, so_far = nodes[entry], costs_so_far[entry]
        if so_far > best[node]:
            continue
        i, j = node // CELLS, node % CELLS
        at_edge = i == 0 or j == 0 or i == CELLS - 1 or j == CELLS - 1
        if (i == gi and j == gj) or at_edge:
            found = 0
            while node >= 0:
                way[found] = node
                found += 1
                node = came[node]
            return found
        for di in range(-1, 2):
            for dj in range(-1, 2):
                if di == 0 and dj == 0:
                    continue
                p, q = i + di, j + dj
                cost = int(costs[(p + first_i) & LAST_CELL, (q + first_j) & LAST_CELL])
                step = DIAGONAL if di != 0 and dj != 0 else STRAIGHT
                total = so_far + ((step * (4 + cost)) >> 2)  # 1 + COST_UNIT * cost a metre
                other = p * CELLS + q
                if total < best[other] and entries < MOST_ENTRIES:
                    best[other], came[other] = total, node
                    place = (total + octile(gi - p, gj - q)) % BUCKETS
                    nodes[entries], costs_so_far[entries] = other, total
                    following[entries] = heads[place]
                    heads[place] = entries
                    entries += 1
                    waiting += 1
    return 0


@subroutine
def piece_cost(
    costs: Bytes,
    side: float,
    middle: tuple[int, int],
    begin: tuple[float, float],
    end: tuple[float, float],
) -> tuple[float, float]:
    """Cost of a straight piece of a way, in cells, and the largest cost on it."""
    (ax, ay), (bx, by), half = begin, end, CELLS // 2
    length = math.sqrt((bx - ax) * (bx - ax) + (by - ay) * (by - ay)) / side
    count = int(min(max(math.ceil(length - LENGTH_SLACK), 1.0), CELLS))
    total, most = 0.0, 0.0
    for step in range(1, count + 1):
        share = (step - SAMPLE_SHIFT) / count
        i, j = cell_at(ax + share * (bx - ax), side), cell_at(ay + share * (by - ay), side)
        p, q = i - middle[0] + half, j - middle[1] + half
        if 0 <= p < CELLS and 0 <= q < CELLS:
            cost = float(costs[i & LAST_CELL, j & LAST_CELL])
            total += cost
            most = max(most, cost)
    return length * (1.0 + COST_UNIT * total / count), most


@subroutine
def plan_way(
    grid: Grid,
    side: float,
    middle: tuple[int, int],
    place: tuple[float, float],
    goal: tuple[float, float],
    points: Floats,
    scratch: Ints,
) -> int:
    """Plan the way from the robot to the goal, in straight pieces.

    Args:
        grid: of the robot.
        side: of a cell [m].
        middle: of the window: the cell that the robot is in.
        place: of the robot [m].
        goal: in the odometry frame [m].
        points: (MOST_POINTS, 4): gets the way's corners: x [m], y [m], length of the way that is
            left from there [m], and cost of the piece that ends there [cells].
        scratch: (SCRATCH,): written to.

    Returns:
        Number of corners, the robot's place included, the goal or the last one that was kept.
    """
    half = CELLS // 2
    goal_cell = cell_at(goal[0], side), cell_at(goal[1], side)
    found, way = search_way(grid.costs, middle, goal_cell, scratch), scratch
    first_i, first_j = middle[0] - half, middle[1] - half
    count = 1
    points[0, 0], points[0, 1], points[0, 3] = place[0], place[1], 0.0
    at = found - 1  # in `way`, whose end is its begin
    while at > 0 and count < MOST_POINTS - 1:
        corner = points[count - 1, 0], points[count - 1, 1]
        # as far as a straight piece is no dearer than the cells between
        stepwise, best, best_cost = 0.0, at - 1, -1.0
        i, j = way[at] // CELLS, way[at] % CELLS
        for k in range(at - 1, max(at - 1 - LONGEST_PIECE, -1), -1):
            p, q = way[k] // CELLS, way[k] % CELLS
            cost = float(grid.costs[(p + first_i) & LAST_CELL, (q + first_j) & LAST_CELL])
            diagonal = p != i and q != j
            stepwise += (1.4142135623730951 if diagonal else 1.0) * (1.0 + COST_UNIT * cost)
            i, j = p, q
            centre = cell_centre(p + first_i, side), cell_centre(q + first_j, side)
            straight, _ = piece_cost(grid.costs, side, middle, corner, centre)
            if best_cost < 0.0 or straight <= stepwise + 1.0:
                best, best_cost = k, straight
            elif straight > 1.5 * stepwise + 4.0:
                break
        i, j = way[best] // CELLS, way[best] % CELLS
        x, y = cell_centre(i + first_i, side), cell_centre(j + first_j, side)
        if best == 0 and i + first_i == goal_cell[0] and j + first_j == goal_cell[1]:
            x, y = goal
        points[count, 0], points[count, 1], points[count, 3] = x, y, best_cost
        count += 1
        at = best
    last = count - 1
    if points[last, 0] != goal[0] or points[last, 1] != goal[1]:  # what is left is unknown
        corner = points[last, 0], points[last, 1]
        cost, _ = piece_cost(grid.costs, side, middle, corner, goal)
        points[count, 0], points[count, 1], points[count, 3] = goal[0], goal[1], cost
        count += 1
    points[count - 1, 2] = 0.0
    for k in range(count - 2, -1, -1):
        dx, dy = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
        points[k, 2] = points[k + 1, 2] + math.sqrt(dx * dx + dy * dy)
    return count


@jit
def length_left(points: Floats, corner: int, x: float, y: float) -> float:
    """Length of the way from a place, straight to the corner ahead and on along the way [m]."""
    dx, dy = points[corner, 0] - x, points[corner, 1] - y
    left: float = math.sqrt(dx * dx + dy * dy) + points[corner, 2]
    return left


@jit
def next_corner(points: Floats, count: int, corner: int, x: float, y: float) -> int:
    """The corner that a robot drives to: the next one, once the robot is beyond this one."""
    while corner < count - 1:
        dx = points[corner + 1, 0] - points[corner, 0]
        dy = points[corner + 1, 1] - points[corner, 1]
        if (x - points[corner, 0]) * dx + (y - points[corner, 1]) * dy <= 0.0:
            break
        corner += 1
    return corner


@subroutine
def point_ahead(
    points: Floats, count: int, corner: int, x: float, y: float, length: float
) -> tuple[float, float]:
    """The point of the way that is so far along it from a place, the goal at most [m]."""
    for k in range(corner, count):
        dx, dy = points[k, 0] - x, points[k, 1] - y
        piece = math.sqrt(dx * dx + dy * dy)
        if piece >= length and piece > 1e-9:
            return x + dx * length / piece, y + dy * length / piece
        length -= piece
        x, y = points[k, 0], points[k, 1]
    return x, y
