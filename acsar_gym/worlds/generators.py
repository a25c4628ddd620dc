"""Numbered worlds: each generator makes the same world from the same number and difficulty."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import WorldError, require_extra, show_value
from acsar_gym.worlds import registry, search
from acsar_gym.worlds.grid import Grid, search_cells
from acsar_gym.worlds.registry import GeneratorError, Maker, OwnGenerator
from acsar_gym.worlds.search import check_path, shortest_path
from acsar_gym.worlds.world import Floats, Region, World, make_box, make_rectangle, make_wall

BARN_CELLS = 30
BARN_CELL_SIDE = 0.15
"""Side of a cell [m]."""
CYLINDER_RADIUS = 0.075
"""Radius of a cylinder [m]."""
BARN_FIELD = (-4.425, 5.175)
"""Centre of cell (0, 0) [m]."""
BARN_ROBOT_CELLS = 5
"""Side of the square robot that must be able to cross [cells]."""
BARN_ROBOT_RADIUS = BARN_ROBOT_CELLS * BARN_CELL_SIDE / 2.0
"""Half of that side [m]: this robot's centre keeps this distance from the cylinders."""
BARN_FILLED = (25, 209)
"""Least and most cells filled in the published worlds, without the first and the last row."""
BARN_LENGTHS = (10.0, 13.9)
"""Least and greatest length of the published worlds' paths [m]."""
BARN_START = Region(-2.0, 3.0, 0.0, math.pi / 2.0)
BARN_GOAL = Region(-2.0, 13.0)
FIELDS_AT_ONCE = 64
"""Fields that are made and checked together."""
MAX_ROUNDS = 1000
MAX_TRIED = 50
"""So many fields that BARN's robot can cross are tried before a larger footprint is rejected."""


def make_barn(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a world that BARN's 5 x 5-cell robot can cross, and a footprint of this radius, too.

    The path is made like the published ones: a shortest one over cells from any free cell of the
    first column to any of the last one, with the start before and the goal behind it.

    Args:
        rng: of the world.
        difficulty: 0 to 1; picks the share of cells filled before smoothing: 0.15, 0.2, 0.25 or
            0.3.
        radius: of the disc around the footprint [m].

    Raises:
        GeneratorError: the footprint is too large.
    """
    fill = 0.15 + 0.05 * min(int(4.0 * difficulty), 3)
    passes = int(rng.integers(2, 5))
    tried = 0
    for _ in range(MAX_ROUNDS):
        for cells, room in _crossable_fields(_fields(rng, fill, passes)):
            tried += 1
            path = _barn_path(rng, room)
            world = World(_cylinders(cells), start=BARN_START, goal=BARN_GOAL, path=path)
            if BARN_LENGTHS[0] <= world.length <= BARN_LENGTHS[1] and _lets_through(world, radius):
                return world
        if tried > MAX_TRIED:
            break
    raise GeneratorError(
        f"no BARN world lets a footprint of radius {radius:g} m through; use a lower difficulty, "
        "or another kind of world"
    )


def _lets_through(world: World, radius: float) -> bool:
    """Whether a footprint can cross that may be larger than BARN's robot."""
    try:
        return radius <= BARN_ROBOT_RADIUS or len(shortest_path(world, radius)) > 0
    except WorldError:
        return False


def _barn_path(rng: np.random.Generator, room: NDArray[np.bool_]) -> Floats:
    """(points, 2): from the start through the cells that the robot can reach to the goal [m]."""
    entries, exits = np.flatnonzero(room[:, 0]), np.flatnonzero(room[:, -1])
    first, last = int(rng.choice(entries)), int(rng.choice(exits))
    grid = Grid(room, *BARN_FIELD, BARN_CELL_SIDE)
    cells = search_cells(grid, first * BARN_CELLS, last * BARN_CELLS + BARN_CELLS - 1)
    way = np.zeros((0, 2)) if cells is None else grid.centres(cells)
    return np.concatenate([[[BARN_START.x, BARN_START.y]], way, [[BARN_GOAL.x, BARN_GOAL.y]]])


def _fields(rng: np.random.Generator, fill: float, passes: int) -> NDArray[np.bool_]:
    """(fields, 30, 30): random cells, smoothed; the first and the last row are walls."""
    cells = rng.random((FIELDS_AT_ONCE, BARN_CELLS, BARN_CELLS)) < fill
    cells[:, 0] = cells[:, -1] = True
    for _ in range(passes):
        cells = _smoothed(cells)
    cells[:, 0] = cells[:, -1] = True
    return cells


def _smoothed(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Smooth fields: five or more of its eight neighbours fill a cell, one or none clears it."""
    padded = np.pad(cells.astype(np.int8), ((0, 0), (1, 1), (1, 1)))
    around = sum(
        padded[:, i : i + BARN_CELLS, j : j + BARN_CELLS]
        for i in range(3)
        for j in range(3)
        if (i, j) != (1, 1)
    )
    smoothed: NDArray[np.bool_] = (around >= 5) | (cells & (around > 1))
    return smoothed


def _crossable_fields(
    fields: NDArray[np.bool_],
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Fields that BARN's robot can cross, with as many filled cells as published ones.

    Yields the field's cells, and those in which the robot's centre may be: cells that are connected
    with the first and the last column.
    """
    with require_extra("a world with obstacles", "scipy"):
        from scipy.ndimage import label  # noqa: PLC0415 - slow to import

    filled, free = fields[:, 1:-1].sum(axis=(1, 2)), _room(fields)
    as_published = (filled >= BARN_FILLED[0]) & (filled <= BARN_FILLED[1])
    likely = as_published & np.all(free.any(axis=1), axis=1)
    for field in np.flatnonzero(likely):
        regions, _ = label(free[field])
        through = set(regions[:, 0].tolist()) & set(regions[:, -1].tolist()) - {0}
        if through:
            yield fields[field], regions == min(through)


def _room(fields: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells in which the centre of BARN's robot may be."""
    half = BARN_ROBOT_CELLS // 2
    padded = np.pad(fields, ((0, 0), (half, half), (half, half)))
    filled = np.zeros_like(fields)
    for i in range(BARN_ROBOT_CELLS):
        for j in range(BARN_ROBOT_CELLS):
            filled |= padded[:, i : i + BARN_CELLS, j : j + BARN_CELLS]
    return ~filled


def _cylinders(cells: NDArray[np.bool_]) -> Floats:
    """(circles, 3): the field's cylinders, and those of the corridor's three walls."""
    field = np.argwhere(cells) * BARN_CELL_SIDE + BARN_FIELD
    xs = BARN_FIELD[0] + BARN_CELL_SIDE * np.arange(BARN_CELLS)
    ys = 0.225 + BARN_CELL_SIDE * np.arange(33)
    back = np.column_stack([xs, np.full(BARN_CELLS, 0.075)])
    sides = [np.column_stack([np.full(33, x), ys]) for x in (xs[0], xs[-1])]
    centres = np.concatenate([back, *sides, field])
    return np.column_stack([centres, np.full(len(centres), CYLINDER_RADIUS)])


CORRIDOR_LENGTH = 10.0
"""Length of the corridor, along x [m]."""
ROOM_DEPTH = 3.0
"""Depth of the rooms, along y [m]."""
WIDEST_DOOR = 1.3
"""Width of doors at difficulty 0 [m]."""
DOOR_MARGIN = 0.2
"""How much wider than the footprint's disc doors are at difficulty 1 [m]."""


def make_rooms(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make three or four rooms on each side of a corridor; start and goal are in different rooms.

    With difficulty doors narrow from 1.3 m to the footprint's width and 20 cm, and furniture
    increases from none to four pieces a room.
    """
    door = WIDEST_DOOR + difficulty * (2.0 * radius + DOOR_MARGIN - WIDEST_DOOR)
    half = rng.uniform(0.6, 0.9)
    walls = [make_rectangle(0.0, -half - ROOM_DEPTH, CORRIDOR_LENGTH, half + ROOM_DEPTH)]
    places: list[tuple[float, float, float, float]] = []
    for side in (-1.0, 1.0):
        edges = _edges(rng)
        walls += _walls(rng, edges, side, half, door)
        low, high = sorted((side * half, side * (half + ROOM_DEPTH)))
        places += [(left, low, right, high) for left, right in pairwise(edges)]
    start, goal = rng.permutation(len(places))[:2].tolist()
    furniture = [_furniture(rng, place, difficulty) for place in places]
    return World(
        np.concatenate([round_ones for round_ones, _ in furniture]),
        np.concatenate([*walls, *(boxes for _, boxes in furniture)]),
        _somewhere(rng, places[start], radius, rng.uniform(-math.pi, math.pi)),
        _somewhere(rng, places[goal], radius, None),
    )


def _edges(rng: np.random.Generator) -> list[float]:
    """Positions of the walls between the rooms of one side, along x [m]."""
    count = int(rng.integers(3, 5))
    inner = (np.arange(1, count) + rng.uniform(-0.15, 0.15, count - 1)) * CORRIDOR_LENGTH / count
    return [0.0, *inner.tolist(), CORRIDOR_LENGTH]


def _walls(
    rng: np.random.Generator, edges: list[float], side: float, half: float, door: float
) -> list[Floats]:
    """The wall to the corridor with a door to each room, and walls between rooms, some with one."""
    narrowest = min(right - left for left, right in pairwise(edges))
    if door > min(narrowest - 0.4, ROOM_DEPTH - 0.6):
        raise WorldError(f"doors of {door:.2f} m are too wide for these rooms")
    begin = [rng.uniform(left + 0.2, right - 0.2 - door) for left, right in pairwise(edges)]
    doors = np.array([[left, left + door] for left in begin])
    found = [make_wall((0.0, side * half), (CORRIDOR_LENGTH, side * half), doors)]
    for x in edges[1:-1]:
        at = rng.uniform(0.3, ROOM_DEPTH - 0.3 - door)
        gaps = np.array([[at, at + door]]) if rng.random() < 0.5 else np.zeros((0, 2))
        found.append(make_wall((x, side * half), (x, side * (half + ROOM_DEPTH)), gaps))
    return found


def _furniture(
    rng: np.random.Generator, place: tuple[float, float, float, float], difficulty: float
) -> tuple[Floats, Floats]:
    """Circles and segments of a room's furniture."""
    pieces = int(rng.binomial(4, difficulty))
    low, high = np.array(place[:2]) + 0.45, np.array(place[2:]) - 0.45
    spots = rng.uniform(low, high, (pieces, 2)).tolist()
    as_box = rng.random(pieces) < 0.5
    sizes = rng.uniform(0.2, 0.8, (pieces, 2)).tolist()
    boxes = [make_box(*s, *z) for s, z, b in zip(spots, sizes, as_box, strict=True) if b]
    circles = [[*s, z[0] / 3.0] for s, z, b in zip(spots, sizes, as_box, strict=True) if not b]
    return np.array(circles).reshape(-1, 3), np.concatenate([np.zeros((0, 4)), *boxes])


def _somewhere(
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


PATH_MARGIN = 0.05
"""Distance that every path keeps from obstacles on top of the footprint's radius [m]."""
DEFAULT_RADIUS = 0.25
"""Radius of the disc around a small robot's footprint, where none is given [m]."""
EASING_FACTOR = 0.97
"""Where difficulty varies, every attempt that fails multiplies the next one's difficulty by
this."""
MAX_ATTEMPTS = 200
"""Worlds that are tried before a footprint counts as too large."""
ARENA_HALF = 4.0
"""Half the side of the open and the cluttered floor [m]."""

Level = float | tuple[float, float] | None
"""Difficulty of worlds: one for all, a range (low, high) in which it varies from world to world,
or None, which is (0, 1)."""


def generate_world(
    kind: str, number: int, difficulty: Level = None, radius: float = DEFAULT_RADIUS
) -> World:
    """Make a world.

    Args:
        kind: open, clutter, rooms, barn, smooth_path, waypoint_path, or a registered one.
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
    rng = _generator(kind, number)
    hard = low if isinstance(difficulty, SupportsFloat) else low + (high - low) * rng.uniform()
    ease = EASING_FACTOR if high > low else 1.0
    own = registry.find_own(kind)
    maker = _MAKERS[kind] if own is None else partial(_crossable, own)
    world = _solvable(kind, maker, rng, (hard, low, ease), radius)
    return replace(world, name=f"{kind} {number}")


def draw_difficulty(kind: str, number: int, difficulty: Level = None) -> float:
    """The difficulty from which `generate` starts for this world, 0 to 1; doesn't make the world.

    Where no world of this difficulty can be crossed, `generate` makes an easier one, within the
    range.
    """
    low, high = difficulty_limits(difficulty)
    return low + (high - low) * _generator(kind, number).uniform()


def _generator(kind: str, number: int) -> np.random.Generator:
    """The random generator of a world."""
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
            f"difficulty = {show_value(difficulty)}: must be from 0 to 1, or a range "
            "(low, high) of "
            "these"
        )
    return low, high


def _crossable(
    own: OwnGenerator, rng: np.random.Generator, difficulty: float, radius: float
) -> World:
    """Call a registered generator once, and check the path of its world."""
    world = own.world(rng, difficulty, radius)
    if world.path is not None:
        check_path(world, radius)
    return world


def _solvable(
    kind: str,
    maker: Maker,
    rng: np.random.Generator,
    levels: tuple[float, float, float],
    radius: float,
) -> World:
    """Call a generator until it makes a world that can be crossed.

    `levels` are the difficulty, the least one, and the factor by which each attempt that fails
    makes the next one easier.
    """
    hard, least, ease = levels
    for attempt in range(MAX_ATTEMPTS):
        try:
            world = maker(rng, max(hard * ease**attempt, least), radius)
            if world.path is None:
                world = replace(world, path=shortest_path(world, radius + PATH_MARGIN, cuts=0))
        except GeneratorError:
            raise
        except WorldError as error:
            last = error
        else:
            return world
    raise WorldError(
        f"{kind}: no world of this difficulty lets a footprint of radius {radius:g} m through; "
        f"use a lower difficulty (the last of {MAX_ATTEMPTS} attempts: {last})"
    )


def make_open_floor(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make an empty floor; goals are 1 to 2 m away, or up to 5 m at difficulty 1."""
    distance = rng.uniform(1.0, 2.0 + 3.0 * difficulty)
    bearing = rng.uniform(-math.pi, math.pi)
    goal = Region(distance * math.cos(bearing), distance * math.sin(bearing))
    return World(start=Region(0.0, 0.0, 0.0, 0.0), goal=goal)


def make_clutter(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a walled floor of 8 x 8 m with 10 to 45 cylinders and boxes."""
    count = round(10 + 35 * difficulty)
    round_ones = int(rng.binomial(count, 0.6))
    places = rng.uniform(-ARENA_HALF, ARENA_HALF, (count, 2))
    circles = np.column_stack([places[:round_ones], rng.uniform(0.08, 0.3, round_ones)])
    boxes = [
        make_box(x, y, rng.uniform(0.15, 0.7), rng.uniform(0.15, 0.7), rng.uniform(0.0, math.pi))
        for x, y in places[round_ones:].tolist()
    ]
    walls = make_rectangle(-ARENA_HALF, -ARENA_HALF, ARENA_HALF, ARENA_HALF)
    start, goal = _far_apart(rng, radius)
    return World(circles, np.concatenate([walls, *boxes]), start, goal)


def _far_apart(rng: np.random.Generator, radius: float) -> tuple[Region, Region]:
    """A start, in any heading, and a goal, at least half the floor's side apart."""
    inside = ARENA_HALF - radius - 2.0 * PATH_MARGIN
    if inside < 0.6 * ARENA_HALF:
        raise WorldError(f"a footprint of radius {radius:g} m is too large for this floor")
    while True:
        ends = rng.uniform(-inside, inside, (2, 2))
        if math.dist(ends[0], ends[1]) >= ARENA_HALF:
            break
    (x, y), (goal_x, goal_y) = ends.tolist()
    return Region(x, y, 0.0, rng.uniform(-math.pi, math.pi)), Region(goal_x, goal_y)


_MAKERS: dict[str, Maker] = {
    "open": make_open_floor,
    "clutter": make_clutter,
    "rooms": make_rooms,
    "barn": make_barn,
    "smooth_path": search.make_smooth_path,
    "waypoint_path": search.make_waypoint_path,
}
