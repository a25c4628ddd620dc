"""Worlds that move: crowds, DynaBARN, and walkers in standing worlds."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from samples import samples

from acsar_gym.errors import WorldError
from acsar_gym.worlds import moving, registry
from acsar_gym.worlds.generators import draw_difficulty, generate_world
from acsar_gym.worlds.geometry import point_clearance
from acsar_gym.worlds.movers import PERSON_RADIUS, Repeat
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.time_search import search_time
from acsar_gym.worlds.world import World

CROWDS = ("crowd", "crowd_reacting")
WALKED = (*CROWDS, "clutter+3", "smooth_path+2")
RADIUS = 0.25


def places_of(world: World, times: list[float], share: float = 0.0) -> list[tuple[float, float]]:
    return [mover.position(t, share) for mover in world.movers for t in times]


@samples(4, 40)
@pytest.mark.parametrize("kind", [*WALKED, "dynabarn"])
def test_movers_begin_away_from_the_start(kind: str, count: int) -> None:
    for number, share in itertools.product(range(count), (0.0, 0.3, 1.0)):
        world = generate_world(kind, number, 0.8)
        start = world.start.x, world.start.y
        for mover in world.movers:
            gap = math.dist(mover.position(0.0, share), start) - mover.radius - RADIUS
            assert gap >= moving.START_DISTANCE - moving.BEGIN_SPACING


@samples(4, 40)
@pytest.mark.parametrize("kind", WALKED)
def test_walkers_keep_from_what_stands(kind: str, count: int) -> None:
    for number in range(count):
        world = generate_world(kind, number, 1.0)
        if world.obstacles:
            places = places_of(world, np.arange(0.0, 60.0, 0.1).tolist())
            assert point_clearance(places, world).min() >= PERSON_RADIUS


def test_a_crowd_grows_with_difficulty() -> None:
    easy, hard = ([generate_world("crowd", n, level) for n in range(12)] for level in (0.0, 1.0))
    counts = [sum(len(world.movers) for world in worlds) for worlds in (easy, hard)]
    assert counts[1] > 2 * counts[0]
    speeds = [[m.top_speed for world in worlds for m in world.movers] for worlds in (easy, hard)]
    assert max(speeds[0]) <= moving.EASY_SPEED + 1e-9
    assert moving.EASY_SPEED < max(speeds[1]) <= moving.WALKER_SPEEDS[1] + 1e-9
    assert min(*speeds[0], *speeds[1]) >= moving.WALKER_SPEEDS[0] - 1e-9
    movers = [mover for world in hard for mover in world.movers]
    assert {mover.repeat for mover in movers} == {Repeat.BACK, Repeat.LOOP}
    assert {mover.radius for mover in movers} == {PERSON_RADIUS}


def test_people_react_only_where_the_name_says_so() -> None:
    reacting, blind = {}, {}
    for kind in (*CROWDS, "dynabarn", "clutter+1"):
        movers = [m for n in range(4) for m in generate_world(kind, n, 1.0).movers]
        reacting[kind] = np.mean([mover.reacts for mover in movers])
        blind[kind] = np.mean([not mover.sees_robot for mover in movers])
    assert reacting.pop("crowd_reacting") > 0.6
    assert 0.0 < blind.pop("crowd_reacting") < 0.6
    assert set(reacting.values()) == set(blind.values()) == {0.0}


@samples(3, 60)
@pytest.mark.parametrize("kind", ["crowd", "dynabarn"])
def test_who_knows_all_motions_comes_through(kind: str, count: int) -> None:
    keys = np.random.default_rng(5).uniform(size=count).tolist()
    for number, key in enumerate(keys):
        world = generate_world(kind, number, 1.0)
        ends = ((end.x, end.y) for end in (world.start, world.goal))
        assert search_time(world, RADIUS, 0.5, *ends, key=key, horizon=100.0) is not None


def test_a_world_that_nobody_can_cross_is_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    answers = iter([False, False, True])
    monkeypatch.setattr(moving, "can_be_crossed", lambda world, radius: next(answers))
    second = generate_world("dynabarn", 0, 0.5)
    assert next(answers, None) is None
    monkeypatch.undo()
    first = generate_world("dynabarn", 0, 0.5)
    assert first.movers[0].position(0.0) != second.movers[0].position(0.0)
    monkeypatch.setattr(moving, "can_be_crossed", lambda world, radius: not world.movers)
    monkeypatch.setattr(moving, "DRAWS", 2)
    with pytest.raises(
        WorldError, match=r"clutter\+2 0: nobody can cross it among so many walkers: use none"
    ):
        generate_world("clutter+2", 0, 0.5)


@pytest.mark.parametrize("number", range(3))
def test_cylinders_of_dynabarn_go_from_border_to_border(number: int) -> None:
    world = generate_world("dynabarn", number, 1.0)
    assert len(world.movers) == moving.DYNABARN_COUNTS[1]
    assert (world.start.x, world.start.y, world.goal.x, world.goal.y) == (11.0, 0.0, -9.0, 0.0)
    for mover in world.movers:
        assert (mover.radius, mover.repeat) == (0.5, Repeat.LOOP)
        for time in (0.0, mover.duration - 1e-9):
            place = mover.position(time)
            assert max(map(abs, place)) == pytest.approx(10.0, abs=1e-5)
            assert math.dist(place, (11.0, 0.0)) > 1.5
        assert mover.top_speed <= moving.OVERSHOOT * moving.DYNABARN_SPEEDS[1]
        assert mover.spread == pytest.approx(mover.duration)


@pytest.mark.parametrize("order", range(1, 6))
def test_a_polynomial_goes_through_its_points(order: int) -> None:
    rng = np.random.default_rng(order)
    for _ in range(30):
        keys = moving.draw_polynomial(rng, order)
        assert np.abs(keys).max() <= 10.0 + 1e-5
        assert np.abs(keys[[0, -1]]).max(axis=1) == pytest.approx([10.0, 10.0], abs=1e-5)
        assert (np.diff(keys[:, 0]) > 0.0).all() or (np.diff(keys[:, 0]) < 0.0).all()
        assert np.hypot(*np.diff(keys, axis=0).T)[:-1].min(initial=9.0) >= 0.99 or len(keys) < 3


@pytest.mark.parametrize("kind", ["clutter", "barn"])
def test_walkers_are_added_to_the_same_world(kind: str) -> None:
    alone, walked = (generate_world(name, 3, 0.6) for name in (kind, f"{kind}+4"))
    for field in ("circles", "segments", "path"):
        assert np.array_equal(getattr(alone, field), getattr(walked, field))
    assert (alone.start, alone.goal) == (walked.start, walked.goal)
    assert (len(alone.movers), len(walked.movers)) == (0, 4)
    assert walked.name == f"{kind}+4 3"
    assert draw_difficulty(f"{kind}+4", 3) == draw_difficulty(kind, 3)
    again = generate_world(f"{kind}+4", 3, 0.6)
    assert [m.pieces.tobytes() for m in again.movers] == [m.pieces.tobytes() for m in walked.movers]


def test_names_with_walkers() -> None:
    assert str(Pool.of("barn+12:test")) == "barn+12 0 to 299 (test split)"
    assert registry.parse_name("my.mod:halls+3:5") == registry.WorldsName("my.mod", "halls+3", "5")
    assert registry.add_test_split("clutter+2") == "clutter+2:test"
    assert registry.add_test_split("clutter+2,barn:3") == "clutter+2:test,barn:3"
    for bad in ("clutter+0:2", "clutter+:2", "clutter+100:2", "+3", "clutter+-1"):
        with pytest.raises(WorldError):
            Pool.of(bad)
    with pytest.raises(WorldError, match=r"unknown kind of world 'cluter\+2'"):
        Pool.of("cluter+2:3")


@pytest.mark.parametrize(
    ("source", "moves"), [("clutter:2", False), ("clutter+1:2", True), ("crowd:2", True)]
)
def test_a_pool_says_whether_something_moves(source: str, moves: bool) -> None:
    assert Pool.of(source).moves is moves
    worlds = list(Pool.of(source))
    assert Pool.of([World(), *worlds]).moves is moves
