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
    SPEED_SHARE,
    STATE_NUMBERS,
    Crowd,
    RobotMotion,
    advance_crowd,
    begin_crowd,
    hall_alone,
    place_crowd,
    time_to_touch,
)
from acsar_gym.worlds.geometry import Obstacles, make_surroundings, segment_clearance
from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, make_motions, walk
from acsar_gym.worlds.world import make_rectangle, make_wall

Floats = NDArray[np.float64]
Pose = tuple[float, float, float]
Motion = tuple[Pose, tuple[float, float]]
ACSAR = RobotConfig.preset("acsar")
POINTED = ACSAR.with_(
    footprint=[(0.4, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.4, -0.2), (0.5, 0.0)],
)
"""Whose footprint has a bay in front."""
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
    pairs = list(itertools.combinations(range(len(movers)), 2))
    one, other = np.array(pairs).T
    radii = np.array([mover.radius for mover in movers])
    apart = np.hypot(*np.moveaxis(states[:, one, :2] - states[:, other, :2], -1, 0))
    gaps: Floats = apart - radii[one] - radii[other]
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


def test_people_go_around_those_who_do_not_react() -> None:
    pair = [person((-4.0, 0.0), (4.0, 0.0)), walk([[0.5, 0.02]], radius=0.4)]
    states, _ = watch(pair, 16.0)
    assert gaps_between(states, pair).min() > 0.0
    assert states[-1, 0, :2] == pytest.approx((4.0, 0.0), abs=0.05)


def test_people_go_on_when_their_way_is_free_again() -> None:
    """Somebody stands where this person rests, until the rest is over."""
    rests = walk([[-3, 0], [0, 0], [3, 0]], 1.0, pauses=[0, 4, 0], reacts=True, repeat=Repeat.STOP)
    states, _ = watch([rests, walk([[0.0, 0.0]])], 16.0)
    assert states[-1, 0, :2] == pytest.approx((3.0, 0.0), abs=0.05)


@pytest.mark.parametrize("aside", [0.0, 0.15, -0.2])
def test_people_go_through_a_door(aside: float) -> None:
    walker = person((-3.0, aside), (3.0, aside))
    wall = make_wall((0.0, -4.0), (0.0, 4.0), np.array([[3.5, 4.5]]))
    states, _ = watch([walker], 12.0, segments=wall)
    assert states[400, 0, 0] > 1.5
    assert states[-1, 0, :2] == pytest.approx((3.0, aside), abs=0.05)


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


CROWDED = [
    person(*np.random.default_rng(k).uniform(-3, 3, (3, 2)).tolist(), repeat=Repeat.BACK)
    for k in range(12)
]


def test_people_are_never_much_faster_than_they_like() -> None:
    states, _ = watch(CROWDED, 20.0, standing((0.0, 0.0, 0.0)))
    speeds = np.hypot(states[:, :, 2], states[:, :, 3])
    assert speeds.max() <= SPEED_SHARE * 1.34 + 1e-9
    moved = np.hypot(*np.moveaxis(np.diff(states[:, :, :2], axis=0), -1, 0))
    assert moved == pytest.approx(speeds[1:] * PERIOD, abs=1e-12)
    assert np.median(speeds) > 0.5


def test_the_same_key_is_the_same_crowd() -> None:
    first, again, other = (watch(CROWDED, 5.0, key=key)[0] for key in (0.4, 0.4, 0.7))
    assert again.tobytes() == first.tobytes()
    assert np.abs(other - first)[:, :, :2].max() > 0.01


def test_the_last_bits_of_the_robots_pose_change_nobody() -> None:
    """A robot of a batch differs by these from a single one, and crowds are chaotic."""

    def drive(off: float) -> Callable[[float], Motion]:
        return lambda time: (
            (0.3 * math.sin(time) + off, 0.3 * math.cos(time) - off, -time + off),
            (0.3 + off, -1.0 - off),
        )

    first, again = (watch(CROWDED, 20.0, drive(off))[0] for off in (0.0, 1e-14))
    assert again[:, :, :NEAR].tobytes() == first[:, :, :NEAR].tobytes()
    assert np.abs(watch(CROWDED, 20.0)[0] - first)[:, :, :2].max() > 0.1


# Who ran into whom


def straight(speed: float, since: float = -1.0) -> Callable[[float], Motion]:
    return lambda time: ((since + speed * time, 0.0, 0.0), (speed, 0.0))


def turning(rate: float) -> Callable[[float], Motion]:
    return lambda time: ((0.0, 0.0, rate * time), (0.0, rate))


BESIDE = 0.25 + HALF_WIDTH + 0.03
"""Where a robot that turns on the spot meets one who stands: its corners are farther out."""
CONTACTS: dict[str, tuple[Mover, Any, float]] = {
    "the robot drives into one who stands": (walk([[0.0, 0.0]]), straight(0.5), ROBOT_HIT),
    "backwards": (walk([[-1.5, 0.0]]), straight(-0.5, 0.0), ROBOT_HIT),
    "it turns into one who stands": (walk([[0.0, BESIDE]]), turning(1.0), ROBOT_HIT),
    "somebody walks into a robot that stands": (
        walk([[-2.0, 0.1], [2.0, 0.1]]),
        standing((0.0, 0.0, 0.0)),
        PERSON_HIT,
    ),
    "from the side of a robot that drives on": (
        walk([[0.0, -2.0], [0.0, 2.0]], 1.0),
        straight(0.3, -0.3),
        PERSON_HIT,
    ),
    "both come": (walk([[3.0, 0.0], [-3.0, 0.0]], 1.0), straight(0.5), ROBOT_HIT),
    "from behind a robot that drives away": (
        walk([[-3.0, 0.0], [9.0, 0.0]], 1.5),
        straight(0.5, 0.0),
        PERSON_HIT,
    ),
    "into a robot that turns away": (
        walk([[-HALF_LENGTH - 0.5, -0.1], [3.0, -0.1]], 0.5),
        turning(0.5),
        PERSON_HIT,
    ),
    "into a robot that turns towards": (
        walk([[-HALF_LENGTH - 0.5, -0.1], [3.0, -0.1]], 0.5),
        turning(-1.0),
        ROBOT_HIT,
    ),
    "nobody": (walk([[-3.0, 2.0], [3.0, 2.0]]), turning(1.0), NO_HIT),
}


@pytest.mark.parametrize("name", CONTACTS)
def test_who_ran_into_whom(name: str) -> None:
    mover, robot, hit = CONTACTS[name]
    assert watch([mover], 4.0, robot)[1].hit == hit


def test_the_first_contact_counts() -> None:
    movers = [walk([[0.0, 0.0]]), walk([[-3.0, 0.0], [3.0, 0.0]], 1.5)]
    assert watch(movers, 3.0, straight(0.4))[1].hit == PERSON_HIT
    assert watch(movers, 3.0, straight(0.8))[1].hit == ROBOT_HIT


# Personal space


@pytest.mark.parametrize(("gap", "intrusions"), [(0.40, 1), (0.44, 1), (0.46, 0), (0.1, 1)])
def test_an_entry_into_personal_space_counts_once(gap: float, intrusions: int) -> None:
    beside = gap + HALF_WIDTH + 0.25
    passing = walk([[-3.0, beside], [3.0, beside]], 1.0)
    _, crowd = watch([passing], 5.9, standing((0.0, 0.0, 0.0)))
    assert (crowd.intrusions, crowd.hit) == (intrusions, NO_HIT)
    _, crowd = watch([passing, passing], 17.9, standing((0.0, 0.0, 0.0)))
    assert crowd.intrusions == 6 * intrusions


def test_who_stays_near_is_one_intrusion() -> None:
    near = walk([[0.0, HALF_WIDTH + 0.25 + 0.2]])
    assert watch([near], 5.0, standing((0.0, 0.0, 0.0)))[1].intrusions == 1
    assert (
        watch([near], 5.0, lambda t: ((3.0 * math.sin(t), 0.0, 0.0), (0.0, 0.0)))[1].intrusions == 2
    )


# What is measured


def sample_hull(config: RobotConfig) -> Floats:
    """Places on the outline of a footprint, 1 mm apart, in the base frame."""
    ends = np.array([*config.outline, config.outline[0]])
    shares = np.linspace(0.0, 1.0, 800)[:, None]
    return np.concatenate([a + shares * (b - a) for a, b in itertools.pairwise(ends)])


def lies_within(point: Floats, config: RobotConfig) -> bool:
    """Whether a point of the base frame is within a footprint, by the winding number."""
    off = np.array([*config.outline, config.outline[0]]) - point
    angles = np.unwrap(np.arctan2(off[:, 1], off[:, 0]))
    return bool(abs(angles[-1] - angles[0]) > 3.0)


RADII = 0.1, 0.3, 0.5


@pytest.mark.parametrize("config", [ACSAR, POINTED])
def test_the_closest_one_is_as_far_as_sampled(config: RobotConfig) -> None:
    hull, rng = sample_hull(config), np.random.default_rng(8)
    for _ in range(40):
        movers = [
            walk([p], radius=r) for p, r in zip(rng.uniform(-2, 2, (3, 2)), RADII, strict=True)
        ]
        x, y, theta = rng.uniform(-1, 1, 3).tolist()
        crowd = Crowd(World(movers=movers), config, 0.0)
        closest, _ = crowd.survey((x, y, theta), (0.0, 0.0))
        cos, sin = math.cos(theta), math.sin(theta)
        gaps = []
        for mover in movers:
            dx, dy = np.array(mover.position(0.0)) - (x, y)
            seen = np.array([cos * dx + sin * dy, cos * dy - sin * dx])
            inside = lies_within(seen, config)
            apart = 0.0 if inside else np.hypot(*(hull - seen).T).min()
            gaps.append(max(apart - mover.radius, 0.0))
        assert closest == pytest.approx(min(gaps), abs=2e-5)


@given(*[st.floats(-5.0, 5.0)] * 2, *[st.integers(-200, 200).map(lambda n: n / 100.0)] * 2)
def test_time_until_two_discs_touch(dx: float, dy: float, vx: float, vy: float) -> None:
    both, soonest = 0.6, time_to_touch(dx, dy, vx, vy, 0.6)
    times = np.arange(0.0, 20.0, 0.01)
    apart = np.hypot(dx + vx * times, dy + vy * times) - both
    if math.isfinite(soonest):
        at = math.hypot(dx + vx * soonest, dy + vy * soonest) - both
        assert at == pytest.approx(0.0, abs=1e-6) or (soonest == 0.0 and at < 0.0)
        assert (apart[times < soonest] > -1e-6).all()
    else:
        assert (apart > -1e-6).all()


def test_time_to_collision_is_that_of_the_simulation() -> None:
    """All keep their velocities: the survey of the first moment says when the discs touch."""
    outer = math.hypot(HALF_LENGTH, HALF_WIDTH)
    rng, count = np.random.default_rng(4), 0
    for _ in range(30):
        movers = [walk(rng.uniform(-3, 3, (2, 2)), 0.4, repeat=Repeat.STOP) for _ in "123"]
        speed, theta = 0.5, float(rng.uniform(-3, 3))
        heading = np.array([math.cos(theta), math.sin(theta)])
        crowd = Crowd(World(movers=movers), ACSAR, 0.0)
        _, soonest = crowd.survey((0.0, 0.0, theta), (speed, 0.3))
        shortest = min(mover.duration for mover in movers)
        times = np.arange(0.0, min(shortest, FARTHEST_COLLISION), 1e-3)
        ends = np.array([[mover.position(time) for mover in movers] for time in (0.0, 1e-3)])
        places = ends[0] + times[:, None, None] / 1e-3 * (ends[1] - ends[0])
        apart = np.hypot(*np.moveaxis(places - (speed * times[:, None] * heading)[:, None], -1, 0))
        touching = np.flatnonzero((apart < outer + 0.25).any(axis=1))
        if len(touching):
            assert soonest == pytest.approx(times[touching[0]], abs=2e-3)
            count += 1
        else:
            assert soonest >= times[-1]
    assert count >= 5


def test_nobody_near_is_far() -> None:
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
        x, y = x + forward * PERIOD * math.cos(theta), y + forward * PERIOD * math.sin(theta)
        yield RobotMotion(x, y, math.cos(theta), math.sin(theta), forward, rate)


def draw_movers(rng: np.random.Generator) -> list[Mover]:
    """Walkers, splines, some that jump, some that stand, and maybe people who react."""
    some_react = rng.random() < 0.3
    movers = [
        walk(
            rng.uniform(-5, 5, (rng.integers(1, 4), 2)),
            rng.uniform(0.2, 2.5),
            radius=rng.uniform(0.1, 0.5),
            repeat=Repeat(int(rng.integers(0, 3))),
            spread=6.0,
            reacts=bool(some_react and rng.random() < 0.5),
        )
        for _ in range(5)
    ]
    return [
        *movers,
        follow_keys([0.0, 2.5], rng.uniform(-4, 4, (2, 2)), spread=1.0),
        follow_keys([0.0, 2.0, 4.0], rng.uniform(-4, 4, (3, 2)), smooth=True, spread=1.0),
    ]


@pytest.mark.parametrize("config", [ACSAR, POINTED])
def test_looking_seldom_sees_the_same(config: RobotConfig) -> None:
    around, seen, looks, calls = make_surroundings(Obstacles(), None, 1, config), 0.0, 0, 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        hall = hall_alone(make_motions([draw_movers(rng)]), 0.3, PERIOD, around)
        seldom, always = np.zeros((2, len(hall.movers), STATE_NUMBERS))
        for states in (seldom, always):
            begin_crowd(hall.movers, hall.pieces, states, hall.key)
        look = 0.0
        for tick, robot in enumerate(drive_anywhere(rng, 600), 1):
            expected = advance_crowd(hall, always, tick, robot, np.inf)[:2]
            told = (NO_HIT, 0.0)
            if tick >= look:
                before = seldom[:, LOOK].copy()
                hit, entered, look = advance_crowd(hall, seldom, tick, robot, TOP_SPEED)
                told = hit, entered
                looks += int((seldom[:, LOOK] > before).sum())
            assert told == expected
            seen += sum(expected)
            if tick % 100 == 0:
                place_crowd(hall.movers, hall.pieces, seldom, tick * PERIOD)
                assert np.array_equal(seldom[:, :NEAR], always[:, :NEAR])
        calls += 600 * len(seldom)
    assert seen > 30.0
    assert looks < 0.3 * calls
