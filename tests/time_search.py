"""A search for the fastest path through space and time of a disc that knows all motions.

Cells of a grid are free of movers in some intervals of time. The search goes from interval to
interval and waits where it must: M. Phillips and M. Likhachev, "SIPP: Safe interval path planning
for dynamic environments", ICRA 2011. It shows that a scene with movers can be solved.
"""

from __future__ import annotations

import math
from heapq import heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from acsar_gym.jit import loop, subroutine
from acsar_gym.worlds import World
from acsar_gym.worlds.geometry import Line, distance_to_segment, segment_clearance
from acsar_gym.worlds.movers import (
    MAX_MOVER_SPEED,
    Motions,
    draw_offset,
    locate_mover,
    make_motions,
)
from acsar_gym.worlds.world import AX, AY, BX, BY

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]
TIME_STEP = 0.1  # between two known places of movers [s]
TOLERANCE = 0.2  # the goal counts as reached from this distance [m]
SIDE = 0.1  # side of a cell [m]; larger areas get larger cells
MAX_CELLS = 25_000  # 250 m^2 of these cells
MARGIN = 1.0  # the search may leave the world's bounds by this distance [m]
FARTHEST_STEP = MAX_MOVER_SPEED * TIME_STEP  # a mover that is farther away has jumped [m]


class Cells(NamedTuple):
    """A grid of which the start is the centre of a cell."""

    x: float
    """Centre of cell (0, 0) [m]."""
    y: float
    side: float
    """Side of a cell [m]."""
    free: Bools
    """(width, height): whether the disc touches no obstacle there."""


class Intervals(NamedTuple):
    """The times in which cells are free of movers."""

    first: Integers
    """(cells + 1,): number of each cell's first interval."""
    cell: Integers
    """(intervals,): the cell."""
    start: Floats
    """(intervals,) [s]."""
    end: Floats
    """(intervals,) [s]."""


def search_time(
    world: World,
    radius: float,
    speed: float,
    *,
    margin: float = 0.0,
    key: float = 0.0,
    horizon: float = 60.0,
) -> Floats | None:
    """Find the path of a disc that arrives first, and touches nobody on its way.

    People who react count as if they followed their motion. Movers go straight between two steps.

    Args:
        world: Obstacles, movers, start and goal.
        radius: Radius of the disc; between two cells it may come a centimetre nearer [m].
        speed: Greatest speed of the disc, which may stand and turns on the spot in no time [m/s].
        margin: Distance that it keeps from movers [m].
        key: The episode's draw, see `Scene.key`.
        horizon: Longest time until the goal [s].

    Returns:
        (points, 3): time since the start of the episode [s], x, y [m], to be driven in straight
        lines at even speeds. None if there is no path.
    """
    places = np.zeros((math.ceil(horizon / TIME_STEP) + 1, len(world.movers), 2))
    list_places(make_motions([world.movers]), key, places)
    reaches = radius + margin + np.array([mover.radius for mover in world.movers])

    cells = make_cells(world, radius)
    intervals = list_intervals(cells.free, mark_busy(cells, places, reaches))
    start = np.array((world.start.x, world.start.y))
    goal = np.array((world.goal.x, world.goal.y))
    rows: Floats = find_path(cells, intervals, speed, start, goal)
    return rows if len(rows) else None


def make_cells(world: World, radius: float) -> Cells:
    """Make the grid around a world; the start counts as free."""
    bounds = np.array(world.standing_bounds)
    low = bounds[:2] - MARGIN
    high = bounds[2:] + MARGIN
    side = max(SIDE, math.sqrt(float((high - low).prod()) / MAX_CELLS))
    start = np.array((world.start.x, world.start.y))
    index = np.ceil((start - low) / side).astype(int)
    origin = start - index * side
    width, height = (1 + np.ceil((high - origin) / side)).astype(int).tolist()

    offsets = np.stack(np.meshgrid(range(width), range(height), indexing="ij"), axis=-1)
    centres = (origin + side * offsets).reshape(-1, 2)
    free = (segment_clearance(centres, centres, world) >= radius).reshape(width, height)
    free[tuple(index)] = True
    return Cells(float(origin[0]), float(origin[1]), side, free)


@loop
def list_places(motions: Motions, key: float, places: Floats) -> None:
    """List where the movers' motions are every TIME_STEP, (steps, movers, 2)."""
    movers = motions.movers[0]
    for m in range(places.shape[1]):
        offset = draw_offset(movers[m], m, key)
        for k in range(len(places)):
            clock = k * TIME_STEP + offset
            x, y, _, _ = locate_mover(movers[m], motions.pieces[0], clock)
            places[k, m, 0] = x
            places[k, m, 1] = y


@loop
def mark_busy(cells: Cells, places: Floats, reaches: Floats) -> Bools:
    """Mark which cells are within reach of a mover in each step, (width, height, steps)."""
    width, height = cells.free.shape
    steps = len(places) - 1
    busy = np.zeros((width, height, steps), np.bool_)
    for m in range(len(reaches)):
        for k in range(steps):
            ax, ay = places[k, m]
            bx, by = places[k + 1, m]
            if abs(bx - ax) + abs(by - ay) > FARTHEST_STEP:
                mark_segment(busy[:, :, k], cells, (ax, ay, ax, ay), reaches[m])
                mark_segment(busy[:, :, k], cells, (bx, by, bx, by), reaches[m])
            else:
                mark_segment(busy[:, :, k], cells, (ax, ay, bx, by), reaches[m])
    return busy


@subroutine
def mark_segment(busy: Bools, cells: Cells, line: Line, reach: float) -> None:
    """Mark which cells are within reach of a segment."""
    width, height = busy.shape
    x, y, side, _ = cells
    first_i = max(int(np.ceil((min(line[AX], line[BX]) - reach - x) / side)), 0)
    first_j = max(int(np.ceil((min(line[AY], line[BY]) - reach - y) / side)), 0)
    last_i = min(int(np.floor((max(line[AX], line[BX]) + reach - x) / side)), width - 1)
    last_j = min(int(np.floor((max(line[AY], line[BY]) + reach - y) / side)), height - 1)
    for i in range(first_i, last_i + 1):
        for j in range(first_j, last_j + 1):
            if distance_to_segment(x + i * side, y + j * side, line) < reach:
                busy[i, j] = True


@loop
def list_intervals(free: Bools, busy: Bools) -> Intervals:
    """List the intervals in which cells are free."""
    width, height, steps = busy.shape
    first = np.zeros(width * height + 1, np.int64)
    for cell in range(width * height):
        row = busy[cell // height, cell % height]
        first[cell + 1] = first[cell]
        if free[cell // height, cell % height]:
            for k in range(steps):
                first[cell + 1] += not row[k] and (k == 0 or row[k - 1])

    count = first[-1]
    owner = np.zeros(count, np.int64)
    start = np.zeros(count)
    end = np.zeros(count)
    for cell in range(width * height):
        row = busy[cell // height, cell % height]
        interval = first[cell] - 1
        for k in range(steps if first[cell + 1] > first[cell] else 0):
            if not row[k]:
                if k == 0 or row[k - 1]:
                    interval += 1
                    owner[interval] = cell
                    start[interval] = k * TIME_STEP
                end[interval] = (k + 1) * TIME_STEP
    return Intervals(first, owner, start, end)


@loop
def find_path(  # noqa: C901 - a search that reads from top to bottom
    cells: Cells, intervals: Intervals, speed: float, start: Floats, goal: Floats
) -> Floats:
    """Find the path over cells that arrives first, (points, 3); empty if there is none."""
    x, y, side, free = cells
    width, height = free.shape
    first = intervals.first
    cell = int(np.rint((start[0] - x) / side)) * height + int(np.rint((start[1] - y) / side))
    if first[cell] == first[cell + 1] or intervals.start[first[cell]] > 0.0:
        return np.zeros((0, 3))

    count = len(intervals.cell)
    arrival = np.full(count, np.inf)
    departure = np.zeros(count)  # from the interval before
    parent = np.full(count, -1)
    done = np.zeros(count, np.bool_)
    arrival[first[cell]] = 0.0
    queue = [(0.0, first[cell])]
    last = -1
    while queue:
        _, state = heappop(queue)
        if done[state]:
            continue
        done[state] = True
        i = intervals.cell[state] // height
        j = intervals.cell[state] % height
        if math.hypot(x + i * side - goal[0], y + j * side - goal[1]) <= max(
            TOLERANCE, 0.75 * side
        ):
            last = state
            break

        for direction in range(9):
            di = direction // 3 - 1
            dj = direction % 3 - 1
            to_i = i + di
            to_j = j + dj
            if (di == 0 and dj == 0) or not (0 <= to_i < width and 0 <= to_j < height):
                continue
            if not (free[to_i, to_j] and free[i, to_j] and free[to_i, j]):
                continue
            duration = side * math.sqrt(di * di + dj * dj) / speed
            distance = math.hypot(x + to_i * side - goal[0], y + to_j * side - goal[1])
            cell = to_i * height + to_j
            for to in range(first[cell], first[cell + 1]):
                leaves = max(arrival[state], intervals.start[to])
                arrives = leaves + duration
                if arrives > intervals.end[state]:
                    break
                if arrives <= intervals.end[to] and arrives < arrival[to]:
                    arrival[to] = arrives
                    departure[to] = leaves
                    parent[to] = state
                    heappush(queue, (arrives + distance / speed, to))

    return trace_path(cells, intervals.cell, (arrival, departure), parent, last)


@subroutine
def trace_path(
    cells: Cells, owner: Integers, times: tuple[Floats, Floats], parent: Integers, last: int
) -> Floats:
    """Trace a path back from its last interval, by the arrival and departure in each."""
    arrival, departure = times
    x, y, side, free = cells
    height = free.shape[1]
    rows = [(0.0, 0.0, 0.0) for _ in range(0)]
    while last >= 0:
        i = owner[last] // height
        j = owner[last] % height
        rows.append((arrival[last], x + i * side, y + j * side))
        state = parent[last]
        if state >= 0:
            i = owner[state] // height
            j = owner[state] % height
            rows.append((departure[last], x + i * side, y + j * side))
        last = state
    path = np.zeros((len(rows), 3))
    for k in range(len(rows)):
        path[len(rows) - 1 - k] = rows[k]
    return path
