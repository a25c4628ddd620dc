"""Numbered worlds: each generator makes the same world from the same number and difficulty.

`generate("clutter", 17)` is the same world on every machine, so a benchmark can name its worlds.
Every world is solvable: it has a shortest path for the footprint, with a margin.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import replace
from functools import partial
from typing import Any, SupportsFloat

import numpy as np

from acsar_gym.errors import WorldError, shown
from acsar_gym.worlds import barn, paths, registry, rooms
from acsar_gym.worlds.registry import GeneratorError, Maker, Own
from acsar_gym.worlds.search import check_path, shortest_path
from acsar_gym.worlds.shapes import box, outline
from acsar_gym.worlds.world import Region, World

MARGIN = 0.05
"""Distance that every path keeps from obstacles on top of the footprint's radius [m]."""
DEFAULT_RADIUS = 0.25
"""Radius of the disc around a small robot's footprint, where none is given [m]."""
EASE = 0.97
"""Where difficulty varies, every attempt that fails multiplies the next one's difficulty by
this."""
ATTEMPTS = 200
"""Worlds that are tried before a footprint counts as too large."""
ARENA = 4.0
"""Half the side of the open and the cluttered floor [m]."""

Level = float | tuple[float, float] | None
"""Difficulty of worlds: one for all, a range (low, high) in which it varies from world to world,
or None, which is (0, 1)."""


def generate(
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
    check(kind, difficulty)
    try:
        sound = 0.0 < float(radius) < math.inf
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        raise WorldError(f"radius = {radius!r}: must be a positive number of metres")
    if not isinstance(number, int | np.integer) or number < 0:
        raise WorldError(f"world number {number!r}: must be a whole number from 0")
    low, high = limits(difficulty)
    rng = _generator(kind, number)
    hard = low if isinstance(difficulty, SupportsFloat) else low + (high - low) * rng.uniform()
    ease = EASE if high > low else 1.0
    own = registry.own(kind)
    maker = _MAKERS[kind] if own is None else partial(_crossable, own)
    world = _solvable(kind, maker, rng, (hard, low, ease), radius)
    return replace(world, name=f"{kind} {number}")


def level(kind: str, number: int, difficulty: Level = None) -> float:
    """The difficulty from which `generate` starts for this world, 0 to 1; doesn't make the world.

    Where no world of this difficulty can be crossed, `generate` makes an easier one, within the
    range.
    """
    low, high = limits(difficulty)
    return low + (high - low) * _generator(kind, number).uniform()


def _generator(kind: str, number: int) -> np.random.Generator:
    """The random generator of a world."""
    return np.random.default_rng([zlib.crc32(kind.encode()), int(number)])


def check(kind: str, difficulty: Level) -> None:
    """Raise WorldError for an unknown kind, or a difficulty that isn't from 0 to 1."""
    registry.check(kind)
    limits(difficulty)


def limits(difficulty: Level) -> tuple[float, float]:
    """Least and largest difficulty; WorldError for one that isn't from 0 to 1."""
    given: Any = (0.0, 1.0) if difficulty is None else difficulty
    try:
        low, high = map(float, (given, given) if isinstance(given, SupportsFloat) else given)
        sound = 0.0 <= low <= high <= 1.0 and not isinstance(given, str)
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        raise WorldError(
            f"difficulty = {shown(difficulty)}: must be from 0 to 1, or a range (low, high) of "
            "these"
        )
    return low, high


def _crossable(own: Own, rng: np.random.Generator, difficulty: float, radius: float) -> World:
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
    for attempt in range(ATTEMPTS):
        try:
            world = maker(rng, max(hard * ease**attempt, least), radius)
            if world.path is None:
                world = replace(world, path=shortest_path(world, radius + MARGIN, cuts=0))
        except GeneratorError:
            raise
        except WorldError as error:
            last = error
        else:
            return world
    raise WorldError(
        f"{kind}: no world of this difficulty lets a footprint of radius {radius:g} m through; "
        f"use a lower difficulty (the last of {ATTEMPTS} attempts: {last})"
    )


def open_floor(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make an empty floor; goals are 1 to 2 m away, or up to 5 m at difficulty 1."""
    distance = rng.uniform(1.0, 2.0 + 3.0 * difficulty)
    bearing = rng.uniform(-math.pi, math.pi)
    goal = Region(distance * math.cos(bearing), distance * math.sin(bearing))
    return World(start=Region(0.0, 0.0, 0.0, 0.0), goal=goal)


def clutter(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a walled floor of 8 x 8 m with 10 to 45 cylinders and boxes."""
    count = round(10 + 35 * difficulty)
    round_ones = int(rng.binomial(count, 0.6))
    places = rng.uniform(-ARENA, ARENA, (count, 2))
    circles = np.column_stack([places[:round_ones], rng.uniform(0.08, 0.3, round_ones)])
    boxes = [
        box(x, y, rng.uniform(0.15, 0.7), rng.uniform(0.15, 0.7), rng.uniform(0.0, math.pi))
        for x, y in places[round_ones:].tolist()
    ]
    walls = outline(-ARENA, -ARENA, ARENA, ARENA)
    start, goal = _far_apart(rng, radius)
    return World(circles, np.concatenate([walls, *boxes]), start, goal)


def _far_apart(rng: np.random.Generator, radius: float) -> tuple[Region, Region]:
    """A start, in any heading, and a goal, at least half the floor's side apart."""
    inside = ARENA - radius - 2.0 * MARGIN
    if inside < 0.6 * ARENA:
        raise WorldError(f"a footprint of radius {radius:g} m is too large for this floor")
    while True:
        ends = rng.uniform(-inside, inside, (2, 2))
        if math.dist(ends[0], ends[1]) >= ARENA:
            break
    (x, y), (goal_x, goal_y) = ends.tolist()
    return Region(x, y, 0.0, rng.uniform(-math.pi, math.pi)), Region(goal_x, goal_y)


_MAKERS: dict[str, Maker] = {
    "open": open_floor,
    "clutter": clutter,
    "rooms": rooms.rooms,
    "barn": barn.barn,
    "smooth_path": paths.smooth,
    "waypoint_path": paths.waypoints,
}
