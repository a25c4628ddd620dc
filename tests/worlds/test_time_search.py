"""Crowds and DynaBARN can be crossed, by a search in space and time that touches nobody."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from samples import samples
from time_search import search_time

from acsar_gym.tools.benchmark.scenes import find_sets, read_pool
from acsar_gym.worlds.movers import Repeat, follow_keys, walk
from acsar_gym.worlds.world import Region, World, make_rectangle

RADIUS = 0.3
SPEED = 0.5
HALL = World(
    segments=make_rectangle(-5.0, -1.5, 5.0, 1.5), start=Region(-4.0, 0.0), goal=Region(4.0, 0.0)
)
GATE = dataclasses.replace(
    HALL,
    segments=np.concatenate([HALL.segments, [[0, -1.5, 0, -0.4], [0, 0.4, 0, 1.5]]]),
)


def test_a_guard_who_stays_leaves_no_path() -> None:
    assert search_time(GATE, RADIUS, SPEED) is not None
    assert search_time(dataclasses.replace(GATE, movers=[walk([[0, 0]])]), RADIUS, SPEED) is None


def test_it_waits_for_a_guard_who_leaves() -> None:
    guard = follow_keys([0.0, 30.0, 31.0], [[0.0, 0.0], [0.0, 0.0], [0.0, 9.0]], repeat=Repeat.STOP)
    arrival = search_time(dataclasses.replace(GATE, movers=[guard]), RADIUS, SPEED)
    assert arrival is not None
    assert arrival > 30.0 + 3.0 / SPEED


@samples(1, 40)
@pytest.mark.parametrize("key", [0.1, 0.7])
@pytest.mark.parametrize(("env_id", "name"), [("Crowd-v0", "crowd"), ("DynaBarn-v0", "dynabarn")])
def test_scenes_of_the_benchmark_can_be_crossed(
    env_id: str, name: str, key: float, count: int
) -> None:
    """By a robot that knows all motions, drives at 0.4 m/s, and stays 0.1 m away from movers."""
    for scenes in find_sets(f"acsar_gym/{env_id}"):
        if scenes.source == name:
            pool = read_pool(scenes.worlds or "", None, scenes.robot)
            for number in scenes.numbers[:count]:
                world = pool[number]
                longest = 20.0 + 2.0 * world.length / 0.4
                path = search_time(world, pool.radius, 0.4, margin=0.1, key=key, horizon=longest)
                assert path is not None, (scenes.name, number)
