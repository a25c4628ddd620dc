"""Numbered worlds: each generator makes the same world from the same number and difficulty.

`generate_world("clutter", 17)` is the same world on every machine, so a benchmark can name its
worlds. Every world is solvable: it has a shortest path for the footprint, with a margin, and where
something moves, a robot that knows all motions can cross it. `generate_world("clutter+6", 17)` is
the same world with six walkers.
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

from acsar_gym.errors import WorldError, require_extra, show_value
from acsar_gym.worlds import moving, registry
from acsar_gym.worlds.grid import Grid, search_cells
from acsar_gym.worlds.registry import GeneratorError, Maker
from acsar_gym.worlds.search import PATH_SPACING, check_path, shortest_path, world_along
from acsar_gym.worlds.world import Floats, Region, World, make_box, make_rectangle, make_wall

PATH_MARGIN = 0.05
"""Distance that every path keeps from obstacles on top of the footprint's radius [m]."""
DEFAULT_RADIUS = 0.25
"""Radius of the disc around a small robot's footprint, where none is given [m]."""
EASING_FACTOR = 0.97
"""Where difficulty varies, every attempt that fails multiplies the next one's difficulty by
this."""
MAX_ATTEMPTS = 200  # worlds that are tried before a footprint counts as too large
ARENA_HALF = 4.0  # half the side of the open and the cluttered floor [m]

CORRIDOR_LENGTH = 10.0  # length of the corridor between rooms, along x [m]
ROOM_DEPTH = 3.0  # depth of the rooms, along y [m]
WIDEST_DOOR = 1.3  # width of doors at difficulty 0 [m]
DOOR_MARGIN = 0.2  # how much wider than the footprint's disc doors are at difficulty 1 [m]

BARN_CELLS = 30
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
"""As many for footprints larger than BARN's robot, which get easier ones where none of these fit:
crowded fields are hopeless for them."""
MAX_ROUNDS = 1000

Level = float | tuple[float, float] | None
"""Difficulty of worlds: one for all, a range (low, high) in which it varies from world to world,
or None, which is (0, 1)."""
Mask = NDArray[np.bool_]


def generate_world(
    kind: str, number: int, difficulty: Level = None, radius: float = DEFAULT_RADIUS
) -> World:
    """Make a world.

    Args:
        kind: one of `registry.list_kinds`, or one like "clutter+6", in which so many walk.
        number: of the world, from 0.
        difficulty: from 0 to 1; None or a range varies it from world to world.
        radius: of the disc around the robot's footprint [m].

    Raises:
        WorldError: for an unknown kind, a bad number, or a footprint that can't cross any such
            world.
    """
    check_kind(kind, difficulty)
    try:
        sound = 0.0 < float(radius) < math.inf
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        raise WorldError(f"radius = {radius!r}: must be a positive number of metres")
    if not isinstance(number, int | np.integer) or number < 0:
        raise WorldError(f"world number {number!r}: must be a whole number from 0")
    low, high = difficulty_limits(difficulty)
    base, _ = registry.split_walkers(kind)
    rng = _random_generator(base, number)
    hard = low if isinstance(difficulty, SupportsFloat) else low + (high - low) * rng.uniform()
    ease = EASING_FACTOR if high > low else 1.0
    own_generator = registry.find_own(kind)
    maker = MAKERS[base] if own_generator is None else own_generator.world
    problem = ""
    redraws = moving.count_redraws(kind, number, radius) if (low, high) == (0.0, 1.0) else 0
    for attempt in range(MAX_ATTEMPTS):
        try:
            world = maker(rng, max(hard * ease**attempt, low), radius)
            world = _check_solvable(world, radius, is_own=own_generator is not None)
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


def _check_solvable(world: World, radius: float, *, is_own: bool) -> World:
    """The world with a path; WorldError where a footprint can't cross it."""
    if world.path is None:
        world = replace(world, path=shortest_path(world, radius + PATH_MARGIN, cuts=0))
    elif is_own:
        check_path(world, radius)
    return world


def draw_difficulty(kind: str, number: int, difficulty: Level = None) -> float:
    """The difficulty from which `generate_world` starts for this world, 0 to 1."""
    low, high = difficulty_limits(difficulty)
    base, _ = registry.split_walkers(kind)
    return low + (high - low) * _random_generator(base, number).uniform()


def _random_generator(kind: str, number: int) -> np.random.Generator:
    return np.random.default_rng([zlib.crc32(kind.encode()), int(number)])


def check_kind(kind: str, difficulty: Level) -> None:
    """Raise WorldError for an unknown kind, or a difficulty that isn't from 0 to 1."""
    registry.check_registered(kind)
    difficulty_limits(difficulty)


def difficulty_limits(difficulty: Level) -> tuple[float, float]:
    """Least and largest difficulty; WorldError for one that isn't from 0 to 1."""
    given: Any = (0.0, 1.0) if difficulty is None else difficulty
    try:
        low, high = map(float, (given, given) if isinstance(given, SupportsFloat) else given)
        sound = 0.0 <= low <= high <= 1.0 and not isinstance(given, str)
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        raise WorldError(
            f"difficulty = {show_value(difficulty)}: must be from 0 to 1, or a range (low, high) "
            "of these"
        )
    return low, high


def make_open_floor(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make an empty floor; goals are 1 to 2 m away, or up to 5 m at difficulty 1."""
    distance = rng.uniform(1.0, 2.0 + 3.0 * difficulty)
    bearing = rng.uniform(-math.pi, math.pi)
    goal = Region(distance * math.cos(bearing), distance * math.sin(bearing))
    return World(start=Region(0.0, 0.0, 0.0, 0.0), goal=goal)


def make_clutter(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a walled floor of 8 x 8 m with 10 to 45 cylinders and boxes.

    Start, in any heading, and goal are at least half the floor's side apart.
    """
    count = round(10 + 35 * difficulty)
    round_ones = int(rng.binomial(count, 0.6))
    places = rng.uniform(-ARENA_HALF, ARENA_HALF, (count, 2))
    circles = np.column_stack([places[:round_ones], rng.uniform(0.08, 0.3, round_ones)])
    boxes = [
        make_box(x, y, rng.uniform(0.15, 0.7), rng.uniform(0.15, 0.7), rng.uniform(0.0, math.pi))
        for x, y in places[round_ones:].tolist()
    ]
    walls = make_rectangle(-ARENA_HALF, -ARENA_HALF, ARENA_HALF, ARENA_HALF)
    inside = ARENA_HALF - radius - 2.0 * PATH_MARGIN
    if inside < 0.6 * ARENA_HALF:
        raise WorldError(f"a footprint of radius {radius:g} m is too large for this floor")
    ends = np.zeros((2, 2))
    while math.dist(ends[0], ends[1]) < ARENA_HALF:
        ends = rng.uniform(-inside, inside, (2, 2))
    (x, y), (goal_x, goal_y) = ends.tolist()
    start = Region(x, y, 0.0, rng.uniform(-math.pi, math.pi))
    return World(circles, np.concatenate([walls, *boxes]), start, Region(goal_x, goal_y))


def make_smooth_path(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a path of 4 to 8 m from the origin, with a curvature of up to 0.5 to 2 1/m."""
    length, waves = rng.uniform(4.0, 8.0), 3
    s = np.arange(0.0, length, PATH_SPACING)
    frequencies, phases = rng.uniform(0.5, 2.0, waves), rng.uniform(-math.pi, math.pi, waves)
    curvature = np.sin(s[:, None] * frequencies + phases).sum(axis=1)
    curvature *= (0.5 + 1.5 * difficulty) / np.abs(curvature).max()
    heading = np.concatenate([[0.0], np.cumsum(curvature[:-1] * PATH_SPACING)])
    return _follow_steps(heading, np.full(len(heading), PATH_SPACING))


def make_waypoint_path(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a path of 3 to 6 lines of 0.8 to 2 m, with turns of up to 45 to 120 degrees."""
    pieces = int(rng.integers(3, 7))
    sharpest = math.radians(45.0 + 75.0 * difficulty)
    turns = rng.uniform(-sharpest, sharpest, pieces)
    turns[0] = 0.0
    return _follow_steps(np.cumsum(turns), rng.uniform(0.8, 2.0, pieces))


def _follow_steps(headings: Floats, lengths: Floats) -> World:
    """A world whose path begins in the origin and has steps of these headings and lengths."""
    steps = lengths[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
    return world_along(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))


def make_rooms(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make three or four rooms on each side of a corridor; start and goal are in different rooms.

    With difficulty doors narrow from 1.3 m to the footprint's width and 20 cm, and furniture
    increases from none to four pieces a room.
    """
    door = WIDEST_DOOR + difficulty * (2.0 * radius + DOOR_MARGIN - WIDEST_DOOR)
    half = rng.uniform(0.6, 0.9)
    segments = [make_rectangle(0.0, -half - ROOM_DEPTH, CORRIDOR_LENGTH, half + ROOM_DEPTH)]
    places: list[tuple[float, float, float, float]] = []
    for side in (-1.0, 1.0):
        count = int(rng.integers(3, 5))
        inner = np.arange(1, count) + rng.uniform(-0.15, 0.15, count - 1)
        edges = [0.0, *(inner * CORRIDOR_LENGTH / count).tolist(), CORRIDOR_LENGTH]
        segments += _make_room_walls(rng, edges, side, half, door)
        low, high = sorted((side * half, side * (half + ROOM_DEPTH)))
        places += [(left, low, right, high) for left, right in pairwise(edges)]
    start, goal = rng.permutation(len(places))[:2].tolist()
    circles = [np.zeros((0, 3))]
    for place in places:
        some_circles, boxes = _furnish_room(rng, place, difficulty)
        circles.append(some_circles)
        segments += boxes
    return World(
        np.concatenate(circles),
        np.concatenate(segments),
        _draw_place(rng, places[start], radius, rng.uniform(-math.pi, math.pi)),
        _draw_place(rng, places[goal], radius, None),
    )


def _make_room_walls(
    rng: np.random.Generator, edges: list[float], side: float, half: float, door: float
) -> list[Floats]:
    """The wall to the corridor with a door to each room, and walls between rooms, some with one."""
    narrowest = min(right - left for left, right in pairwise(edges))
    if door > min(narrowest - 0.4, ROOM_DEPTH - 0.6):
        raise WorldError(f"doors of {door:.2f} m are too wide for these rooms")
    begin = [rng.uniform(left + 0.2, right - 0.2 - door) for left, right in pairwise(edges)]
    doors = np.array([[left, left + door] for left in begin])
    walls = [make_wall((0.0, side * half), (CORRIDOR_LENGTH, side * half), doors)]
    for x in edges[1:-1]:
        at = rng.uniform(0.3, ROOM_DEPTH - 0.3 - door)
        gaps = np.array([[at, at + door]]) if rng.random() < 0.5 else np.zeros((0, 2))
        walls.append(make_wall((x, side * half), (x, side * (half + ROOM_DEPTH)), gaps))
    return walls


def _furnish_room(
    rng: np.random.Generator, place: tuple[float, float, float, float], difficulty: float
) -> tuple[Floats, list[Floats]]:
    """Circles of a room's furniture, and the sides of its boxes."""
    pieces = int(rng.binomial(4, difficulty))
    low, high = np.array(place[:2]) + 0.45, np.array(place[2:]) - 0.45
    spots = rng.uniform(low, high, (pieces, 2)).tolist()
    as_box = rng.random(pieces) < 0.5
    sizes = rng.uniform(0.2, 0.8, (pieces, 2)).tolist()
    boxes = [make_box(*s, *z) for s, z, b in zip(spots, sizes, as_box, strict=True) if b]
    circles = [[*s, z[0] / 3.0] for s, z, b in zip(spots, sizes, as_box, strict=True) if not b]
    return np.array(circles).reshape(-1, 3), boxes


def _draw_place(
    rng: np.random.Generator,
    place: tuple[float, float, float, float],
    radius: float,
    theta: float | None,
) -> Region:
    """A random point of a room, away from its walls."""
    low, high = np.array(place[:2]) + radius + 0.1, np.array(place[2:]) - radius - 0.1
    if (high <= low).any():
        raise WorldError(f"a footprint of radius {radius:g} m is too large for these rooms")
    x, y = rng.uniform(low, high).tolist()
    return Region(x, y, 0.0, theta)


def make_barn(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a world like those of BARN (Perille et al. 2020), by its cellular automaton.

    A field of 30 x 30 cells of 0.15 m, with a cylinder in each filled cell, behind a walled
    corridor of 5 m: layout and frame of the published worlds. BARN's 5 x 5-cell robot can cross it,
    and a footprint of this radius, too. The path is a shortest one over cells from any free cell of
    the first column to any of the last one, as the published ones are. Difficulty picks the share
    of cells filled before smoothing: 0.15, 0.2, 0.25 or 0.3.
    """
    if radius > BARN_LARGEST_RADIUS:
        raise GeneratorError(
            f"no BARN world lets a footprint of radius {radius:g} m through; use another kind of "
            f"world: it is too large for BARN's fields: at most {BARN_LARGEST_RADIUS:g} m"
        )
    fill = 0.15 + 0.05 * min(int(4.0 * difficulty), 3)
    passes, is_larger = int(rng.integers(2, 5)), radius > BARN_ROBOT_RADIUS
    count = FIELDS_OF_LARGER if is_larger else FIELDS_AT_ONCE
    for _ in range(1 if is_larger else MAX_ROUNDS):
        for cells, room in find_crossable(draw_fields(rng, fill, passes, count), radius):
            entries, exits = np.flatnonzero(room[:, 0]), np.flatnonzero(room[:, -1])
            first, last = int(rng.choice(entries)), int(rng.choice(exits))
            grid = Grid(room, *BARN_FIELD, BARN_CELL_SIDE)
            way = search_cells(grid, first * BARN_CELLS, last * BARN_CELLS + BARN_CELLS - 1)
            centres = np.zeros((0, 2)) if way is None else grid.centres(way)
            ends = ([[end.x, end.y]] for end in (BARN_START, BARN_GOAL))
            path = np.concatenate([next(ends), centres, next(ends)])
            world = World(place_cylinders(cells), start=BARN_START, goal=BARN_GOAL, path=path)
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


def draw_fields(
    rng: np.random.Generator, fill: float, passes: int, count: int = FIELDS_AT_ONCE
) -> Mask:
    """(count, 30, 30): random cells, smoothed; the first and the last row are walls."""
    cells = rng.random((count, BARN_CELLS, BARN_CELLS)) < fill
    cells[:, 0] = cells[:, -1] = True
    for _ in range(passes):
        padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1), (1, 1)))
        around = sum(_shifted(padded, i, j) for i in range(3) for j in range(3)) - cells
        cells = (around >= 5) | (cells & (around > 1))
    cells[:, 0] = cells[:, -1] = True
    return cells


def _shifted(padded: NDArray[Any], i: int, j: int) -> NDArray[Any]:
    return padded[:, i : i + BARN_CELLS, j : j + BARN_CELLS]


def find_crossable(fields: Mask, radius: float = BARN_ROBOT_RADIUS) -> Iterator[tuple[Mask, Mask]]:
    """Yield fields that a robot can cross, with as many filled cells as published ones.

    With each the cells in which the robot's centre may be, which connect the first and last column.
    """
    with require_extra("a world with obstacles", "scipy"):
        from scipy.ndimage import label  # noqa: PLC0415 - slow to import

    near = list_near_cells(radius)
    half = max(i for i, _ in near)
    padded = np.pad(fields, ((0, 0), (half, half), (half, half)))
    filled_near = np.zeros_like(fields)
    for i, j in near:
        filled_near |= _shifted(padded, half + i, half + j)
    free = ~filled_near
    filled = fields[:, 1:-1].sum(axis=(1, 2))
    as_published = (filled >= BARN_FILLED[0]) & (filled <= BARN_FILLED[1])
    likely = as_published & np.all(free.any(axis=1), axis=1)
    for field in np.flatnonzero(likely):
        regions, _ = label(free[field])
        through = set(regions[:, 0].tolist()) & set(regions[:, -1].tolist()) - {0}
        if through:
            yield fields[field], regions == min(through)


def list_near_cells(radius: float) -> list[tuple[int, int]]:
    """Cells, from that of a robot's centre, which mustn't be filled where the robot is."""
    if radius <= BARN_ROBOT_RADIUS:
        sides = range(-(BARN_ROBOT_CELLS // 2), BARN_ROBOT_CELLS // 2 + 1)
        return [(i, j) for i in sides for j in sides]
    reach = (radius + CYLINDER_RADIUS) / BARN_CELL_SIDE
    sides = range(-math.ceil(reach), math.ceil(reach) + 1)
    return [(i, j) for i in sides for j in sides if math.hypot(i, j) < reach]


def place_cylinders(cells: Mask) -> Floats:
    """(circles, 3): a BARN field's cylinders, and those of the corridor's three walls."""
    field = np.argwhere(cells) * BARN_CELL_SIDE + BARN_FIELD
    xs = BARN_FIELD[0] + BARN_CELL_SIDE * np.arange(BARN_CELLS)
    ys = 0.225 + BARN_CELL_SIDE * np.arange(33)
    back = np.column_stack([xs, np.full(BARN_CELLS, 0.075)])
    sides = [np.column_stack([np.full(33, x), ys]) for x in (xs[0], xs[-1])]
    centres = np.concatenate([back, *sides, field])
    return np.column_stack([centres, np.full(len(centres), CYLINDER_RADIUS)])


MAKERS: dict[str, Maker] = {
    "open": make_open_floor,
    "clutter": make_clutter,
    "rooms": make_rooms,
    "barn": make_barn,
    "smooth_path": make_smooth_path,
    "waypoint_path": make_waypoint_path,
    "crowd": moving.make_crowd,
    "crowd_reacting": moving.make_reacting_crowd,
    "dynabarn": moving.make_dynabarn,
}
