"""Worlds that move: crowds and DynaBARN."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from samples import samples

from acsar_gym.worlds import moving
from acsar_gym.worlds.generators import generate_world
from acsar_gym.worlds.geometry import point_clearance
from acsar_gym.worlds.movers import PERSON_RADIUS, Repeat

CROWDS = ("crowd", "crowd_reacting")
RADIUS = 0.25


@samples(2, 40)
@pytest.mark.parametrize("kind", [*CROWDS, "dynabarn"])
def test_movers_start_away_from_the_robot(kind: str, count: int) -> None:
    for number, share in itertools.product(range(count), (0.0, 0.3, 1.0)):
        world = generate_world(kind, number, 0.8)
        for mover in world.movers:
            distance = math.dist(mover.position(0.0, share), (world.start.x, world.start.y))
            gap = distance - mover.radius - RADIUS
            assert gap >= moving.START_DISTANCE - moving.BEGIN_SPACING


@samples(2, 60)
def test_people_who_react_never_start_in_others(count: int) -> None:
    """Whatever the draws of both are."""
    for number in range(count):
        world = generate_world("crowd_reacting", number, 1.0)
        starts = [
            np.array([mover.position(0.0, share) for share in np.linspace(0.0, 1.0, 40)])
            for mover in world.movers
        ]
        for first, second in itertools.combinations(starts, 2):
            distances = np.hypot(*(first[:, None] - second).T)
            assert distances.min() > 2.0 * PERSON_RADIUS


@samples(2, 40)
@pytest.mark.parametrize("kind", CROWDS)
def test_walkers_keep_from_obstacles(kind: str, count: int) -> None:
    for number in range(count):
        world = generate_world(kind, number, 1.0)
        times = np.arange(0.0, 60.0, 0.1).tolist()
        places = [mover.position(time) for mover in world.movers for time in times]
        assert point_clearance(places, world).min() >= PERSON_RADIUS


def test_a_crowd_grows_with_difficulty() -> None:
    easy, hard = (
        [mover for number in range(6) for mover in generate_world("crowd", number, level).movers]
        for level in (0.0, 1.0)
    )
    assert len(hard) > 2 * len(easy)
    slowest, fastest = moving.WALKER_SPEEDS
    assert max(mover.top_speed for mover in easy) <= moving.EASY_SPEED + 1e-9
    assert moving.EASY_SPEED < max(mover.top_speed for mover in hard) <= fastest + 1e-9
    assert min(mover.top_speed for mover in easy + hard) >= slowest - 1e-9
    assert {mover.repeat for mover in hard} == {Repeat.BACK, Repeat.LOOP}


@pytest.mark.parametrize("kind", [*CROWDS, "dynabarn"])
def test_people_react_only_in_crowd_reacting(kind: str) -> None:
    movers = [mover for number in range(2) for mover in generate_world(kind, number, 1.0).movers]
    reacting = np.mean([mover.reacts for mover in movers])
    blind = np.mean([not mover.sees_robot for mover in movers])
    if kind == "crowd_reacting":
        assert reacting > 0.6
        assert 0.0 < blind < 0.6
    else:
        assert reacting == blind == 0.0


@pytest.mark.parametrize("number", range(3))
def test_cylinders_of_dynabarn_go_from_border_to_border(number: int) -> None:
    world = generate_world("dynabarn", number, 1.0)
    assert len(world.movers) == moving.DYNABARN_COUNTS[1]
    assert (world.start.x, world.start.y, world.goal.x, world.goal.y) == (11.0, 0.0, -9.0, 0.0)
    for mover in world.movers:
        assert (mover.radius, mover.repeat) == (0.5, Repeat.LOOP)
        for time in (0.0, mover.duration - 1e-9):
            assert max(map(abs, mover.position(time))) == pytest.approx(10.0, abs=1e-5)
        assert mover.top_speed <= moving.OVERSHOOT * moving.DYNABARN_SPEEDS[1]
        assert mover.spread == pytest.approx(mover.duration)
