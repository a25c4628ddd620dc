"""The search in space and time: nobody is touched, and what is blocked is None."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acsar_gym.hashing import hash_sample
from acsar_gym.worlds.geometry import segment_clearance
from acsar_gym.worlds.movers import Mover, Repeat, follow_keys, walk
from acsar_gym.worlds.time_search import TIME_STEP, search_time
from acsar_gym.worlds.world import Floats, Region, World, make_rectangle

RADIUS, SPEED = 0.3, 0.5
START, GOAL = (-4.0, 0.0), (4.0, 0.0)
ENDS: dict[str, Any] = {"start": Region(*START), "goal": Region(*GOAL)}
HALL = make_rectangle(-5.0, -1.5, 5.0, 1.5)


def find(world: World, **options: object) -> Floats | None:
    return search_time(world, RADIUS, SPEED, START, GOAL, **options)  # type: ignore[arg-type]


def check(path: Floats | None, world: World, key: float = 0.0) -> Floats:
    """The path, after it has been seen to start, to arrive, and to touch nothing."""
    assert path is not None
    assert path[0, 1:].tolist() == list(START)
    assert math.dist(path[-1, 1:], GOAL) <= 0.2 + 1e-9
    lengths = np.hypot(*np.diff(path[:, 1:], axis=0).T)
    assert (lengths <= SPEED * np.diff(path[:, 0]) + 1e-9).all()
    if world.obstacles:
        assert segment_clearance(path[:-1, 1:], path[1:, 1:], world).min() > RADIUS - 0.015
    for number, mover in enumerate(world.movers):
        share = hash_sample(key, number)
        for time in np.arange(path[0, 0], path[-1, 0], 0.05).tolist():
            at = [np.interp(time, path[:, 0], path[:, k]) for k in (1, 2)]
            gap = math.dist(at, mover.position(time, share)) - mover.radius - RADIUS
            assert gap > -0.02 - mover.top_speed * TIME_STEP / 2.0  # it may turn within a step
    return path


def test_where_nobody_is_the_way_is_straight() -> None:
    path = check(find(World(**ENDS)), World(**ENDS))
    assert len(path) == 2
    assert path[-1, 0] == pytest.approx(7.8 / SPEED, abs=0.3)


def test_it_waits_for_who_crosses() -> None:
    gate = np.array([[0.0, -1.5, 0.0, -0.4], [0.0, 0.4, 0.0, 1.5]])
    guard = follow_keys([0.0, 30.0, 31.0], [[0.0, 0.0], [0.0, 0.0], [0.0, 9.0]], repeat=Repeat.STOP)
    world = World(segments=np.concatenate([HALL, gate]), **ENDS, movers=(guard,))
    path = check(find(world), world)
    assert path[-1, 0] > 30.0 + 3.0 / SPEED
    assert find(world, horizon=30.0) is None
    later = find(world, begin=40.0)
    assert later is not None
    assert later[0, 0] == 40.0
    assert later[-1, 0] < 60.0


def test_a_guard_who_stays_is_no_way() -> None:
    gate = np.array([[0.0, -1.5, 0.0, -0.4], [0.0, 0.4, 0.0, 1.5]])
    world = World(segments=np.concatenate([HALL, gate]), **ENDS, movers=(walk([[0.0, 0.0]]),))
    assert find(world) is None
    elsewhere = np.full((601, 1, 2), 3.0)
    assert find(world, places=elsewhere) is not None  # predicted places count, not the motion
    assert find(World(segments=HALL, **ENDS, movers=(walk([[-4.0, 0.4]]),))) is None  # touched


def test_a_jump_sweeps_nothing_in_between() -> None:
    jumper = follow_keys([0.0, 1.0], [[9.0, 9.0], [9.0, 8.0]])
    there = Mover(jumper.pieces, 1.0, repeat=Repeat.LOOP)
    places = np.zeros((601, 1, 2)) + np.where(np.arange(601)[:, None, None] % 2, 9.0, -9.0)
    world = World(**ENDS, movers=(there,))
    assert len(check(find(world), world)) == 2
    path = find(world, places=places)
    assert path is not None
    assert len(path) == 2


def test_a_margin_is_kept_from_movers_alone() -> None:
    world = World(segments=HALL, **ENDS, movers=(walk([[0.0, -0.8]]),))
    near, far = (check(find(world, margin=margin), world) for margin in (0.0, 0.5))
    gaps = [
        -segment_clearance(p[:-1, 1:], p[1:, 1:], World(np.array([[0.0, -0.8, 0.25]]))).min()
        for p in (near, far)
    ]
    assert -gaps[1] >= RADIUS + 0.5 - 0.02 > -gaps[0]


walkers = st.builds(
    lambda a, b, speed, phase: walk([a, b], speed, phase=phase, spread=3.0),
    *[st.tuples(st.floats(-2.5, 4.5), st.floats(-1.2, 1.2))] * 2,
    st.floats(0.2, 2.0),
    st.floats(0.0, 50.0),
)


@settings(max_examples=40, deadline=None)
@given(movers=st.lists(walkers, max_size=6), key=st.floats(0.0, 0.999), begin=st.floats(0.0, 30.0))
def test_nobody_is_touched(movers: list[Mover], key: float, begin: float) -> None:
    world = World(segments=HALL, **ENDS, movers=tuple(movers))
    path = find(world, key=key, begin=begin)
    if path is not None:
        assert path[0, 0] == begin
        check(path, world, key)
    steps = np.arange(601) * TIME_STEP + begin
    places = [
        [mover.position(t, hash_sample(key, n)) for n, mover in enumerate(movers)]
        for t in steps.tolist()
    ]
    again = find(world, places=np.reshape(places, (601, len(movers), 2)), begin=begin)
    assert (path is None) == (again is None)
    if path is not None and again is not None:
        np.testing.assert_allclose(again, path, atol=1e-9)
