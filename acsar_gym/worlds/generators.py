"""Numbered worlds: each generator makes the same world from the same number and difficulty.

`generate_world("clutter", 17)` is the same world on every machine, so a benchmark can name its
worlds. Every world is solvable: it has a shortest path for the footprint, with a margin. Crowds
that a robot can't cross, although it knows all motions, are left out in the splits for the presets
acsar and jackal, see `moving.REDRAWN`.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import WorldError, format_error, require_extra, show_value
from acsar_gym.worlds import moving, registry
from acsar_gym.worlds.grid import Grid, search_cells
from acsar_gym.worlds.registry import GeneratorError, Maker
from acsar_gym.worlds.search import PATH_SPACING, check_path, shortest_path, world_along
from acsar_gym.worlds.world import Floats, Region, Rng, World, make_box, make_rectangle, make_wall

PATH_MARGIN = 0.05
"""Distance that every path keeps from obstacles on top of the footprint's radius [m]."""
DEFAULT_RADIUS = 0.25
"""Radius of the disc around a small robot's footprint, if none is given [m]."""
EASING_FACTOR = 0.97
"""If difficulty varies, every attempt that fails multiplies the next attempt's difficulty by
this."""
MAX_ATTEMPTS = 200  # worlds that are tried before a footprint counts as too large
ARENA_HALF = 4.0  # half the side of the open and the cluttered floor [m]

CORRIDOR_LENGTH = 10.0  # length of the corridor between rooms, along x [m]
ROOM_DEPTH = 3.0  # depth of the rooms, along y [m]
WIDEST_DOOR = 1.3  # width of doors at difficulty 0 [m]
DOOR_MARGIN = 0.2  # how much wider than the footprint's disc doors are at difficulty 1 [m]

BARN_CELLS = 30  # cells on a side of the field
BARN_CELL_SIDE = 0.15  # side of a cell [m]
CYLINDER_RADIUS = 0.075  # radius of a cylinder [m]
BARN_FIELD = (-4.425, 5.175)  # centre of cell (0, 0) [m]
BARN_ROBOT_CELLS = 5  # side of the square robot that must be able to cross [cells]
BARN_ROBOT_RADIUS = BARN_ROBOT_CELLS * BARN_CELL_SIDE / 2.0
"""Half of that side [m]: this robot's centre keeps this distance from the cylinders."""
BARN_FILLED = (25, 209)
"""Least and most cells filled in the published worlds, without the first and the last row."""
BARN_LENGTHS = (10.0, 13.9)  # least and greatest length of the published worlds' paths [m]
BARN_START = Region(-2.0, 3.0, 0.0, math.pi / 2.0)
BARN_GOAL = Region(-2.0, 13.0)
BARN_LARGEST_RADIUS = 1.0  # radius of the largest footprint that is tried [m]
FIELDS_AT_ONCE = 64  # fields that are made and checked together
FIELDS_OF_LARGER = 16
"""The same for footprints larger than BARN's robot, which get easier fields if none of these fit:
crowded fields are hopeless for them."""
MAX_ROUNDS = 1000

Level = float | tuple[float, float] | None
"""Difficulty of worlds: a number for all, a range (low, high) in which it varies from world to
world, or None, which is (0, 1)."""
Mask = NDArray[np.bool_]


def generate_world(
    kind: str, number: int, difficulty: Level = None, radius: float = DEFAULT_RADIUS
) -> World:
    """Make a world.

    Args:
        kind: One of `registry.list_kinds`.
        number: Number of the world, from 0.
        difficulty: Difficulty from 0 to 1. None or a range varies it from world to world.
        radius: Radius of the disc around the robot's footprint [m].

    Raises:
        WorldError: The kind is unknown, a number is out of range, or the footprint can't cross any
            such world.
    """
    registry.check_registered(kind)
    if not 0.0 < radius < math.inf:
        raise WorldError(f"radius = {radius!r}: must be a positive number of metres")
    if not isinstance(number, int | np.integer) or number < 0:
        raise WorldError(f"world number {number!r}: must be a whole number from 0")
    low, high = difficulty_limits(difficulty)

    rng = _make_rng(kind, number)
    hard = low if isinstance(difficulty, SupportsFloat) else low + (high - low) * rng.uniform()
    ease = EASING_FACTOR if high > low else 1.0
    problem = ""
    redraws = 0
    if (low, high) == (0.0, 1.0):
        redraws = moving.count_redraws(kind, radius).get(str(number), 0)
    for attempt in range(MAX_ATTEMPTS):
        try:
            world = _call_maker(kind, rng, max(hard * ease**attempt, low), radius)
            world = _check_solvable(world, radius, follows=kind in registry.REGISTERED)
        except GeneratorError:
            raise
        except WorldError as error:
            problem = str(error)
        else:
            if redraws == 0:
                return replace(world, name=f"{kind} {number}")
            redraws -= 1
    raise WorldError(
        f"{kind}: no world of this difficulty lets a footprint of radius {radius:g} m through; "
        f"use a lower difficulty (the last of {MAX_ATTEMPTS} attempts: {problem})"
    )


def _call_maker(kind: str, rng: Rng, difficulty: float, radius: float) -> World:
    """Call a generator once. Raises GeneratorError if calling it again is of no use."""
    if kind in MAKERS:
        return MAKERS[kind](rng, difficulty, radius)

    title = f"generator {kind!r} of {registry.home_module(kind)}"
    try:
        world = registry.REGISTERED[kind](rng, difficulty, radius)
    except WorldError:
        raise
    except Exception as error:
        raise GeneratorError(f"{title}: raised {format_error(error)}") from error
    if not isinstance(world, World):
        raise GeneratorError(f"{title}: returned {show_value(world)}, must return a World")
    return world


def _check_solvable(world: World, radius: float, *, follows: bool) -> World:
    """The world with a path. Raises WorldError if a footprint can't cross it or follow it."""
    if world.path is None:
        world = replace(world, path=shortest_path(world, radius + PATH_MARGIN, cuts=0))
    elif follows:
        check_path(world, radius)
    return world


def draw_difficulty(kind: str, number: int, difficulty: Level = None) -> float:
    """The difficulty from which `generate_world` starts for this world, 0 to 1."""
    low, high = difficulty_limits(difficulty)
    return low + (high - low) * _make_rng(kind, number).uniform()


def _make_rng(kind: str, number: int) -> Rng:
    return np.random.default_rng([zlib.crc32(kind.encode()), int(number)])


def difficulty_limits(difficulty: Level) -> tuple[float, float]:
    """Least and largest difficulty. Raises WorldError if they aren't from 0 to 1."""
    limits: Any = (0.0, 1.0) if difficulty is None else difficulty
    try:
        low, high = map(float, (limits, limits) if isinstance(limits, SupportsFloat) else limits)
    except (TypeError, ValueError, OverflowError):
        low = high = math.nan
    if not 0.0 <= low <= high <= 1.0 or isinstance(limits, str):
        raise WorldError(
            f"difficulty = {show_value(difficulty)}: must be from 0 to 1, or a range (low, high) "
            "of these"
        )
    return low, high


def make_open_floor(rng: Rng, difficulty: float, radius: float) -> World:
    """Make an empty floor. Goals are 1 to 2 m away, or up to 5 m at difficulty 1."""
    # The robot starts at the origin, heading along x.
    distance = rng.uniform(1.0, 2.0 + 3.0 * difficulty)
    bearing = rng.uniform(-math.pi, math.pi)
    return World(goal=Region(distance * math.cos(bearing), distance * math.sin(bearing)))


def make_clutter(rng: Rng, difficulty: float, radius: float) -> World:
    """Make a walled floor of 8 x 8 m with 10 to 45 cylinders and boxes.

    Start, in any heading, and goal are at least half the floor's side apart.
    """
    count = round(10 + 35 * difficulty)
    cylinders = int(rng.binomial(count, 0.6))
    # Cylinders come first among the places, boxes take the rest.
    places = rng.uniform(-ARENA_HALF, ARENA_HALF, (count, 2))
    circles = np.column_stack([places[:cylinders], rng.uniform(0.08, 0.3, cylinders)])
    segments = [make_rectangle(-ARENA_HALF, -ARENA_HALF, ARENA_HALF, ARENA_HALF)]
    for x, y in places[cylinders:].tolist():
        length = rng.uniform(0.15, 0.7)
        width = rng.uniform(0.15, 0.7)
        segments.append(make_box(x, y, length, width, theta=rng.uniform(0.0, math.pi)))

    inside = ARENA_HALF - radius - 2.0 * PATH_MARGIN
    if inside < 0.6 * ARENA_HALF:
        raise WorldError(f"a footprint of radius {radius:g} m is too large for this floor")
    start = goal = np.zeros(2)
    while math.dist(start, goal) < ARENA_HALF:
        start, goal = rng.uniform(-inside, inside, (2, 2))
    x, y = start.tolist()
    return World(
        circles,
        np.concatenate(segments),
        start=Region(x, y, theta=rng.uniform(-math.pi, math.pi)),
        goal=Region(*goal.tolist()),
    )


def make_smooth_path(rng: Rng, difficulty: float, radius: float) -> World:
    """Make a path of 4 to 8 m from the origin, with a curvature of up to 0.5 to 2 1/m."""
    waves = 3
    s = np.arange(0.0, rng.uniform(4.0, 8.0), PATH_SPACING)
    frequencies = rng.uniform(0.5, 2.0, waves)
    phases = rng.uniform(-math.pi, math.pi, waves)
    curvature = np.sin(s[:, None] * frequencies + phases).sum(axis=1)
    curvature *= (0.5 + 1.5 * difficulty) / np.abs(curvature).max()

    # Integrate the curvature, starting in the direction of x.
    headings = np.concatenate([[0.0], np.cumsum(curvature[:-1] * PATH_SPACING)])
    return _follow_steps(headings, np.full(len(headings), PATH_SPACING))


def make_waypoint_path(rng: Rng, difficulty: float, radius: float) -> World:
    """Make a path of 3 to 6 lines of 0.8 to 2 m, with turns of up to 45 to 120 degrees."""
    pieces = int(rng.integers(3, 7))
    sharpest = math.radians(45.0 + 75.0 * difficulty)
    turns = rng.uniform(-sharpest, sharpest, pieces)
    turns[0] = 0.0  # along x, the direction of the start
    return _follow_steps(np.cumsum(turns), rng.uniform(0.8, 2.0, pieces))


def _follow_steps(headings: Floats, lengths: Floats) -> World:
    """A world whose path starts at the origin and has steps of these headings and lengths."""
    steps = lengths[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
    return world_along(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))


def make_rooms(rng: Rng, difficulty: float, radius: float) -> World:
    """Make three or four rooms on each side of a corridor. Start and goal are in different rooms.

    With difficulty doors narrow from 1.3 m to the footprint's width and 20 cm, and furniture
    increases from none to four pieces a room.
    """
    door = WIDEST_DOOR + difficulty * (2.0 * radius + DOOR_MARGIN - WIDEST_DOOR)
    half = rng.uniform(0.6, 0.9)
    segments = [make_rectangle(0.0, -half - ROOM_DEPTH, CORRIDOR_LENGTH, half + ROOM_DEPTH)]
    rooms: list[Floats] = []
    for side in (-1.0, 1.0):
        count = int(rng.integers(3, 5))
        inner = np.arange(1, count) + rng.uniform(-0.15, 0.15, count - 1)
        edges = [0.0, *(inner * CORRIDOR_LENGTH / count).tolist(), CORRIDOR_LENGTH]
        segments += _make_room_walls(rng, edges, side, half=half, door=door)
        low, high = sorted((side * half, side * (half + ROOM_DEPTH)))
        rooms += [np.array([[x, low], [next_x, high]]) for x, next_x in pairwise(edges)]

    start, goal = rng.permutation(len(rooms))[:2].tolist()
    circles: list[list[float]] = []
    for room in rooms:
        _furnish_room(rng, room, difficulty, circles=circles, segments=segments)
    theta = rng.uniform(-math.pi, math.pi)
    return World(
        np.array(circles),
        np.concatenate(segments),
        start=_draw_place(rng, rooms[start], radius, theta),
        goal=_draw_place(rng, rooms[goal], radius),
    )


def _make_room_walls(
    rng: Rng, edges: list[float], side: float, half: float, door: float
) -> list[Floats]:
    """The wall to the corridor with a door to each room, and walls between rooms, some with one."""
    narrowest = min(next_x - x for x, next_x in pairwise(edges))
    if door > min(narrowest - 0.4, ROOM_DEPTH - 0.6):
        raise WorldError(f"doors of {door:.2f} m are too wide for these rooms")

    inner = side * half
    starts = [rng.uniform(x + 0.2, next_x - 0.2 - door) for x, next_x in pairwise(edges)]
    doors = np.array([[start, start + door] for start in starts])
    walls = [make_wall((0.0, inner), (CORRIDOR_LENGTH, inner), doors)]
    for x in edges[1:-1]:
        start = rng.uniform(0.3, ROOM_DEPTH - 0.3 - door)
        doors = np.array([[start, start + door]] if rng.random() < 0.5 else [])
        walls.append(make_wall((x, inner), (x, side * (half + ROOM_DEPTH)), doors))
    return walls


def _furnish_room(
    rng: Rng,
    room: Floats,
    difficulty: float,
    circles: list[list[float]],
    segments: list[Floats],
) -> None:
    """Add a room's furniture to the circles and segments of its world."""
    # All numbers are drawn before they are used, a fixed count for a piece.
    pieces = int(rng.binomial(4, difficulty))
    places = rng.uniform(room[0] + 0.45, room[1] - 0.45, (pieces, 2)).tolist()
    as_box = rng.random(pieces) < 0.5
    sizes = rng.uniform(0.2, 0.8, (pieces, 2)).tolist()
    for (x, y), is_box, (length, width) in zip(places, as_box, sizes, strict=True):
        if is_box:
            segments.append(make_box(x, y, length, width))
        else:
            circles.append([x, y, length / 3.0])


def _draw_place(rng: Rng, room: Floats, radius: float, theta: float | None = None) -> Region:
    """A random point of a room, away from its walls."""
    low = room[0] + radius + 0.1
    high = room[1] - radius - 0.1
    if (high <= low).any():
        raise WorldError(f"a footprint of radius {radius:g} m is too large for these rooms")
    x, y = rng.uniform(low, high).tolist()
    return Region(x, y, theta=theta)


def make_barn(rng: Rng, difficulty: float, radius: float) -> World:
    """Make a world like those of BARN (Perille et al. 2020), by its cellular automaton.

    A field of 30 x 30 cells of 0.15 m, with a cylinder in each filled cell, behind a walled
    corridor of 5 m: layout and frame of the published worlds. BARN's 5 x 5-cell robot can cross it,
    and also a footprint of this radius. The path is a shortest path over cells from any free cell
    of the first column to any of the last column, as the published paths are. Difficulty picks the
    share of cells filled before smoothing: 0.15, 0.2, 0.25 or 0.3.
    """
    if radius > BARN_LARGEST_RADIUS:
        raise GeneratorError(
            f"no BARN world lets a footprint of radius {radius:g} m through; use another kind of "
            f"world: it is too large for BARN's fields: at most {BARN_LARGEST_RADIUS:g} m"
        )

    # BARN's generator has these parameters: the share of filled cells, and rounds of smoothing.
    fill = 0.15 + 0.05 * min(int(4.0 * difficulty), 3)
    passes = int(rng.integers(2, 5))
    is_larger = radius > BARN_ROBOT_RADIUS
    count = FIELDS_OF_LARGER if is_larger else FIELDS_AT_ONCE
    rounds = 1 if is_larger else MAX_ROUNDS
    for _ in range(rounds):
        for cells, room in find_crossable(draw_fields(rng, fill, passes, count), radius):
            world = _cross_field(rng, cells, room)
            if not BARN_LENGTHS[0] <= world.length <= BARN_LENGTHS[1]:
                continue
            try:
                if is_larger:
                    shortest_path(world, radius, cuts=0)
            except WorldError:
                continue
            return world

    if is_larger:
        raise WorldError(f"none of {count} fields lets it through")
    raise GeneratorError("no BARN world can be crossed: use another difficulty")


def _cross_field(rng: Rng, cells: Mask, room: Mask) -> World:
    """The world of a field, with a path through the cells in which the robot's centre may be."""
    # From any free cell of the first column to any of the last, as the published paths are.
    first = int(rng.choice(np.flatnonzero(room[:, 0])))
    last = int(rng.choice(np.flatnonzero(room[:, -1])))
    grid = Grid(room, *BARN_FIELD, BARN_CELL_SIDE)
    way = search_cells(grid, first * BARN_CELLS, last * BARN_CELLS + BARN_CELLS - 1)
    centres = np.zeros((0, 2)) if way is None else grid.centres(way)
    ends = np.array([[end.x, end.y] for end in (BARN_START, BARN_GOAL)])
    path = np.concatenate([ends[:1], centres, ends[1:]])
    return World(place_cylinders(cells), start=BARN_START, goal=BARN_GOAL, path=path)


def draw_fields(rng: Rng, fill: float, passes: int, count: int = FIELDS_AT_ONCE) -> Mask:
    """(count, 30, 30): random cells, smoothed. The first and the last row are walls."""
    cells = rng.random((count, BARN_CELLS, BARN_CELLS)) < fill
    cells[:, [0, -1]] = True
    for _ in range(passes):
        # Cells outside of the field are free. Count the eight neighbours of each cell.
        padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1), (1, 1)))
        rows = padded[:, :-2] + padded[:, 1:-1] + padded[:, 2:]
        around = rows[:, :, :-2] + rows[:, :, 1:-1] + rows[:, :, 2:] - cells
        cells = (around >= 5) | (cells & (around > 1))
    cells[:, [0, -1]] = True
    return cells


def find_crossable(fields: Mask, radius: float = BARN_ROBOT_RADIUS) -> Iterator[tuple[Mask, Mask]]:
    """Yield fields that a robot can cross, with as many filled cells as published ones.

    With each the cells in which the robot's centre may be, which connect the first and last column.
    """
    with require_extra("a world with obstacles", "scipy"):
        from scipy.ndimage import binary_dilation, label  # noqa: PLC0415 - slow to import

    filled = fields[:, 1:-1].sum(axis=(1, 2))
    for field in fields[(filled >= BARN_FILLED[0]) & (filled <= BARN_FILLED[1])]:
        free = ~binary_dilation(field, _mark_near_cells(radius))
        regions, _ = label(free)
        through = {*regions[:, 0].tolist()} & {*regions[:, -1].tolist()} - {0}
        if through:
            yield field, regions == min(through)


def _mark_near_cells(radius: float) -> Mask:
    """Around the cell of a robot's centre, the cells that mustn't be filled."""
    if radius <= BARN_ROBOT_RADIUS:
        return np.ones((BARN_ROBOT_CELLS, BARN_ROBOT_CELLS), np.bool_)
    reach = (radius + CYLINDER_RADIUS) / BARN_CELL_SIDE
    cells = np.arange(-math.ceil(reach), math.ceil(reach) + 1)
    return np.hypot(*np.meshgrid(cells, cells)) < reach


def place_cylinders(cells: Mask) -> Floats:
    """(circles, 3): a BARN field's cylinders, and those of the corridor's three walls."""
    xs = BARN_FIELD[0] + BARN_CELL_SIDE * np.arange(BARN_CELLS)
    ys = 0.225 + BARN_CELL_SIDE * np.arange(33)
    corridor = [[x, 0.075] for x in xs] + [[x, y] for x in (xs[0], xs[-1]) for y in ys]
    field = np.argwhere(cells) * BARN_CELL_SIDE + BARN_FIELD
    centres = np.concatenate([corridor, field])
    return np.column_stack([centres, np.full(len(centres), CYLINDER_RADIUS)])


MAKERS: dict[str, Maker] = dict(
    zip(
        registry.BUILT_IN_KINDS,
        (
            *(make_open_floor, make_clutter, make_rooms, make_barn),
            *(make_smooth_path, make_waypoint_path),
            *(moving.make_crowd, moving.make_reacting_crowd, moving.make_dynabarn),
        ),
        strict=True,
    )
)
