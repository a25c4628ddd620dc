"""People who react, who ran into whom, personal space, and what is measured of a crowd."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from acsar_gym import RobotConfig
from acsar_gym.worlds import World
from acsar_gym.worlds.crowd import (
    FARTHEST_COLLISION,
    FARTHEST_PERSON,
    LOOK,
    NEAR,
    NO_HIT,
    PERSON_HIT,
    ROBOT_HIT,
    STATE_NUMBERS,
    Crowd,
    RobotMotion,
    advance_crowd,
    begin_crowd,
    place_crowd,
    time_to_touch,
)
from acsar_gym.worlds.geometry import segment_clearance
from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, walk
from acsar_gym.worlds.world import make_rectangle

Floats = NDArray[np.float64]
Pose = tuple[float, float, float]
Motion = tuple[Pose, tuple[float, float]]
ACSAR = RobotConfig.preset("acsar")
KITE = ACSAR.with_(footprint=[(0.4, 0.0), (0.0, 0.2), (-0.2, 0.0), (0.0, -0.2)])
HALF_LENGTH, HALF_WIDTH = (max(abs(end[k]) for end in ACSAR.outline) for k in (0, 1))
AWAY: Motion = ((99.0, 99.0, 0.0), (0.0, 0.0))
"""A robot that is nowhere near."""
PERIOD = ACSAR.period


def standing(pose: Pose) -> Motion:
    return pose, (0.0, 0.0)


def watch(
    movers: Sequence[Mover],
    seconds: float,
    robot: Motion | Callable[[float], Motion] = AWAY,
    key: float = 0.4,
    **world: Any,
) -> tuple[Floats, Crowd]:
    """States of a crowd after each tick, (ticks, movers, STATE_NUMBERS), and the crowd."""
    crowd = Crowd(World(movers=movers, **world), ACSAR, key)
    states = []
    for tick in range(1, round(seconds / PERIOD) + 1):
        crowd.advance(*(robot(tick * PERIOD) if callable(robot) else robot))
        states.append(crowd.states.copy())
    return np.array(states), crowd


def person(*points: tuple[float, float], **options: Any) -> Mover:
    return walk(points, **{"reacts": True, "repeat": Repeat.STOP, **options})


def gaps_between(states: Floats, movers: Sequence[Mover]) -> Floats:
    """Distances of all pairs of hulls after each tick."""
    first, second = np.array(list(itertools.combinations(range(len(movers)), 2))).T
    radii = np.array([mover.radius for mover in movers])
    distances = np.hypot(*np.moveaxis(states[:, first, :2] - states[:, second, :2], -1, 0))
    gaps: Floats = distances - radii[first] - radii[second]
    return gaps


# People who react


@pytest.mark.parametrize("key", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("aside", [0.0, 0.02, -0.1])
def test_people_walk_around_a_robot_that_they_see(key: float, aside: float) -> None:
    walker = person((-4.0, aside), (4.0, aside))
    states, crowd = watch([walker], 16.0, standing((0.0, 0.0, 0.3)), key)
    assert crowd.hit == NO_HIT
    assert np.hypot(*states[:, 0, :2].T).min() > 0.25 + 1.4 * HALF_LENGTH
    passed = np.flatnonzero(states[:, 0, 0] > 1.0)[0]
    assert (passed + 1) * PERIOD < 5.0 / 1.34 + 1.5
    assert np.diff(states[:passed, 0, 0]).min() > 0.0
    assert states[-1, 0, :2] == pytest.approx((4.0, aside), abs=0.05)


@pytest.mark.parametrize("key", [0.1, 0.9])
def test_people_walk_into_a_robot_that_they_do_not_see(key: float) -> None:
    walker = person((-4.0, 0.02), (4.0, 0.02), sees_robot=False)
    states, crowd = watch([walker], 12.0, standing((0.0, 0.0, 0.0)), key)
    assert crowd.hit == PERSON_HIT
    assert np.abs(states[:, 0, 1] - 0.02).max() < 1e-9
    states, crowd = watch([walk([[-4, 0], [4, 0]])], 12.0, standing((0.0, 0.0, 0.0)), key)
    assert crowd.hit == PERSON_HIT


@pytest.mark.parametrize("aside", [0.0, 0.05, -0.3])
def test_two_people_pass_each_other(aside: float) -> None:
    pair = [person((-4.0, 0.0), (4.0, 0.0)), person((4.0, aside), (-4.0, aside))]
    states, _ = watch(pair, 16.0)
    assert gaps_between(states, pair).min() > 0.1
    assert (states[500, :, 0] * (1.0, -1.0) > 1.0).all()
    assert states[-1, :, :2] == pytest.approx(np.array([[4.0, 0.0], [-4.0, aside]]), abs=0.05)


def test_people_do_not_walk_through_what_stands() -> None:
    """Though their motions do: through a wall, a circle, and out of the room."""
    movers = [
        person((-1.5, 0.5), (1.5, -0.5), repeat=Repeat.BACK),
        person((0.7, -1.5), (0.7, 3.0), (-3.0, 1.5), repeat=Repeat.LOOP),
        person((-1.5, -1.5), (1.5, 1.5), repeat=Repeat.BACK, sees_robot=False),
    ]
    circles = np.array([[0.0, 0.0, 0.3], [1.0, 1.0, 0.2]])
    walls = np.concatenate([make_rectangle(-2, -2, 2, 2), [[-1.0, -2.0, -1.0, 1.0]]])
    states, _ = watch(movers, 30.0, circles=circles, segments=walls)
    room = World(circles, walls)
    for m in range(len(movers)):
        way = np.concatenate([[movers[m].position(0.0)], states[:, m, :2]])
        assert segment_clearance(way[:-1], way[1:], room).min() > 0.05


# Who ran into whom


def straight(speed: float, since: float = -1.0) -> Callable[[float], Motion]:
    return lambda time: ((since + speed * time, 0.0, 0.0), (speed, 0.0))


def turning(rate: float) -> Callable[[float], Motion]:
    return lambda time: ((0.0, 0.0, rate * time), (0.0, rate))


ACROSS = walk([[-HALF_LENGTH - 0.5, -0.1], [3.0, -0.1]], 0.5)
CONTACTS: dict[str, tuple[Mover, Any, float]] = {
    "the robot drives into a person who stands": (walk([[0, 0]]), straight(0.5), ROBOT_HIT),
    "a person walks into a robot that stands": (
        walk([[-2.0, 0.1], [2.0, 0.1]]),
        standing((0.0, 0.0, 0.0)),
        PERSON_HIT,
    ),
    "from behind a robot that drives away": (
        walk([[-3.0, 0.0], [9.0, 0.0]], 1.5),
        straight(0.5, 0.0),
        PERSON_HIT,
    ),
    "into a robot that turns away": (ACROSS, turning(0.5), PERSON_HIT),
    "into a robot that turns towards the person": (ACROSS, turning(-1.0), ROBOT_HIT),
    "no contact": (walk([[-3.0, 2.0], [3.0, 2.0]]), turning(1.0), NO_HIT),
}


@pytest.mark.parametrize("name", CONTACTS)
def test_who_ran_into_whom(name: str) -> None:
    mover, robot, hit = CONTACTS[name]
    assert watch([mover], 4.0, robot)[1].hit == hit


# Personal space


@pytest.mark.parametrize(("gap", "intrusions"), [(0.40, 1), (0.44, 1), (0.46, 0), (0.1, 1)])
def test_an_entry_into_personal_space_counts_once(gap: float, intrusions: int) -> None:
    beside = gap + HALF_WIDTH + 0.25
    passing = walk([[-3.0, beside], [3.0, beside]], 1.0)
    _, crowd = watch([passing], 5.9, standing((0.0, 0.0, 0.0)))
    assert (crowd.intrusions, crowd.hit) == (intrusions, NO_HIT)
    _, crowd = watch([passing, passing], 17.9, standing((0.0, 0.0, 0.0)))
    assert crowd.intrusions == 6 * intrusions


# What is measured


@pytest.mark.parametrize("config", [ACSAR, KITE])
def test_the_nearest_mover_is_as_far_as_sampled(config: RobotConfig) -> None:
    rng = np.random.default_rng(8)
    ends = np.array([*config.outline, config.outline[0]])
    shares = np.linspace(0.0, 1.0, 800)[:, None]
    hull = np.concatenate([a + shares * (b - a) for a, b in itertools.pairwise(ends)])
    for _ in range(40):
        movers = [walk([place], radius=0.3) for place in rng.uniform(-2, 2, (3, 2))]
        x, y, theta = rng.uniform(-1, 1, 3).tolist()
        turn = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
        places = np.array([mover.position(0.0) for mover in movers])
        gaps = np.hypot(*(hull @ turn + (x, y) - places[:, None]).T) - 0.3
        crowd = Crowd(World(movers=movers), config, 0.0)
        nearest, _ = crowd.survey((x, y, theta), (0.0, 0.0))
        assert nearest == pytest.approx(max(gaps.min(), 0.0), abs=2e-5)


@given(*[st.floats(-5.0, 5.0)] * 2, *[st.integers(-200, 200).map(lambda n: n / 100.0)] * 2)
def test_time_until_two_discs_touch(dx: float, dy: float, vx: float, vy: float) -> None:
    soonest = time_to_touch(dx, dy, vx, vy, 0.6)
    times = np.arange(0.0, 20.0, 0.01)
    gaps = np.hypot(dx + vx * times, dy + vy * times) - 0.6
    assert (gaps[times < soonest] > -1e-6).all()
    if math.isfinite(soonest):
        gap = math.hypot(dx + vx * soonest, dy + vy * soonest) - 0.6
        assert gap == pytest.approx(0.0, abs=1e-6) or (soonest == 0.0 and gap < 0.0)


def test_a_mover_far_away_and_a_mover_that_touches() -> None:
    crowd = Crowd(World(movers=[walk([[400.0, 0.0]])]), ACSAR, 0.0)
    assert crowd.survey((0.0, 0.0, 0.0), (0.5, 0.0)) == (FARTHEST_PERSON, FARTHEST_COLLISION)
    touching = Crowd(World(movers=[walk([[0.1, 0.0]])]), ACSAR, 0.0)
    assert touching.survey((0.0, 0.0, 0.0), (0.0, 0.0)) == (0.0, 0.0)


# Movers that are looked at only when they may be near


TOP_SPEED = 1.2
"""No part of the robots of these tests moves faster [m/s]."""


def drive_anywhere(rng: np.random.Generator, ticks: int) -> Iterator[RobotMotion]:
    """Poses of a robot that drives and turns as it likes, and stands now and then."""
    x, y, theta = rng.uniform(-2, 2, 3).tolist()
    outer = math.hypot(HALF_LENGTH, HALF_WIDTH)
    for tick in range(ticks):
        if tick % 50 == 0:
            forward = float(rng.uniform(-1, 1) * TOP_SPEED * rng.integers(0, 2))
            rate = float(rng.uniform(-1, 1) * (TOP_SPEED - abs(forward)) / outer)
        theta += rate * PERIOD
        cos = math.cos(theta)
        sin = math.sin(theta)
        x += forward * PERIOD * cos
        y += forward * PERIOD * sin
        yield RobotMotion(x, y, cos=cos, sin=sin, forward=forward, rate=rate)


def draw_movers(rng: np.random.Generator) -> list[Mover]:
    """Walkers, splines, some that jump, some that stand, and maybe people who react."""
    react = rng.random() < 0.3
    walkers = [
        walk(
            rng.uniform(-5, 5, (2, 2)),
            rng.uniform(0.2, 2.5),
            repeat=repeat,
            spread=6.0,
            reacts=react,
        )
        for repeat in Repeat
    ]

    jumper = follow_keys([0.0, 2.5], rng.uniform(-4, 4, (2, 2)), spread=1.0)
    spline = follow_keys([0, 2, 4], rng.uniform(-4, 4, (3, 2)), smooth=True, spread=1.0)
    return [*walkers, walk([rng.uniform(-2, 2, 2)]), jumper, spline]


@pytest.mark.parametrize("config", [ACSAR, KITE])
def test_looking_seldom_sees_the_same(config: RobotConfig) -> None:
    contacts = 0.0
    looks = calls = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        hall = Crowd(World(movers=draw_movers(rng)), config, 0.3).hall
        seldom, always = np.zeros((2, len(hall.movers), STATE_NUMBERS))
        begin_crowd(hall, seldom)
        begin_crowd(hall, always)
        next_look = 0.0

        for tick, robot in enumerate(drive_anywhere(rng, 600), 1):
            expected = advance_crowd(hall, always, tick, robot, np.inf)[:2]
            result = (NO_HIT, 0.0)
            if tick >= next_look:
                scheduled = seldom[:, LOOK].copy()
                hit, entered, next_look = advance_crowd(hall, seldom, tick, robot, TOP_SPEED)
                result = (hit, entered)
                looks += int((seldom[:, LOOK] > scheduled).sum())

            assert result == expected
            contacts += sum(expected)
            if tick % 100 == 0:
                place_crowd(hall, seldom, tick * PERIOD)
                assert np.array_equal(seldom[:, :NEAR], always[:, :NEAR])
        calls += 600 * len(seldom)

    assert contacts > 5.0
    assert looks < 0.3 * calls
