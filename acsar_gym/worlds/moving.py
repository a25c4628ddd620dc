"""Generated worlds that move: crowds in halls, DynaBARN, and walkers in standing worlds.

Walkers go there and back, or around, along ways that are free for them. They don't see each other,
as Gazebo's actors don't; people who react do, see `crowd`. Where a motion begins is drawn anew in
each episode, within its `spread`.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from acsar_gym.errors import WorldError
from acsar_gym.worlds.geometry import point_clearance
from acsar_gym.worlds.movers import (
    PERSON_RADIUS,
    Mover,
    Repeat,
    follow_keys,
    locate_alone,
    make_motions,
    walk,
)
from acsar_gym.worlds.search import path_length, shortest_path
from acsar_gym.worlds.time_search import search_time
from acsar_gym.worlds.world import Floats, Region, World, make_box, make_rectangle, make_wall

WALKER_MARGIN = 0.05
"""Distance that walkers keep from what stands, on top of their radius [m]."""
START_DISTANCE = 1.0
"""Least distance from a robot that starts to where movers begin, between their discs [m]."""
BEGIN_SPACING = 0.25  # of the places that are looked at for this [m]
PHASE_SPREAD = 6.0
"""A walker's begin varies by so much from episode to episode [s]."""
WALKER_SPEEDS = (0.3, 1.8)  # slowest of all, fastest at difficulty 1 [m/s]
EASY_SPEED = 0.6  # fastest at difficulty 0 [m/s]
LONGEST_PAUSE = 2.0  # where a walker turns back [s]
SHARE_AROUND = 0.3  # share of walkers who go around, not there and back
SHORTEST_WAY = 2.0  # between two places where a walker stops [m]
DENSITIES = (0.06, 0.25)  # walkers a square metre, at difficulty 0 and 1
WALKER_COUNTS = (2, 20)  # least and most walkers of a hall
REACTING_SHARES = (0.3, 0.9)
"""Share of people who react at difficulty 0 and 1, in worlds whose name says so."""
BLIND_SHARES = (0.0, 0.5)
"""Of those, the share who don't see the robot is drawn from this range for each world."""
DRAWS = 50  # ways that are drawn for one mover before the world counts as too crowded
POINT_DRAWS = 16  # places that are drawn for one stop of a way

OPEN_MARGIN = 2.0
"""Walkers who are added to a world without obstacles may go so far beyond its path [m]."""

CHECK_SPEED = 0.4
"""Top speed of the robot with which every world can be crossed [m/s]."""
CHECK_MARGIN = 0.1  # margin that this robot keeps from movers [m]
CHECK_KEYS = (0.1, 0.4, 0.7)
"""Episodes in which this is checked, see `Scene.key`."""

DYNABARN_HALF = 10.0  # half the side of DynaBARN's field [m]
DYNABARN_WALL = 0.5  # thickness of its three walls [m]
DYNABARN_RADIUS = 0.5  # radius of its cylinders [m]
DYNABARN_START = Region(11.0, 0.0, 0.0, math.pi)
"""Start and goal are those of the BARN Challenge, in its worlds 300 to 359."""
DYNABARN_GOAL = Region(-9.0, 0.0)
DYNABARN_COUNTS = (4, 16)  # cylinders at difficulty 0 and 1
DYNABARN_ORDERS = (1, 5)  # greatest order of polynomials at difficulty 0 and 1
DYNABARN_SPEEDS = (0.5, 2.5)
"""Least mean speed, and the greatest one at difficulty 1 [m/s]."""
DYNABARN_EASY_SPEED = 1.0  # greatest mean speed at difficulty 0 [m/s]
DYNABARN_SLOWEST = 0.3  # least speed between two points [m/s]
DYNABARN_SPREADS = (0.1, 0.5)
"""Standard deviation of the speed between two points at difficulty 0 and 1 [m/s]."""
OVERSHOOT = 1.3
"""Splines are faster in places than the straight lines between their points, at most so much."""
KEY_SPACING = 1.0
"""Points of a polynomial that are nearer to each other are left out [m]."""
JUMP_DISTANCE = 3.0
"""Least distance from the robot's start and goal to where a cylinder appears [m]."""

Box = tuple[float, float, float, float]  # least x and y, largest x and y [m]


class Hall(NamedTuple):
    """Walls around people and a robot."""

    walls: Floats
    """(segments, 4) [m]."""
    areas: list[Box]
    """A walker goes from one of these to another one."""
    start: Box
    """Where the robot starts."""
    goal: Box
    """Where its goal is."""
    floors: list[Box]
    """The floor, in parts that don't overlap."""


def make_crowd(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a corridor, a crossing, rooms with doors or an open floor, full of walkers.

    Their number and speeds grow with difficulty. Nobody reacts to the robot or to others.
    """
    return _make_hall(rng, difficulty, radius, reacting=0.0)


def make_reacting_crowd(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """As `make_crowd`, but a share of the people, which grows with difficulty, reacts.

    A part of them, drawn for each world, sees other people, but not the robot.
    """
    low, high = REACTING_SHARES
    return _make_hall(rng, difficulty, radius, reacting=low + difficulty * (high - low))


def _make_hall(
    rng: np.random.Generator, difficulty: float, radius: float, reacting: float
) -> World:
    """A hall with walkers, of whom a share reacts."""
    draw_hall = (draw_corridor, draw_crossing, draw_doors, draw_open_hall)[int(rng.integers(4))]
    hall = draw_hall(rng, radius)
    ends = [_draw_point(rng, box, radius + WALKER_MARGIN) for box in (hall.start, hall.goal)]
    start = Region(*ends[0], 0.0, rng.uniform(-math.pi, math.pi))
    round_ones, boxes = _draw_furniture(rng, hall)
    world = World(round_ones, np.concatenate([hall.walls, *boxes]), start, Region(*ends[1]))
    low, high = DENSITIES
    area = sum((right - left) * (top - bottom) for left, bottom, right, top in hall.floors)
    count = round(area * (low + difficulty * (high - low)))
    count = min(max(count, WALKER_COUNTS[0]), WALKER_COUNTS[1])
    blind = rng.uniform(*BLIND_SHARES)
    movers = []
    for _ in range(count):
        mover = draw_walker(rng, world, hall.areas, difficulty, radius)
        reacts, sees_robot = bool(rng.random() < reacting), bool(rng.random() >= blind)
        movers.append(replace(mover, reacts=reacts, sees_robot=sees_robot or not reacts))
    return replace(world, movers=tuple(movers))


def draw_corridor(rng: np.random.Generator, radius: float) -> Hall:
    """Draw a corridor of 9 to 12 m along x, through which the robot goes from end to end."""
    length, half = rng.uniform(9.0, 12.0), rng.uniform(1.2, 1.8)
    low, high = -half, half
    return Hall(
        make_rectangle(0.0, low, length, high),
        [(2.0, low, 3.5, high), (length - 3.5, low, length - 0.3, high)],
        (0.2, low, 1.0, high),
        (length - 1.0, low, length - 0.2, high),
        [(0.0, low, length, high)],
    )


def draw_crossing(rng: np.random.Generator, radius: float) -> Hall:
    """Draw two corridors that cross; the robot comes from one arm, and leaves by another."""
    reach = rng.uniform(4.0, 5.5)
    half_x, half_y = rng.uniform(1.1, 1.7, 2).tolist()  # of the corridors along y and along x
    corners = [
        np.array([[sx * half_x, sy * reach, sx * half_x, sy * half_y]])
        for sx in (-1.0, 1.0)
        for sy in (-1.0, 1.0)
    ]
    corners += [
        np.array([[sx * half_x, sy * half_y, sx * reach, sy * half_y]])
        for sx in (-1.0, 1.0)
        for sy in (-1.0, 1.0)
    ]
    ends = np.array(
        [
            [-half_x, -reach, half_x, -reach],
            [-half_x, reach, half_x, reach],
            [-reach, -half_y, -reach, half_y],
            [reach, -half_y, reach, half_y],
        ]
    )
    arms = [
        (-reach, -half_y, 1.3 - reach, half_y),
        (reach - 1.3, -half_y, reach, half_y),
        (-half_x, -reach, half_x, 1.3 - reach),
        (-half_x, reach - 1.3, half_x, reach),
    ]
    return Hall(
        np.concatenate([*corners, ends]),
        arms[1:],
        arms[0],
        arms[int(rng.integers(1, 4))],
        [
            (-reach, -half_y, reach, half_y),
            (-half_x, -reach, half_x, -half_y),
            (-half_x, half_y, half_x, reach),
        ],
    )


def draw_doors(rng: np.random.Generator, radius: float) -> Hall:
    """Draw two or three rooms side by side, with a door or two between them."""
    count, height = int(rng.integers(2, 4)), rng.uniform(4.0, 6.0)
    edges = np.concatenate([[0.0], np.cumsum(rng.uniform(3.0, 4.5, count))]).tolist()
    walls = [make_rectangle(0.0, 0.0, edges[-1], height)]
    for x in edges[1:-1]:
        width = max(rng.uniform(1.0, 1.5), 2.0 * radius + 0.5)
        doors = [rng.uniform(0.3, height / 2.0 - width)] if height / 2.0 - width > 0.4 else []
        doors = [*doors, rng.uniform(height / 2.0, height - 0.3 - width)]
        if len(doors) > 1 and rng.random() < 0.5:
            doors.pop(int(rng.integers(2)))
        gaps = np.array([[at, at + width] for at in doors])
        walls.append(make_wall((x, 0.0), (x, height), gaps))
    rooms = [(left, 0.0, right, height) for left, right in pairwise(edges)]
    return Hall(
        np.concatenate(walls),
        rooms,
        (0.2, 0.0, 1.2, height),
        (edges[-1] - 1.2, 0.0, edges[-1] - 0.2, height),
        rooms,
    )


def draw_open_hall(rng: np.random.Generator, radius: float) -> Hall:
    """Draw a floor of 7 to 10 m, which people cross in all directions."""
    width, height = rng.uniform(7.0, 10.0, 2).tolist()
    third_x, third_y = width / 3.0, height / 3.0
    return Hall(
        make_rectangle(0.0, 0.0, width, height),
        [
            (i * third_x, j * third_y, (i + 1) * third_x, (j + 1) * third_y)
            for i in range(3)
            for j in range(3)
            if (i, j) != (1, 1)
        ],
        (0.2, 0.2, 1.2, height - 0.2),
        (width - 1.2, 0.2, width - 0.2, height - 0.2),
        [(0.0, 0.0, width, height)],
    )


def _draw_point(rng: np.random.Generator, box: Box, margin: float) -> tuple[float, float]:
    """A point of a box, away from its sides."""
    low, high = np.array(box[:2]) + margin, np.array(box[2:]) - margin
    middle = (low + high) / 2.0
    x, y = rng.uniform(np.minimum(low, middle), np.maximum(high, middle)).tolist()
    return x, y


def _draw_furniture(rng: np.random.Generator, hall: Hall) -> tuple[Floats, list[Floats]]:
    """Up to four pillars and boxes: circles, and the sides of boxes."""
    circles, boxes = [], []
    for _ in range(int(rng.integers(0, 5))):
        x, y = _draw_point(rng, hall.floors[int(rng.integers(len(hall.floors)))], 0.0)
        if rng.random() < 0.5:
            circles.append([x, y, rng.uniform(0.1, 0.25)])
        else:
            length, width = rng.uniform(0.2, 0.6, 2).tolist()
            boxes.append(make_box(x, y, length, width, rng.uniform(0.0, math.pi)))
    return np.array(circles).reshape(-1, 3), boxes


def draw_walker(
    rng: np.random.Generator, world: World, areas: list[Box], difficulty: float, radius: float
) -> Mover:
    """Draw somebody who walks between areas of a world, but doesn't begin near the robot's start.

    WorldError where no way was found.
    """
    low, high = WALKER_SPEEDS
    speed = rng.uniform(low, EASY_SPEED + difficulty * (high - EASY_SPEED))
    for _ in range(DRAWS):
        goes_around = bool(rng.random() < SHARE_AROUND)
        picks = rng.choice(len(areas), 3 if goes_around else 2, replace=len(areas) < 3).tolist()
        try:
            stops = [_draw_stop(rng, world, areas[pick]) for pick in picks]
            ends = [*stops, stops[0]] if goes_around else stops
            ways = [
                shortest_path(world, PERSON_RADIUS + WALKER_MARGIN, here, there, cuts=0)
                for here, there in pairwise(ends)
            ]
        except WorldError:
            continue
        if min(map(path_length, ways)) < SHORTEST_WAY:
            continue
        points = np.concatenate([*(way[:-1] for way in ways), ways[-1][-1:]])
        pauses = np.zeros(len(points))
        pauses[np.cumsum([0, *(len(way) - 1 for way in ways)])] = rng.uniform(0.0, LONGEST_PAUSE)
        mover = walk(points, speed, pauses=pauses.tolist(), repeat=Repeat.BACK)
        if goes_around:
            mover = walk(points[:-1], speed, pauses=pauses[:-1].tolist(), repeat=Repeat.LOOP)
        mover = replace(mover, phase=rng.uniform(0.0, mover.cycle), spread=PHASE_SPREAD)
        if begins_away(mover, world.start, radius):
            return mover
    raise WorldError("is too crowded for one more walker")


def _draw_stop(rng: np.random.Generator, world: World, area: Box) -> Region:
    """A place of an area where a walker can stand; WorldError where none was found."""
    clear = PERSON_RADIUS + WALKER_MARGIN
    places = [_draw_point(rng, area, clear) for _ in range(POINT_DRAWS)]
    free = np.flatnonzero(point_clearance(places, world) >= clear)
    if not len(free):
        raise WorldError("is too crowded for one more walker")
    return Region(*places[free[0]])


def begins_away(mover: Mover, start: Region, radius: float) -> bool:
    """Whether a mover never begins within START_DISTANCE of a robot's start."""
    count = 2 + math.ceil(mover.spread * mover.top_speed / BEGIN_SPACING)
    (movers,), (pieces,), _ = make_motions([[mover]])
    shares = np.linspace(0.0, 1.0, count).tolist()
    places = [locate_alone(movers, pieces, 0.0, share)[:2] for share in shares]
    least = START_DISTANCE + radius + start.radius + mover.radius
    return min(math.dist(place, (start.x, start.y)) for place in places) >= least


def add_walkers(
    world: World, count: int, rng: np.random.Generator, difficulty: float, radius: float
) -> World:
    """Add people who walk there and back, or around, to a world, and react to nobody.

    WorldError where the robot couldn't cross it any more.
    """
    left, low, right, high = world.standing_bounds
    if not world.obstacles:
        left, low = left - OPEN_MARGIN, low - OPEN_MARGIN
        right, high = right + OPEN_MARGIN, high + OPEN_MARGIN
    for number in range(count):
        crowded = _add_walker(world, (left, low, right, high), rng, difficulty, radius)
        if crowded is None:
            fewer = f"at most {number}" if number else "none, or another kind of world"
            raise WorldError(
                f"{world.name}: nobody can cross it among so many walkers: use {fewer}"
            )
        world = crowded
    return world


def _add_walker(
    world: World, area: Box, rng: np.random.Generator, difficulty: float, radius: float
) -> World | None:
    """A world with one more walker; None where it couldn't be crossed any more."""
    with contextlib.suppress(WorldError):
        for _ in range(DRAWS):
            walker = draw_walker(rng, world, [area], difficulty, radius)
            crowded = replace(world, movers=(*world.movers, walker))
            if can_be_crossed(crowded, radius):
                return crowded
    return None


def can_be_crossed(world: World, radius: float) -> bool:
    """Whether a slow robot that knows all motions comes to the goal, in some episodes."""
    start, goal = (world.start.x, world.start.y), (world.goal.x, world.goal.y)
    longest = 20.0 + 2.0 * world.length / CHECK_SPEED
    return all(
        search_time(
            world,
            radius,
            CHECK_SPEED,
            start,
            goal,
            margin=CHECK_MARGIN,
            key=key,
            horizon=longest,
        )
        is not None
        for key in CHECK_KEYS
    )


def make_dynabarn(rng: np.random.Generator, difficulty: float, radius: float) -> World:
    """Make a world like those of DynaBARN, by its generator's rules.

    A. Nair, M. Saeed, X. Xiao et al.: DynaBARN: Benchmarking Metric Ground Navigation in Dynamic
    Environments, SSRR 2022. Cylinders cross a field of 20 x 20 m, which has walls on three sides,
    from border to border along polynomials, and appear again where they began. Between two points
    of its way each has a speed of its own. Number, order and speeds grow with difficulty.
    """
    half, thick = DYNABARN_HALF, DYNABARN_WALL
    walls = [
        make_box(-half, 0.0, thick, 2.0 * half),
        make_box(0.0, half, 2.0 * half, thick),
        make_box(0.0, -half, 2.0 * half, thick),
    ]
    world = World(segments=np.concatenate(walls), start=DYNABARN_START, goal=DYNABARN_GOAL)
    low, high = DYNABARN_COUNTS
    count = round(low + difficulty * (high - low))
    movers = [draw_cylinder(rng, difficulty, radius) for _ in range(count)]
    return replace(world, movers=tuple(movers))


def draw_cylinder(rng: np.random.Generator, difficulty: float, radius: float) -> Mover:
    """Draw one of DynaBARN's cylinders, which doesn't begin near the robot's start or goal."""
    fastest = DYNABARN_EASY_SPEED + difficulty * (DYNABARN_SPEEDS[1] - DYNABARN_EASY_SPEED)
    low, high = DYNABARN_SPREADS
    deviation = low + difficulty * (high - low)
    lowest, highest = DYNABARN_ORDERS
    highest = round(lowest + difficulty * (highest - lowest))
    while True:
        keys = draw_polynomial(rng, int(rng.integers(lowest, highest + 1)))
        mean = rng.uniform(DYNABARN_SPEEDS[0], fastest)
        ends = [(end.x, end.y) for end in (DYNABARN_START, DYNABARN_GOAL)]
        if min(math.dist(keys[0], end) for end in ends) < JUMP_DISTANCE or len(keys) < 3:
            continue
        speeds = np.clip(rng.normal(mean, deviation, len(keys) - 1), DYNABARN_SLOWEST, fastest)
        lengths = np.hypot(*np.diff(keys, axis=0).T)
        times = np.concatenate([[0.0], np.cumsum(lengths / np.round(speeds, 1))])
        whole = float(times[-1])
        mover = follow_keys(times, keys, smooth=True, radius=DYNABARN_RADIUS, spread=whole)
        if mover.top_speed <= OVERSHOOT * fastest and begins_away(mover, DYNABARN_START, radius):
            return mover


def draw_polynomial(rng: np.random.Generator, order: int) -> Floats:
    """Draw points of a polynomial y = p(x) from border to border of DynaBARN's field, (n, 2) [m].

    It goes through random points of whole metres. Its points are those, ten at even x, and where it
    crosses the border.
    """
    half = int(DYNABARN_HALF)
    at = rng.choice(np.arange(-half, half + 1), order + 1, replace=False)
    curve = np.polynomial.Polynomial.fit(at, rng.integers(-half, half + 1, order + 1), order)
    crossings = np.concatenate([(curve - half).roots(), (curve + half).roots()])
    crossings = crossings.real[(np.abs(crossings.imag) < 1e-9) & (np.abs(crossings.real) < half)]
    xs = np.unique(np.concatenate([np.linspace(-half, half, 10), at, crossings]))
    points = np.column_stack([xs, curve(xs)])
    points = points[np.abs(points[:, 1]) <= half + 1e-6]
    kept = [points[0]]
    for point in points[1:-1]:
        if min(math.dist(point, kept[-1]), math.dist(point, points[-1])) >= KEY_SPACING:
            kept.append(point)
    keys = np.array([*kept, points[-1]])
    return keys[::-1] if rng.random() < 0.5 else keys
