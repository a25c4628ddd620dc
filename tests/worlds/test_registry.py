"""Generators that other packages register work wherever those of this package do."""

from __future__ import annotations

import json
from typing import Any

import corridors as example
import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError, WorldError
from acsar_gym.worlds import Region, World, generators, registry
from acsar_gym.worlds.pool import Pool
from acsar_gym.worlds.registry import register
from acsar_gym.worlds.world import make_rectangle

CORRIDORS = registry.REGISTERED.pop("corridors")
"""The example. No other test shall know it."""
WALLS = np.array([[1.0, -1.0, 1.0, -0.2], [1.0, 0.2, 1.0, 1.0], *make_rectangle(-1, -1, 3, 1)])
GAP = World(segments=WALLS, goal=Region(2.0, 0.0))
THROUGH = World(segments=WALLS, path=np.array([[0.0, 0.0], [2.0, 0.0]]))


@pytest.fixture(autouse=True)
def registered(monkeypatch: pytest.MonkeyPatch) -> None:
    """The example is registered. What a test registers is forgotten after it."""
    monkeypatch.setattr(registry, "REGISTERED", {"corridors": CORRIDORS})


def test_register_lets_envs_and_batches_drive_in_a_users_worlds() -> None:
    worlds = "corridors:corridors:3-4"
    env: Any = gymnasium.make("acsar_gym/ObstacleGoal-v1", link="planar", worlds=worlds)
    batch: Any = gymnasium.make_vec(
        "acsar_gym/ObstacleGoal-v1", 4, vectorization_mode="vector_entry_point", worlds=worlds
    )
    observation, info = env.reset(seed=3)
    observations, infos = batch.reset(seed=0)
    assert info["world"] == infos["world"][3]
    assert observations[3] == pytest.approx(observation, abs=1e-6)
    assert json.loads(env.spec.to_json())["kwargs"]["worlds"] == worlds
    env.close()
    batch.close()


@pytest.mark.parametrize(
    ("name", "make", "reason"),
    [
        ("corridors", lambda rng, difficulty, radius: GAP, "corridors has a generator"),
        ("clutter", example.corridors, "acsar_gym has a generator"),
        ("a:b", example.corridors, "lower-case"),
        ("mine", lambda rng, difficulty: GAP, "footprint_radius"),
    ],
)
def test_register_refuses_in_one_line(name: Any, make: Any, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason) as caught:
        register(name, make)
    assert "\n" not in str(caught.value)


def test_register_may_replace_a_name_of_the_same_module() -> None:
    register("mine", lambda rng, difficulty, radius: GAP)
    register("mine", lambda rng, difficulty, radius: World(goal=Region(3.0, 0.0)))
    assert Pool.of("mine:1")[0].goal.x == 3.0


def raising(rng: Any, difficulty: float, radius: float) -> World:
    raise KeyError("no\nsuch thing")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (raising, r"'mine' of .*test_registry: raised KeyError: 'no\\nsuch thing'"),
        (lambda rng, difficulty, radius: [GAP], r"returned \[World.*, must return a World"),
        (lambda rng, difficulty, radius: GAP, "^mine: no world .*no way from start to goal"),
        (lambda rng, difficulty, radius: THROUGH, "path passes 0.20 m from an obstacle"),
    ],
)
def test_generate_world_names_a_generator_that_goes_wrong(
    make: Any, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(generators, "MAX_ATTEMPTS", 3)
    register("mine", make)
    with pytest.raises(WorldError, match=message) as caught:
        generators.generate_world("mine", 0, 0.5)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("no_such.module:mine", "can't import no_such.module: .*; install it, or name its folder"),
        ("math:mine:0-9", "importing math registers no 'mine'"),
        ("corridor:5", "unknown kind of world 'corridor'; did you mean 'corridors'"),
    ],
)
def test_pool_names_modules_that_register_nothing(source: str, message: str) -> None:
    with pytest.raises(WorldError, match=message):
        Pool.of(source)
