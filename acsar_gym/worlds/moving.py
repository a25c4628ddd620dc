"""Generated worlds that move: crowds in halls, and DynaBARN.

Walkers go there and back, or around, along ways that are free for them. They don't see each other,
as Gazebo's actors don't. People who react do, see `crowd`. Where a motion starts is drawn for each
episode, within its `spread`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise, product
from pathlib import Path
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
from acsar_gym.worlds.world import Floats, Region, Rng, World, make_box, make_rectangle, make_wall

WALKER_MARGIN = 0.05
"""Distance that walkers keep from obstacles, on top of their radius [m]."""
START_DISTANCE = 1.0
"""Least distance from a robot that starts to where movers start, between their discs [m]."""
BEGIN_SPACING = 0.25  # of the places that are looked at for this [m]
PHASE_SPREAD = 6.0
"""A walker's start varies by this time from episode to episode [s]."""
REACTING_SPREAD = 1.5
"""The same in halls with people who react, none of whom may start in another [s]: with a longer
spread there isn't room enough for 20 people."""
WALKER_SPEEDS = (0.3, 1.8)  # slowest of all, fastest at difficulty 1 [m/s]
EASY_SPEED = 0.6  # fastest at difficulty 0 [m/s]
LONGEST_PAUSE = 2.0  # where a walker turns back [s]
SHARE_AROUND = 0.3  # share of walkers who go around, not there and back
SHORTEST_WAY = 2.0  # between two places where a walker stops [m]
DENSITIES = (0.06, 0.25)  # walkers a square metre, at difficulty 0 and 1
WALKER_COUNTS = (2, 20)  # least and most walkers of a hall
REACTING_SHARES = (0.3, 0.9)
"""Share of people who react at difficulty 0 and 1, in worlds with people who react."""
BLIND_SHARES = (0.0, 0.5)
"""Of those, the share who don't see the robot is drawn from this range for each world."""
DRAWS = 50  # ways that are drawn for one mover before the world counts as too crowded
POINT_DRAWS = 16  # places that are drawn for one stop of a way
PHASE_DRAWS = 10  # starts on a way that are drawn, if people may not start in others

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
Place = tuple[float, float]  # x, y [m]
SIGNS = tuple(product((-1.0, 1.0), repeat=2))  # of the four corners of a crossing


REDRAWN = Path(__file__).with_name("redrawn.json")
"""How many draws of a world with this number were refused by the generator's first version, because
a search in space and time found no way through: by generator and radius of the robot [m]. They are
still left out, so that the benchmark's sets stay the same."""


class HallLayout(NamedTuple):
    """Walls around people and a robot."""

    walls: Floats
    """(segments, 4) [m]."""
    areas: list[Box]
    """A walker goes from one of these to another."""
    start: Box
    """Where the robot starts."""
    goal: Box
    """Where its goal is."""
    floors: list[Box]
    """The floor, in parts that don't overlap."""


def blend(limits: tuple[float, float], difficulty: float) -> float:
    """Interpolate between the values at difficulty 0 and 1."""
    low, high = limits
    return low + difficulty * (high - low)


@cache
def count_redraws(kind: str, radius: float) -> dict[str, int]:
    """Return how many draws are left out, by the world's number, see `REDRAWN`."""
    counts: dict[str, int] = json.loads(REDRAWN.read_text()).get(kind, {}).get(f"{radius:.6f}", {})
    return counts


def make_crowd(rng: Rng, difficulty: float, radius: float) -> World:
    """Make a corridor, a crossing, rooms with doors or an open floor, full of walkers.

    Their number and speeds grow with difficulty. None of them reacts to the robot or to others.
    """
    return _make_hall(rng, difficulty, radius, reacting=0.0)


def make_reacting_crowd(rng: Rng, difficulty: float, radius: float) -> World:
    """Make a world as `make_crowd`, but a share of the people, which grows with difficulty, reacts.

    A part of them, drawn for each world, sees other people, but not the robot. No two people
    overlap when an episode starts.
    """
    return _make_hall(rng, difficulty, radius, reacting=blend(REACTING_SHARES, difficulty))


def _make_hall(rng: Rng, difficulty: float, radius: float, reacting: float) -> World:
    """A hall with walkers, of whom a share reacts."""
    draw_hall = (draw_corridor, draw_crossing, draw_doors, draw_open_hall)[int(rng.integers(4))]
    hall = draw_hall(rng, radius)
    ends = [_draw_point(rng, box, radius + WALKER_MARGIN) for box in (hall.start, hall.goal)]
    start = Region(*ends[0], 0.0, rng.uniform(-math.pi, math.pi))
    pillars, boxes = _draw_furniture(rng, hall)
    world = World(pillars, np.concatenate([hall.walls, *boxes]), start, Region(*ends[1]))

    # As many people a square metre as the difficulty asks for, within limits.
    area = sum((max_x - min_x) * (max_y - min_y) for min_x, min_y, max_x, max_y in hall.floors)
    count = round(area * blend(DENSITIES, difficulty))
    count = min(max(count, WALKER_COUNTS[0]), WALKER_COUNTS[1])
    blind = rng.uniform(*BLIND_SHARES)
    movers = []
    taken: list[Place] | None = [] if reacting else None
    for _ in range(count):
        mover = draw_walker(rng, world, hall.areas, difficulty, radius, taken=taken)
        if taken is not None:
            taken += list_starts(mover)

        # Both numbers are always drawn, so that a hall without people who react is the same.
        reacts = bool(rng.random() < reacting)
        sees_robot = bool(rng.random() >= blind)
        movers.append(replace(mover, reacts=reacts, sees_robot=sees_robot or not reacts))
    return replace(world, movers=tuple(movers))


def draw_corridor(rng: Rng, radius: float) -> HallLayout:
    """Draw a corridor of 9 to 12 m along x, through which the robot goes from end to end."""
    # Long enough to meet people, wide enough to pass them.
    length = rng.uniform(9.0, 12.0)
    half = rng.uniform(1.2, 1.8)
    return HallLayout(
        make_rectangle(0.0, -half, length, half),
        areas=[(2.0, -half, 3.5, half), (length - 3.5, -half, length - 0.3, half)],
        start=(0.2, -half, 1.0, half),
        goal=(length - 1.0, -half, length - 0.2, half),
        floors=[(0.0, -half, length, half)],
    )


def draw_crossing(rng: Rng, radius: float) -> HallLayout:
    """Draw two corridors that cross. The robot comes from an arm, and leaves by another."""
    reach = rng.uniform(4.0, 5.5)
    half_x, half_y = rng.uniform(1.1, 1.7, 2).tolist()  # of the corridors along y and along x
    walls = [
        *([x * half_x, y * reach, x * half_x, y * half_y] for x, y in SIGNS),
        *([x * half_x, y * half_y, x * reach, y * half_y] for x, y in SIGNS),
        [-half_x, -reach, half_x, -reach],
        [-half_x, reach, half_x, reach],
        [-reach, -half_y, -reach, half_y],
        [reach, -half_y, reach, half_y],
    ]

    arms = [
        (-reach, -half_y, 1.3 - reach, half_y),
        (reach - 1.3, -half_y, reach, half_y),
        (-half_x, -reach, half_x, 1.3 - reach),
        (-half_x, reach - 1.3, half_x, reach),
    ]
    return HallLayout(
        np.array(walls),
        areas=arms[1:],
        start=arms[0],
        goal=arms[int(rng.integers(1, 4))],
        floors=[
            (-reach, -half_y, reach, half_y),
            (-half_x, -reach, half_x, -half_y),
            (-half_x, half_y, half_x, reach),
        ],
    )


def draw_doors(rng: Rng, radius: float) -> HallLayout:
    """Draw two or three rooms side by side, with a door or two between them."""
    count = int(rng.integers(2, 4))
    height = rng.uniform(4.0, 6.0)
    edges = np.concatenate([[0.0], np.cumsum(rng.uniform(3.0, 4.5, count))]).tolist()
    end = edges[-1]
    walls = [make_rectangle(0.0, 0.0, end, height)]
    for x in edges[1:-1]:
        width = max(rng.uniform(1.0, 1.5), 2.0 * radius + 0.5)

        # A second door only if both fit into their halves of the wall.
        space = height / 2.0 - width
        doors = [rng.uniform(0.3, space)] if space > 0.4 else []
        doors.append(rng.uniform(height / 2.0, height - 0.3 - width))
        if len(doors) > 1 and rng.random() < 0.5:
            doors.pop(int(rng.integers(2)))
        gaps = np.array([[at, at + width] for at in doors])
        walls.append(make_wall((x, 0.0), (x, height), gaps))

    rooms = [(start, 0.0, stop, height) for start, stop in pairwise(edges)]
    return HallLayout(
        np.concatenate(walls),
        areas=rooms,
        start=(0.2, 0.0, 1.2, height),
        goal=(end - 1.2, 0.0, end - 0.2, height),
        floors=rooms,
    )


def draw_open_hall(rng: Rng, radius: float) -> HallLayout:
    """Draw a floor of 7 to 10 m, which people cross in all directions."""
    # Nine fields of which people use all but the middle one.
    width, height = rng.uniform(7.0, 10.0, 2).tolist()
    dx = width / 3.0
    dy = height / 3.0
    border = [(i, j) for i, j in product(range(3), repeat=2) if (i, j) != (1, 1)]
    return HallLayout(
        make_rectangle(0.0, 0.0, width, height),
        areas=[(i * dx, j * dy, (i + 1) * dx, (j + 1) * dy) for i, j in border],
        start=(0.2, 0.2, 1.2, height - 0.2),
        goal=(width - 1.2, 0.2, width - 0.2, height - 0.2),
        floors=[(0.0, 0.0, width, height)],
    )


def _draw_point(rng: Rng, box: Box, margin: float) -> tuple[float, float]:
    """A point of a box, away from its sides."""
    low = np.array(box[:2]) + margin
    high = np.array(box[2:]) - margin
    middle = (low + high) / 2.0
    x, y = rng.uniform(np.minimum(low, middle), np.maximum(high, middle)).tolist()
    return x, y


def _draw_furniture(rng: Rng, hall: HallLayout) -> tuple[Floats, list[Floats]]:
    """Up to four pillars and boxes: circles, and the sides of boxes."""
    circles = []
    boxes = []
    for _ in range(int(rng.integers(0, 5))):
        x, y = _draw_point(rng, hall.floors[int(rng.integers(len(hall.floors)))], 0.0)
        if rng.random() < 0.5:
            circles.append([x, y, rng.uniform(0.1, 0.25)])
        else:
            length, width = rng.uniform(0.2, 0.6, 2).tolist()
            boxes.append(make_box(x, y, length, width, theta=rng.uniform(0.0, math.pi)))
    return np.array(circles).reshape(-1, 3), boxes


def draw_walker(
    rng: Rng,
    world: World,
    areas: list[Box],
    difficulty: float,
    radius: float,
    *,
    taken: Sequence[Place] | None = None,
) -> Mover:
    """Draw a person who walks between areas of a world.

    Args:
        rng: Random numbers.
        world: Obstacles and the robot's start, near which the person doesn't start.
        areas: Boxes in which the person stops.
        difficulty: Difficulty from 0 to 1.
        radius: Radius of the robot [m].
        taken: Places where others may start, whom the person overlaps at the start of no episode.
            None if they may overlap.

    Raises:
        WorldError: No way was found.
    """
    spread = PHASE_SPREAD if taken is None else REACTING_SPREAD
    from_robot = START_DISTANCE + radius + world.start.radius + PERSON_RADIUS
    speed = rng.uniform(WALKER_SPEEDS[0], blend((EASY_SPEED, WALKER_SPEEDS[1]), difficulty))
    for _ in range(DRAWS):
        goes_around = bool(rng.random() < SHARE_AROUND)
        picks = rng.choice(len(areas), 3 if goes_around else 2, replace=len(areas) < 3).tolist()
        try:
            stops = [_draw_stop(rng, world, areas[pick]) for pick in picks]
            ends = [*stops, stops[0]] if goes_around else stops
            ways = [
                shortest_path(world, PERSON_RADIUS + WALKER_MARGIN, start, goal, cuts=0)
                for start, goal in pairwise(ends)
            ]
        except WorldError:
            continue
        if min(map(path_length, ways)) < SHORTEST_WAY:
            continue

        # Pause at the stops, and walk past the corners between them.
        points = np.concatenate([*(way[:-1] for way in ways), ways[-1][-1:]])
        pauses = np.zeros(len(points))
        pauses[np.cumsum([0, *(len(way) - 1 for way in ways)])] = rng.uniform(0.0, LONGEST_PAUSE)
        if goes_around:
            mover = walk(points[:-1], speed, pauses=pauses[:-1].tolist(), repeat=Repeat.LOOP)
        else:
            mover = walk(points, speed, pauses=pauses.tolist(), repeat=Repeat.BACK)

        # Where the walker is when an episode starts: away from the robot and from others.
        for _ in range(1 if taken is None else PHASE_DRAWS):
            phase = rng.uniform(0.0, mover.cycle)
            mover = replace(mover, phase=phase, spread=spread)
            if starts_away(mover, [(world.start.x, world.start.y)], from_robot) and starts_away(
                mover, taken or (), 2.0 * PERSON_RADIUS + BEGIN_SPACING
            ):
                return mover
    raise WorldError("is too crowded for one more walker")


def _draw_stop(rng: Rng, world: World, area: Box) -> Region:
    """A place of an area in which a walker can stand. Raises WorldError if none was found."""
    clear = PERSON_RADIUS + WALKER_MARGIN
    places = [_draw_point(rng, area, clear) for _ in range(POINT_DRAWS)]

    # Always the same number of draws, so that a pillar more doesn't change what follows.
    free = np.flatnonzero(point_clearance(places, world) >= clear)
    if not len(free):
        raise WorldError("is too crowded for one more walker")
    return Region(*places[free[0]])


def list_starts(mover: Mover) -> list[Place]:
    """List places at which a mover may start, at most BEGIN_SPACING apart [m]."""
    count = 2 + math.ceil(mover.spread * mover.top_speed / BEGIN_SPACING)
    ((row,),), (pieces,), _ = make_motions([[mover]])
    shares = np.linspace(0.0, 1.0, count).tolist()
    return [locate_alone(row, pieces, 0.0, share)[:2] for share in shares]


def starts_away(mover: Mover, places: Sequence[Place], distance: float) -> bool:
    """Return whether all `list_starts` of a mover are at least a distance away from places [m]."""
    starts = list_starts(mover)
    return all(math.dist(start, place) >= distance for start in starts for place in places)


def make_dynabarn(rng: Rng, difficulty: float, radius: float) -> World:
    """Make a world like those of DynaBARN, by its generator's rules.

    A. Nair, M. Saeed, X. Xiao et al.: DynaBARN: Benchmarking Metric Ground Navigation in Dynamic
    Environments, SSRR 2022. Cylinders cross a field of 20 x 20 m, which has walls on three sides,
    from border to border along polynomials, and appear again where they started. Between two points
    of its way each has another speed. Number, order and speeds grow with difficulty.
    """
    half = DYNABARN_HALF
    thick = DYNABARN_WALL
    walls = [
        make_box(-half, 0.0, thick, 2.0 * half),
        make_box(0.0, half, 2.0 * half, thick),
        make_box(0.0, -half, 2.0 * half, thick),
    ]
    count = round(blend(DYNABARN_COUNTS, difficulty))
    return World(
        segments=np.concatenate(walls),
        start=DYNABARN_START,
        goal=DYNABARN_GOAL,
        movers=[draw_cylinder(rng, difficulty, radius) for _ in range(count)],
    )


def draw_cylinder(rng: Rng, difficulty: float, radius: float) -> Mover:
    """Draw one of DynaBARN's cylinders, which doesn't start near the robot's start or goal."""
    fastest = blend((DYNABARN_EASY_SPEED, DYNABARN_SPEEDS[1]), difficulty)
    deviation = blend(DYNABARN_SPREADS, difficulty)
    highest = round(blend(DYNABARN_ORDERS, difficulty))
    while True:
        keys = draw_polynomial(rng, int(rng.integers(DYNABARN_ORDERS[0], highest + 1)))
        mean = rng.uniform(DYNABARN_SPEEDS[0], fastest)
        ends = [(end.x, end.y) for end in (DYNABARN_START, DYNABARN_GOAL)]
        if min(math.dist(keys[0], end) for end in ends) < JUMP_DISTANCE or len(keys) < 3:
            continue

        # Each piece of the way has its own speed, in steps of 0.1 m/s.
        speeds = np.clip(rng.normal(mean, deviation, len(keys) - 1), DYNABARN_SLOWEST, fastest)
        lengths = np.hypot(*np.diff(keys, axis=0).T)
        times = np.concatenate([[0.0], np.cumsum(lengths / np.round(speeds, 1))])
        duration = float(times[-1])
        mover = follow_keys(times, keys, smooth=True, radius=DYNABARN_RADIUS, spread=duration)

        # Splines overshoot between their points: draw again if one is much too fast.
        distance = START_DISTANCE + radius + DYNABARN_START.radius + mover.radius
        if mover.top_speed <= OVERSHOOT * fastest and starts_away(mover, ends[:1], distance):
            return mover


def draw_polynomial(rng: Rng, order: int) -> Floats:
    """Draw points of a polynomial y = p(x) from border to border of DynaBARN's field, (n, 2) [m].

    It goes through random points of whole metres. Its points are those, ten at even x, and where it
    crosses the border.
    """
    half = int(DYNABARN_HALF)
    at = rng.choice(np.arange(-half, half + 1), order + 1, replace=False)
    # As many points as the order has coefficients, so the curve goes through all.
    curve = np.polynomial.Polynomial.fit(at, rng.integers(-half, half + 1, order + 1), order)

    # The curve ends where it leaves the field, so these points are among its keys.
    crossings = np.concatenate([(curve - half).roots(), (curve + half).roots()])
    crossings = crossings.real[(np.abs(crossings.imag) < 1e-9) & (np.abs(crossings.real) < half)]
    xs = np.unique(np.concatenate([np.linspace(-half, half, 10), at, crossings]))
    points = np.column_stack([xs, curve(xs)])
    points = points[np.abs(points[:, 1]) <= half + 1e-6]

    # Leave out points that are close together: a spline through them would swing.
    kept = [points[0]]
    for point in points[1:-1]:
        if min(math.dist(point, kept[-1]), math.dist(point, points[-1])) >= KEY_SPACING:
            kept.append(point)
    keys = np.array([*kept, points[-1]])
    return keys[::-1] if rng.random() < 0.5 else keys
