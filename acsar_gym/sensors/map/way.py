"""The way to the goal over what has been seen: A* on the cells, then straight pieces.

Cells that have never been seen count as free, as in planners of mobile robots (Stentz, "Optimal and
efficient path planning for partially-known environments", ICRA 1994): the way changes once the
robot sees that it is blocked.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import jit, subroutine
from acsar_gym.sensors.map.seen import (
    CELLS,
    COST_UNIT,
    HALF,
    LAST_CELL,
    Floats,
    Grid,
    Place,
    cell_at,
    cell_centre,
    length_of,
)

Ints = NDArray[np.int32]
MOST_POINTS = 64
"""Corners of a way that are kept, from the robot on."""
X, Y, REMAINING, COST = range(4)
"""Columns of a corner: place [m], length of the way from it to the goal [m], and cost of the piece
that ends at it [cells]."""
SIZE = CELLS * CELLS
MOST_ENTRIES = 3 * SIZE
"""Entries of the queue in a search."""
BUCKETS = 1024
"""Buckets of the queue: more than the 920 by which a step on the grid can raise an estimate."""
SCRATCH = 3 * SIZE + 3 * MOST_ENTRIES + BUCKETS
"""Numbers that a search writes to."""
UNREACHED = 2**30
STRAIGHT = 10
DIAGONAL = 14
"""Lengths of steps on the grid, to be multiplied by a cell's costs."""
LENGTH_SLACK = 1e-6
"""Pieces are often a whole number of cells long: a rest below this is a rounding error [cells]."""
SAMPLE_SHIFT = 0.37
"""A straight piece is sampled this share of a step before the end of each step. A diagonal between
two centres of cells would else have samples exactly on a corner, where rounding decides."""
LONGEST_PIECE = 40
"""Length of a straight piece, which bounds the time that planning takes [cells]."""
STRAIGHT_SLACK = 1.0
"""A straight piece may cost this much more than the cells that it replaces [cells]."""
DEARER = 1.1
"""A piece has become dearer if it costs more than this factor times its old cost, and DEARER_CELLS
on top. Both keep the robot from planning again because of a few raised cells."""
DEARER_CELLS = 4.0


@jit
def octile(di: int, dj: int) -> int:
    """Return the least cost of the steps to a cell this many rows and columns away."""
    rows = abs(di)
    columns = abs(dj)
    return STRAIGHT * max(rows, columns) + (DIAGONAL - STRAIGHT) * min(rows, columns)


@subroutine
def search_way(  # noqa: PLR0915 - a search and its queue
    grid: Grid, goal: tuple[int, int], scratch: Ints
) -> int:
    """Find the cheapest way over the cells, by A* with a bucket queue (Dial, 1969).

    Args:
        grid: Cells of the robot.
        goal: Cell of the goal. If it lies outside the window, the way ends at the window's edge.
        scratch: (SCRATCH,): Its first numbers are then the cells of the way, from the goal to the
            robot, as i * CELLS + j within the window.

    Returns:
        Number of cells, 0 if there is no way.
    """
    cheapest = scratch[SIZE : 2 * SIZE]
    parents = scratch[2 * SIZE : 3 * SIZE]
    nodes = scratch[3 * SIZE : 6 * SIZE]
    totals = scratch[6 * SIZE : 9 * SIZE]
    following = scratch[9 * SIZE : 12 * SIZE]
    heads = scratch[12 * SIZE :]
    cheapest[:] = UNREACHED
    parents[:] = -1
    costs = grid.costs
    heads[:] = -1

    # The queue starts with the robot's cell.
    goal_i = goal[0] - grid.first_i
    goal_j = goal[1] - grid.first_j
    node = HALF * CELLS + HALF
    cheapest[node] = 0
    nodes[0] = node
    totals[0] = 0
    following[0] = -1
    estimate = octile(goal_i - HALF, goal_j - HALF)
    heads[estimate % BUCKETS] = 0
    entries = 1
    waiting = 1

    while waiting > 0:
        while heads[estimate % BUCKETS] < 0:
            estimate += 1
        bucket = estimate % BUCKETS
        entry = heads[bucket]
        heads[bucket] = following[entry]
        waiting -= 1
        node = nodes[entry]
        total = totals[entry]
        if total > cheapest[node]:  # a cheaper way to this cell was found later
            continue

        i, j = divmod(node, CELLS)
        if min(i, j) == 0 or max(i, j) == LAST_CELL or (i == goal_i and j == goal_j):
            count = 0
            while node >= 0:
                scratch[count] = node
                count += 1
                node = parents[node]
            return count

        for p in range(i - 1, i + 2):
            for q in range(j - 1, j + 2):
                if p == i and q == j:
                    continue
                cost = int(costs[(p + grid.first_i) & LAST_CELL, (q + grid.first_j) & LAST_CELL])
                step = DIAGONAL if p != i and q != j else STRAIGHT
                next_total = total + ((step * (4 + cost)) >> 2)  # 1 + COST_UNIT * cost a metre
                neighbour = p * CELLS + q
                if next_total < cheapest[neighbour] and entries < MOST_ENTRIES:
                    cheapest[neighbour] = next_total
                    parents[neighbour] = node
                    bucket = (next_total + octile(goal_i - p, goal_j - q)) % BUCKETS
                    nodes[entries] = neighbour
                    totals[entries] = next_total
                    following[entries] = heads[bucket]
                    heads[bucket] = entries
                    entries += 1
                    waiting += 1
    return 0


@subroutine
def piece_cost(grid: Grid, start: Place, end: Place) -> tuple[float, float]:
    """Return the cost of a straight piece of a way, in cells, and the largest cost on it."""
    dx = end[0] - start[0]
    dy = end[1] - start[1]
    length = length_of(dx, dy) / grid.side
    count = int(min(max(math.ceil(length - LENGTH_SLACK), 1.0), CELLS))

    costs = grid.costs
    total = 0.0
    highest = 0.0
    for step in range(1, count + 1):
        share = (step - SAMPLE_SHIFT) / count
        i = cell_at(start[0] + share * dx, grid.side)
        j = cell_at(start[1] + share * dy, grid.side)
        if 0 <= i - grid.first_i < CELLS and 0 <= j - grid.first_j < CELLS:
            cost = float(costs[i & LAST_CELL, j & LAST_CELL])
            total += cost
            highest = max(highest, cost)
    return length * (1.0 + COST_UNIT * total / count), highest


@jit
def set_corner(points: Floats, n: int, place: Place, cost: float) -> None:
    """Set a corner of a way, except for what remains from it on."""
    points[n, X] = place[0]
    points[n, Y] = place[1]
    points[n, COST] = cost


@subroutine
def plan_way(
    grid: Grid, place: Place, goal: Place, points: Floats, scratch: Ints
) -> tuple[int, float]:
    """Plan the way from the robot to the goal, in straight pieces.

    Args:
        grid: Cells of the robot.
        place: Place of the robot.
        goal: The goal.
        points: (MOST_POINTS, 4): Gets the way's corners. The first is the robot's place, and the
            last is the goal.
        scratch: (SCRATCH,): Memory of the search.

    Returns:
        Number of corners, and cost of the way [cells].
    """
    goal_cell = cell_at(goal[0], grid.side), cell_at(goal[1], grid.side)
    goal_centre = cell_centre(goal_cell[0], grid.side), cell_centre(goal_cell[1], grid.side)
    at = search_way(grid, goal_cell, scratch) - 1
    set_corner(points, 0, place, cost=0.0)
    count = 1
    corner = place
    total = 0.0

    while at > 0 and count < MOST_POINTS - 1:
        # The next corner is the farthest cell to which a straight piece is no dearer.
        start = corner
        i, j = divmod(scratch[at], CELLS)
        stepwise = 0.0
        best_cost = -1.0
        for k in range(at - 1, max(at - 1 - LONGEST_PIECE, -1), -1):
            p, q = divmod(scratch[k], CELLS)
            cost = grid.costs[(p + grid.first_i) & LAST_CELL, (q + grid.first_j) & LAST_CELL]
            length = 1.4142135623730951 if p != i and q != j else 1.0
            stepwise += length * (1.0 + COST_UNIT * float(cost))
            i = p
            j = q
            centre = (
                cell_centre(p + grid.first_i, grid.side),
                cell_centre(q + grid.first_j, grid.side),
            )
            straight, _ = piece_cost(grid, start, centre)
            if best_cost < 0.0 or straight <= stepwise + STRAIGHT_SLACK:
                at = k
                best_cost = straight
                corner = centre
            elif straight > 1.5 * stepwise + 4.0:  # it won't become cheap again
                break

        if corner == goal_centre:
            corner = goal
        set_corner(points, count, corner, cost=best_cost)
        count += 1
        total += best_cost

    if corner != goal:  # nothing is known about the last piece
        cost, _ = piece_cost(grid, corner, goal)
        set_corner(points, count, goal, cost=cost)
        count += 1
        total += cost

    points[count - 1, REMAINING] = 0.0
    for k in range(count - 2, -1, -1):
        points[k, REMAINING] = length_left(points, k + 1, (points[k, X], points[k, Y]))
    return count, total


@subroutine
def weigh_way(grid: Grid, place: Place, ahead: Floats, write: bool) -> tuple[float, bool]:
    """Measure the present costs of a way from the robot on.

    Args:
        grid: Cells of the robot.
        place: Place of the robot.
        ahead: Corners ahead of it.
        write: Whether to write the costs to the corners.

    Returns:
        Cost of the way [cells], and whether a piece has become dearer since its cost was written,
        for example because the robot has left the way.
    """
    total = 0.0
    is_dearer = False
    start = place
    for k in range(len(ahead)):
        end = ahead[k, X], ahead[k, Y]
        cost, _ = piece_cost(grid, start, end)
        total += cost
        is_dearer = is_dearer or cost > DEARER * ahead[k, COST] + DEARER_CELLS
        if write:
            ahead[k, COST] = cost
        start = end
    return total, is_dearer


@jit
def length_left(points: Floats, corner: int, place: Place) -> float:
    """Return the length of the way from a place, straight to a corner and on along the way [m]."""
    straight = length_of(points[corner, X] - place[0], points[corner, Y] - place[1])
    return straight + points[corner, REMAINING]  # type: ignore[no-any-return]


@jit
def next_corner(way: Floats, corner: int, place: Place) -> int:
    """Return the corner to drive to: the following corner once the robot has passed this corner."""
    while corner < len(way) - 1:
        dx = way[corner + 1, X] - way[corner, X]
        dy = way[corner + 1, Y] - way[corner, Y]
        if (place[0] - way[corner, X]) * dx + (place[1] - way[corner, Y]) * dy <= 0.0:
            break
        corner += 1
    return corner


@subroutine
def point_ahead(ahead: Floats, place: Place, length: float) -> Place:
    """Return the point at a distance along the way from a place, at most the goal [m]."""
    x, y = place
    for k in range(len(ahead)):
        dx = ahead[k, X] - x
        dy = ahead[k, Y] - y
        piece = length_of(dx, dy)
        if piece >= length and piece > 1e-9:
            return x + dx * length / piece, y + dy * length / piece
        length -= piece
        x = ahead[k, X]
        y = ahead[k, Y]
    return x, y
