"""People who react, who ran into whom, personal space, and what is measured of a crowd."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from acsar_gym import RobotConfig
from acsar_gym.worlds import World, crowd
from acsar_gym.worlds.crowd import NO_HIT, PERSON_HIT, ROBOT_HIT, Crowd
from acsar_gym.worlds.geometry import point_clearance, segment_clearance
from acsar_gym.worlds.movers import Mover, Repeat, walk
from acsar_gym.worlds.world import make_rectangle

Floats = NDArray[np.float64]
Motion = tuple[tuple[float, float, float], tuple[float, float]]
ACSAR = RobotConfig.preset("acsar")
KITE = ACSAR.with_(footprint=[(0.4, 0.0), (0.0, 0.2), (-0.2, 0.0), (0.0, -0.2)])
HALF_LENGTH, HALF_WIDTH = (max(abs(end[k]) for end in ACSAR.outline) for k in (0, 1))
AT_ORIGIN: Motion = ((0.0, 0.0, 0.0), (0.0, 0.0))
PERIOD = ACSAR.period


def watch(
    movers: Sequence[Mover],
    seconds: float,
    robot: Callable[[float], Motion] = lambda time: AT_ORIGIN,
    key: float = 0.4,
    **world: Any,
) -> tuple[Floats, Crowd]:
    """States of a crowd after each tick, (ticks, movers, STATE_NUMBERS), and the crowd."""
    people = Crowd(World(movers=movers, **world), ACSAR, key)
    states = []
    for tick in range(1, round(seconds / PERIOD) + 1):
        people.advance(*robot(tick * PERIOD))
        states.append(people.states.copy())
    return np.array(states), people


def person(*points: tuple[float, float], **options: Any) -> Mover:
    return walk(points, **{"reacts": True, "repeat": Repeat.STOP, **options})


# People who react


@pytest.mark.parametrize(("key", "aside"), [(0.1, 0.0), (0.4, 0.02), (0.9, -0.1)])
def test_people_walk_around_a_robot_that_they_see(key: float, aside: float) -> None:
    walker = person((-4.0, aside), (4.0, aside))
    states, people = watch([walker], 16.0, key=key)
    assert people.hit == NO_HIT
    assert np.hypot(*states[:, 0, :2].T).min() > 0.25 + 1.4 * HALF_LENGTH
    passed = np.flatnonzero(states[:, 0, 0] > 1.0)[0]
    assert (passed + 1) * PERIOD < 5.0 / 1.34 + 1.5
    assert np.diff(states[:passed, 0, 0]).min() > 0.0
    assert states[-1, 0, :2] == pytest.approx((4.0, aside), abs=0.05)


@pytest.mark.parametrize("options", [{"sees_robot": False}, {"reacts": False}])
def test_people_walk_into_a_robot_that_they_do_not_see(options: dict[str, Any]) -> None:
    states, people = watch([person((-4.0, 0.02), (4.0, 0.02), **options)], 12.0)
    assert people.hit == PERSON_HIT
    assert np.abs(states[:, 0, 1] - 0.02).max() < 1e-9


@pytest.mark.parametrize("aside", [0.0, -0.3])
def test_people_pass_each_other(aside: float) -> None:
    pair = [person((-4.0, 9.0), (4.0, 9.0)), person((4.0, 9.0 + aside), (-4.0, 9.0 + aside))]
    states, _ = watch(pair, 16.0)
    gaps = np.hypot(*(states[:, 0, :2] - states[:, 1, :2]).T) - pair[0].radius - pair[1].radius
    assert gaps.min() > 0.1
    assert (states[500, :, 0] * (1.0, -1.0) > 1.0).all()
    ends = np.array([[4.0, 9.0], [-4.0, 9.0 + aside]])
    assert states[-1, :, :2] == pytest.approx(ends, abs=0.05)


def test_people_do_not_walk_through_obstacles() -> None:
    """Though their motions do: through a wall, a circle, and out of the room."""
    ways: Any = [
        ((-1.5, 0.5), (1.5, -0.5)),
        ((0.7, -1.5), (0.7, 3.0), (-3.0, 1.5)),
        ((-1.5, -1.5), (1.5, 1.5)),
    ]
    movers = [person(*way, repeat=Repeat.BACK, sees_robot=False) for way in ways]
    circles = np.array([[0.0, 0.0, 0.3], [1.0, 1.0, 0.2]])
    walls = np.concatenate([make_rectangle(-2, -2, 2, 2), [[-1.0, -2.0, -1.0, 1.0]]])
    states, _ = watch(movers, 30.0, circles=circles, segments=walls)
    for m, mover in enumerate(movers):
        way = np.concatenate([[mover.position(0.0)], states[:, m, :2]])
        assert segment_clearance(way[:-1], way[1:], World(circles, walls)).min() > 0.05


# Contacts and personal space


def straight(speed: float, since: float = -1.0) -> Callable[[float], Motion]:
    return lambda time: ((since + speed * time, 0.0, 0.0), (speed, 0.0))


def turning(rate: float) -> Callable[[float], Motion]:
    return lambda time: ((0.0, 0.0, rate * time), (0.0, rate))


ACROSS = walk([[-HALF_LENGTH - 0.5, -0.1], [3.0, -0.1]], 0.5)


@pytest.mark.parametrize(
    ("mover", "robot", "hit"),
    [
        (walk([[0, 0]]), straight(0.5), ROBOT_HIT),
        (walk([[-2, 0.1], [2, 0.1]]), turning(0.0), PERSON_HIT),
        (walk([[-3, 0], [9, 0]], 1.5), straight(0.5, 0.0), PERSON_HIT),  # from behind
        (ACROSS, turning(0.5), PERSON_HIT),  # the robot turns away
        (ACROSS, turning(-1.0), ROBOT_HIT),  # the robot turns towards the person
        (walk([[-3, 2], [3, 2]]), turning(1.0), NO_HIT),
    ],
)
def test_hit_by_who_ran_into_whom(mover: Mover, robot: Any, hit: float) -> None:
    assert watch([mover], 4.0, robot)[1].hit == hit


@pytest.mark.parametrize(("gap", "intrusions"), [(0.44, 1), (0.46, 0)])
def test_intrusions_count_an_entry_into_personal_space_once(gap: float, intrusions: int) -> None:
    beside = gap + HALF_WIDTH + 0.25
    passing = walk([[-3.0, beside], [3.0, beside]], 1.0)
    _, people = watch([passing, passing], 17.9)
    assert (people.intrusions, people.hit) == (6 * intrusions, NO_HIT)


def test_advance_crowd_sees_the_same_if_it_looks_seldom() -> None:
    """Movers are looked at only when they may be near a robot that drives along a circle."""
    rng = np.random.default_rng(1)
    places = rng.uniform(-3.0, 3.0, (12, 3, 2))
    movers = [walk(way, 0.8, repeat=Repeat(k % 3)) for k, way in enumerate(places)]
    hall = Crowd(World(movers=movers), ACSAR, 0.3).hall
    seldom, always = np.zeros((2, len(movers), crowd.STATE_NUMBERS))
    for states in (seldom, always):
        crowd.begin_crowd(hall, states)

    contacts = 0.0
    for tick in range(1, 1201):
        angle = 0.5 * tick * PERIOD
        pose = (math.sin(angle), -math.cos(angle), angle)
        robot = crowd.motion_of(pose, (0.5, 0.5))
        expected = crowd.advance_crowd(hall, always, tick, robot, np.inf)[:2]
        assert crowd.advance_crowd(hall, seldom, tick, robot, 0.7)[:2] == expected
        contacts += sum(expected)
    assert contacts > 5.0


# What is measured


@pytest.mark.parametrize("config", [ACSAR, KITE], ids=["box", "kite"])
def test_survey_has_the_distance_of_the_nearest_mover(config: RobotConfig) -> None:
    rng = np.random.default_rng(8)
    corners = np.array(config.outline) @ [1.0, 1.0j]
    for _ in range(40):
        places = rng.uniform(0.4, 2, (3, 2)) * rng.choice([-1, 1], (3, 2))
        x, y, theta = rng.uniform(-0.1, 0.1, 3).tolist()
        hull = x + 1j * y + corners * np.exp(1j * theta)
        ends = np.column_stack([hull.real, hull.imag])
        sides = World(segments=np.hstack([ends, np.roll(ends, -1, axis=0)]))
        people = Crowd(World(movers=[walk([place], radius=0.1) for place in places]), config, 0.0)
        nearest, _ = people.survey((x, y, theta), (0.0, 0.0))
        assert nearest == pytest.approx(point_clearance(places, sides).min() - 0.1)


@pytest.mark.parametrize(
    ("x", "expected"),
    [(400.0, (crowd.FARTHEST_PERSON, crowd.FARTHEST_COLLISION)), (0.1, (0.0, 0.0))],
)
def test_survey_of_a_mover_far_away_and_of_one_that_touches(x: float, expected: Any) -> None:
    people = Crowd(World(movers=[walk([[x, 0.0]])]), ACSAR, 0.0)
    assert people.survey((0.0, 0.0, 0.0), (0.5, 0.0)) == expected


@pytest.mark.parametrize("seed", range(20))
def test_time_to_touch_of_two_discs(seed: int) -> None:
    dx, dy, vx, vy = np.random.default_rng(seed).uniform((-5, -5, -2, -2), (5, 5, 2, 2)).tolist()
    soonest = crowd.time_to_touch(dx, dy, vx, vy, 2.0)
    times = np.append(np.arange(0.0, min(soonest, 20.0), 0.01), soonest)
    gaps = np.hypot(dx + vx * times, dy + vy * times) - 2.0
    assert (gaps[:-1] > -1e-6).all()
    assert gaps[-1] == pytest.approx(0.0, abs=1e-6) or soonest in (0.0, math.inf)
