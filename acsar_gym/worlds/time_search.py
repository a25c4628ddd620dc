"""Search for the fastest path through space and time of a disc that knows all motions.

Cells of a grid are free of movers in some intervals of time. The search goes from interval to
interval and waits where it must: M. Phillips and M. Likhachev, "SIPP: Safe interval path planning
for dynamic environments", ICRA 2011. What it finds is straightened.

So it says whether a world can be crossed by anybody at all, and a policy that follows its paths is
a ceiling: no robot knows where everybody will be.
"""

from __future__ import annotations

import math
from heapq import heappop, heappush

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.jit import loop, subroutine
from acsar_gym.worlds.geometry import distance_to_line, segment_clearance
from acsar_gym.worlds.movers import (
    MAX_MOVER_SPEED,
    Motions,
    draw_offset,
    locate_mover,
    make_motions,
)
from acsar_gym.worlds.world import Floats, World

TIME_STEP = 0.1  # between two known places of movers [s]
HORIZON = 60.0  # the longest time that a path takes [s]
TOLERANCE = 0.2  # the goal counts as reached from this distance [m]
SEARCH_SIDE = 0.1
"""Side of a cell [m]; larger areas get larger ones."""
MAX_SEARCH_CELLS = 25_000  # 250 m^2 of these cells
SEARCH_MARGIN = 1.0  # the search may leave the world's bounds by so much [m]
FARTHEST_STEP = MAX_MOVER_SPEED * TIME_STEP
"""A mover that is farther away after a step has jumped [m]."""

Place = tuple[float, float]  # x, y [m]


def search_time(  # noqa: PLR0913 - each is one of the search's own
    world: World,
    radius: float,
    speed: float,
    start: Place,
    goal: Place,
    *,
    margin: float = 0.0,
    begin: float = 0.0,
    key: float = 0.0,
    places: ArrayLike | None = None,
    horizon: float = HORIZON,
    tolerance: float = TOLERANCE,
) -> Floats | None:
    """Find the path of a disc that arrives first, and touches nobody on its way.

    People who react count as if they followed their motion, unless `places` says better. Between
    two steps of time movers count as going straight, so who turns there may come a little nearer.

    Args:
        world: obstacles and movers.
        radius: of the disc; between two cells it may come a centimetre nearer to obstacles [m].
        speed: the disc's greatest; it may stand, and turns on the spot in no time [m/s].
        start: where the disc is, in the frame of the world [m].
        goal: where it shall come [m].
        margin: distance that it keeps from movers [m].
        begin: time since the episode's begin at which the disc is at the start [s].
        key: of the episode, see `Scene.key`.
        places: (steps, movers, 2): where the movers will be every TIME_STEP from `begin` on, the
            last one `horizon` later or before [m]; None: where their motions are.
        horizon: longest time until the goal [s].
        tolerance: distance from which the goal counts as reached, at least a cell's [m].

    Returns:
        (points, 3): time since the episode's begin [s], x, y [m], to be driven in straight lines
        at even speeds, the first point being the start; None where there is no such path, also
        where the disc touches somebody at the start.
    """
    motions = make_motions([world.movers])
    if places is None:
        steps = max(math.ceil(horizon / TIME_STEP), 1)
        spots = np.zeros((steps + 1, len(world.movers), 2))
        _list_places(motions, begin, key, spots)
    else:
        spots = np.array(places, np.float64)[: math.ceil(horizon / TIME_STEP) + 1]
    reaches = radius + margin + np.array([mover.radius for mover in world.movers])
    x, y, side, free = _free_grid(world, radius, start, goal)
    rows: Floats = _search(free, x, y, side, spots, reaches, speed, start, goal, tolerance)
    if not len(rows):
        return None
    moved = np.append(True, np.diff(rows[:, 0]) > 0.0)
    path = _straighten(rows[moved], world, radius, spots, reaches)
    path[:, 0] += begin
    return path


def _free_grid(
    world: World, radius: float, start: Place, goal: Place
) -> tuple[float, float, float, NDArray[np.bool_]]:
    """The centre of cell (0, 0), the side of a cell [m], and which cells are free for the disc.

    The start is the centre of one of them, which counts as free.
    """
    left, low, right, high = world.standing_bounds
    low_ends, high_ends = np.minimum(start, goal), np.maximum(start, goal)
    least = np.minimum((left, low), low_ends) - SEARCH_MARGIN
    most = np.maximum((right, high), high_ends) + SEARCH_MARGIN
    side = max(SEARCH_SIDE, math.sqrt(float((most - least).prod()) / MAX_SEARCH_CELLS))
    before = np.ceil((np.array(start) - least) / side)
    x, y = (np.array(start) - before * side).tolist()
    count_x, count_y = (1 + np.ceil((most - (x, y)) / side)).astype(int).tolist()
    xs, ys = x + side * np.arange(count_x), y + side * np.arange(count_y)
    centres = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    free = (segment_clearance(centres, centres, world) >= radius).reshape(count_x, count_y)
    free[tuple(before.astype(int))] = True
    return x, y, side, free


@loop
def _list_places(motions: Motions, begin: float, key: float, spots: Floats) -> None:
    """Fill in where the movers' motions are every TIME_STEP."""
    movers, pieces = motions.movers[0], motions.pieces[0]
    for m in range(spots.shape[1]):
        offset = draw_offset(movers, m, key)
        for k in range(len(spots)):
            spots[k, m, 0], spots[k, m, 1], _, _ = locate_mover(
                movers, m, pieces, begin + k * TIME_STEP + offset
            )


@loop
def _search(  # noqa: C901, PLR0912, PLR0913, PLR0917 - one search, which reads top to bottom
    free: NDArray[np.bool_],
    x: float,
    y: float,
    side: float,
    spots: Floats,
    reaches: Floats,
    speed: float,
    start: Place,
    goal: Place,
    tolerance: float,
) -> Floats:
    """The path over cells that arrives first, (points, 3); empty where there is none."""
    width, height = free.shape
    busy = mark_busy(free, x, y, side, spots, reaches)
    first, owner, begins, ends = list_intervals(free, busy)
    here = int(np.rint((start[0] - x) / side)) * height + int(np.rint((start[1] - y) / side))
    if first[here] == first[here + 1] or begins[first[here]] > 0.0:
        return np.zeros((0, 3))
    arrival, leave = np.full(len(owner), np.inf), np.zeros(len(owner))
    before, done = np.full(len(owner), -1), np.zeros(len(owner), np.bool_)
    arrival[first[here]] = 0.0
    queue = [(0.0, first[here])]
    near, last = max(tolerance, 0.75 * side), -1
    while queue:
        _, state = heappop(queue)
        if done[state]:
            continue
        done[state] = True
        i, j = owner[state] // height, owner[state] % height
        if math.hypot(x + i * side - goal[0], y + j * side - goal[1]) <= near:
            last = state
            break
        for direction in range(9):
            di, dj = direction // 3 - 1, direction % 3 - 1
            next_i, next_j = i + di, j + dj
            if (di == 0 and dj == 0) or not (0 <= next_i < width and 0 <= next_j < height):
                continue
            if not (free[next_i, next_j] and free[i, next_j] and free[next_i, j]):
                continue
            takes = side * math.sqrt(di * di + dj * dj) / speed
            rest = math.hypot(x + next_i * side - goal[0], y + next_j * side - goal[1]) / speed
            cell = next_i * height + next_j
            for to in range(first[cell], first[cell + 1]):
                leaves = max(arrival[state], begins[to])
                arrives = leaves + takes
                if arrives > ends[state]:
                    break
                if arrives <= ends[to] and arrives < arrival[to]:
                    arrival[to], leave[to], before[to] = arrives, leaves, state
                    heappush(queue, (arrives + rest, to))
    count, state = 0, last
    while state >= 0:
        count, state = count + 2, before[state]
    rows = np.zeros((max(count - 1, 0), 3))  # of each cell the arrival and, but the last, the leave
    state, leaves = last, arrival[last]
    while state >= 0:
        count -= 2
        at_x, at_y = x + owner[state] // height * side, y + owner[state] % height * side
        rows[count] = arrival[state], at_x, at_y
        if count + 1 < len(rows):
            rows[count + 1] = leaves, at_x, at_y
        state, leaves = before[state], leave[state]
    return rows


@subroutine
def mark_busy(
    free: NDArray[np.bool_], x: float, y: float, side: float, spots: Floats, reaches: Floats
) -> NDArray[np.bool_]:
    """Which cells are within reach of a mover in each step, (width, height, steps)."""
    width, height = free.shape
    steps = len(spots) - 1
    busy = np.zeros((width, height, steps), np.bool_)
    for m in range(len(reaches)):
        reach = reaches[m]
        for k in range(steps):
            ax, ay, bx, by = spots[k, m, 0], spots[k, m, 1], spots[k + 1, m, 0], spots[k + 1, m, 1]
            jumps = abs(bx - ax) + abs(by - ay) > FARTHEST_STEP
            for end in range(2 if jumps else 1):
                if jumps:
                    ax, ay = spots[k + end, m, 0], spots[k + end, m, 1]
                    bx, by = ax, ay
                first_i = max(int(np.ceil((min(ax, bx) - reach - x) / side)), 0)
                first_j = max(int(np.ceil((min(ay, by) - reach - y) / side)), 0)
                last_i = min(int(np.floor((max(ax, bx) + reach - x) / side)), width - 1)
                last_j = min(int(np.floor((max(ay, by) + reach - y) / side)), height - 1)
                for i in range(first_i, last_i + 1):
                    for j in range(first_j, last_j + 1):
                        at_x, at_y = x + i * side, y + j * side
                        if distance_to_line(at_x, at_y, ax, ay, bx, by) < reach:
                            busy[i, j, k] = True
    return busy


@subroutine
def list_intervals(
    free: NDArray[np.bool_], busy: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats, Floats]:
    """The intervals in which cells are free.

    Returns:
        Number of each cell's first interval, one more at the end; of each interval its cell, and
        where it begins and ends [s].
    """
    width, height, steps = busy.shape
    first = np.zeros(width * height + 1, np.int64)
    for cell in range(width * height):
        row, count = busy[cell // height, cell % height], 0
        if free[cell // height, cell % height]:
            for k in range(steps):
                count += not row[k] and (k == 0 or row[k - 1])
        first[cell + 1] = first[cell] + count
    owner = np.zeros(first[-1], np.int64)
    begins, ends = np.zeros(len(owner)), np.zeros(len(owner))
    for cell in range(width * height):
        row, interval = busy[cell // height, cell % height], first[cell] - 1
        if first[cell + 1] > first[cell]:
            for k in range(steps):
                if not row[k]:
                    if k == 0 or row[k - 1]:
                        interval += 1
                        owner[interval], begins[interval] = cell, k * TIME_STEP
                    ends[interval] = (k + 1) * TIME_STEP
    return first, owner, begins, ends


def _straighten(
    rows: Floats, world: World, radius: float, spots: Floats, reaches: Floats
) -> Floats:
    """Remove points that a straight line at an even speed can replace."""
    kept, here = [0], 0
    while here < len(rows) - 1:
        ends = rows[here + 1 :, 1:]
        clear = segment_clearance(np.broadcast_to(rows[here, 1:], ends.shape), ends, world)
        blocked = clear < radius
        _find_met(rows[here], rows[here + 1 :], spots, reaches, blocked)
        free = np.flatnonzero(~blocked)
        here += 1 + (int(free[-1]) if len(free) else 0)
        kept.append(here)
    return rows[kept]


@loop
def _find_met(
    start: Floats, ends: Floats, spots: Floats, reaches: Floats, blocked: NDArray[np.bool_]
) -> None:
    """Mark the straight ways, from a row to others, on which somebody is met."""
    for n in range(len(ends)):
        takes = ends[n, 0] - start[0]
        first, last = int(np.ceil(start[0] / TIME_STEP)), int(ends[n, 0] / TIME_STEP)
        for k in range(first, last + 1):
            share = (k * TIME_STEP - start[0]) / takes if takes > 0.0 else 0.0
            at_x = start[1] + share * (ends[n, 1] - start[1])
            at_y = start[2] + share * (ends[n, 2] - start[2])
            for m in range(len(reaches)):
                dx, dy = at_x - spots[k, m, 0], at_y - spots[k, m, 1]
                if dx * dx + dy * dy < reaches[m] * reaches[m]:
                    blocked[n] = True
                    break
            if blocked[n]:
                break
