"""People who react, who ran into whom, personal space, and what is measured of a crowd."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
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
Motion = tuple[tuple[float, float, float], tuple[float, float]]
ACSAR = RobotConfig.preset("acsar")
KITE = ACSAR.with_(footprint=[(0.4, 0.0), (0.0, 0.2), (-0.2, 0.0), (0.0, -0.2)])
CONFIGS = pytest.mark.parametrize("config", [ACSAR, KITE], ids=["box", "kite"])
HALF_LENGTH, HALF_WIDTH = (max(abs(end[k]) for end in ACSAR.outline) for k in (0, 1))
AT_ORIGIN: Motion = ((0.0, 0.0, 0.0), (0.0, 0.0))
AWAY: Motion = ((99.0, 99.0, 0.0), (0.0, 0.0))
"""A robot that is nowhere near."""
PERIOD = ACSAR.period


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


# People who react


@pytest.mark.parametrize("key", [0.1, 0.4, 0.9])
@pytest.mark.parametrize("aside", [0.0, 0.02, -0.1])
def test_people_walk_around_a_robot_that_they_see(key: float, aside: float) -> None:
    walker = person((-4.0, aside), (4.0, aside))
    states, crowd = watch([walker], 16.0, ((0.0, 0.0, 0.3), (0.0, 0.0)), key)
    assert crowd.hit == NO_HIT
    assert np.hypot(*states[:, 0, :2].T).min() > 0.25 + 1.4 * HALF_LENGTH
    passed = np.flatnonzero(states[:, 0, 0] > 1.0)[0]
    assert (passed + 1) * PERIOD < 5.0 / 1.34 + 1.5
    assert np.diff(states[:passed, 0, 0]).min() > 0.0
    assert states[-1, 0, :2] == pytest.approx((4.0, aside), abs=0.05)


@pytest.mark.parametrize(
    "walker", [person((-4.0, 0.02), (4.0, 0.02), sees_robot=False), walk([[-4, 0.02], [4, 0.02]])]
)
def test_people_walk_into_a_robot_that_they_do_not_see(walker: Mover) -> None:
    states, crowd = watch([walker], 12.0, AT_ORIGIN)
    assert crowd.hit == PERSON_HIT
    assert np.abs(states[:, 0, 1] - 0.02).max() < 1e-9


@pytest.mark.parametrize("aside", [0.0, 0.05, -0.3])
def test_people_pass_each_other(aside: float) -> None:
    pair = [person((-4.0, 0.0), (4.0, 0.0)), person((4.0, aside), (-4.0, aside))]
    states, _ = watch(pair, 16.0)
    gaps = np.hypot(*(states[:, 0, :2] - states[:, 1, :2]).T) - pair[0].radius - pair[1].radius
    assert gaps.min() > 0.1
    assert (states[500, :, 0] * (1.0, -1.0) > 1.0).all()
    assert states[-1, :, :2] == pytest.approx(np.array([[4.0, 0.0], [-4.0, aside]]), abs=0.05)


def test_people_do_not_walk_through_obstacles() -> None:
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
    for m, mover in enumerate(movers):
        way = np.concatenate([[mover.position(0.0)], states[:, m, :2]])
        assert segment_clearance(way[:-1], way[1:], room).min() > 0.05


# Contacts and personal space


def straight(speed: float, since: float = -1.0) -> Callable[[float], Motion]:
    return lambda time: ((since + speed * time, 0.0, 0.0), (speed, 0.0))


def turning(rate: float) -> Callable[[float], Motion]:
    return lambda time: ((0.0, 0.0, rate * time), (0.0, rate))


ACROSS = walk([[-HALF_LENGTH - 0.5, -0.1], [3.0, -0.1]], 0.5)
CONTACTS: dict[str, tuple[Mover, Any, float]] = {
    "the robot drives into a person at rest": (walk([[0, 0]]), straight(0.5), ROBOT_HIT),
    "a person walks into a robot at rest": (walk([[-2, 0.1], [2, 0.1]]), AT_ORIGIN, PERSON_HIT),
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
def test_hit_by_who_ran_into_whom(name: str) -> None:
    mover, robot, hit = CONTACTS[name]
    assert watch([mover], 4.0, robot)[1].hit == hit


@pytest.mark.parametrize(("gap", "intrusions"), [(0.44, 1), (0.46, 0), (0.1, 1)])
def test_intrusions_count_an_entry_into_personal_space_once(gap: float, intrusions: int) -> None:
    beside = gap + HALF_WIDTH + 0.25
    passing = walk([[-3.0, beside], [3.0, beside]], 1.0)
    _, crowd = watch([passing], 5.9, AT_ORIGIN)
    assert (crowd.intrusions, crowd.hit) == (intrusions, NO_HIT)
    _, crowd = watch([passing, passing], 17.9, AT_ORIGIN)
    assert crowd.intrusions == 6 * intrusions


# What is measured


@CONFIGS
def test_survey_has_the_distance_of_the_nearest_mover(config: RobotConfig) -> None:
    rng = np.random.default_rng(8)
    ends = np.array([*config.outline, config.outline[0]])
    shares = np.linspace(0.0, 1.0, 800)[:, None]
    hull = np.concatenate([a + shares * (b - a) for a, b in itertools.pairwise(ends)])
    for _ in range(40):
        places = rng.uniform(-2, 2, (3, 2))
        x, y, theta = rng.uniform(-1, 1, 3).tolist()
        turn = np.array([[math.cos(theta), math.sin(theta)], [-math.sin(theta), math.cos(theta)]])
        gaps = np.hypot(*(hull @ turn + (x, y) - places[:, None]).T) - 0.3
        crowd = Crowd(World(movers=[walk([place], radius=0.3) for place in places]), config, 0.0)
        nearest, _ = crowd.survey((x, y, theta), (0.0, 0.0))
        assert nearest == pytest.approx(max(gaps.min(), 0.0), abs=2e-5)


@pytest.mark.parametrize(
    ("x", "expected"), [(400.0, (FARTHEST_PERSON, FARTHEST_COLLISION)), (0.1, (0.0, 0.0))]
)
def test_survey_of_a_mover_far_away_and_of_one_that_touches(x: float, expected: Any) -> None:
    crowd = Crowd(World(movers=[walk([[x, 0.0]])]), ACSAR, 0.0)
    assert crowd.survey((0.0, 0.0, 0.0), (0.5, 0.0)) == expected


@given(*[st.floats(-5.0, 5.0)] * 2, *[st.integers(-200, 200).map(lambda n: n / 100.0)] * 2)
def test_time_to_touch_of_two_discs(dx: float, dy: float, vx: float, vy: float) -> None:
    soonest = time_to_touch(dx, dy, vx, vy, 0.6)
    times = np.arange(0.0, 20.0, 0.01)
    gaps = np.hypot(dx + vx * times, dy + vy * times) - 0.6
    assert (gaps[times < soonest] > -1e-6).all()
    if math.isfinite(soonest):
        gap = math.hypot(dx + vx * soonest, dy + vy * soonest) - 0.6
        assert gap == pytest.approx(0.0, abs=1e-6) or (soonest == 0.0 and gap < 0.0)


# Movers that are looked at only when they may be near

TOP_SPEED = 1.2
"""No part of the robots of these tests moves faster [m/s]."""


def drive_anywhere(rng: np.random.Generator, ticks: int) -> list[RobotMotion]:
    """A robot that drives and turns as it likes, and is at rest now and then."""
    blocks = ticks // 50
    forward = rng.uniform(-1, 1, blocks) * TOP_SPEED * rng.integers(0, 2, blocks)
    room = TOP_SPEED - np.abs(forward)
    rate = rng.uniform(-1, 1, blocks) * room / math.hypot(HALF_LENGTH, HALF_WIDTH)
    forward, rate = np.repeat([forward, rate], 50, axis=1)
    theta = np.cumsum(rate * PERIOD)
    cos = np.cos(theta)
    sin = np.sin(theta)
    x, y = rng.uniform(-2, 2, (2, 1)) + np.cumsum(forward * PERIOD * np.array([cos, sin]), axis=1)
    rows = np.array([x, y, cos, sin, forward, rate]).T
    return [RobotMotion(*row) for row in rows.tolist()]


def draw_movers(rng: np.random.Generator) -> list[Mover]:
    """Walkers, a spline, one that jumps, one at rest, and maybe people who react."""
    places = rng.uniform(-4, 4, (8, 2))
    options: dict[str, Any] = {"spread": 6.0, "reacts": bool(rng.random() < 0.3)}
    return [
        *(walk(places[k : k + 2], 0.8, repeat=Repeat(k), **options) for k in range(3)),
        walk(places[3:4] / 2.0),
        follow_keys([0.0, 2.5], places[4:6], spread=1.0),
        follow_keys([0.0, 2.0, 4.0], places[5:8], smooth=True, spread=1.0),
    ]


@CONFIGS
def test_advance_crowd_sees_the_same_if_it_looks_seldom(config: RobotConfig) -> None:
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
