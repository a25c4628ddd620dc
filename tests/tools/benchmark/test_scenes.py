"""Fixed sets of scenes: which they are, that none is in two sets, and their hashes."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from acsar_gym.errors import ConfigError
from acsar_gym.tools.benchmark import SCENES, SceneSet, scenes
from acsar_gym.worlds import Region, World, files


@pytest.mark.parametrize("env_id", list(SCENES))
def test_no_scene_is_in_two_sets(env_id: str) -> None:
    sets = SCENES[env_id]
    for one, other in combinations((sets.train, sets.validation, sets.test), 2):
        assert one.numbers[-1] < other.numbers[0] or other.numbers[-1] < one.numbers[0]


@pytest.mark.parametrize(
    "env_id",
    [
        "PointGoal-v0",
        "PathFollow-v0",
        pytest.param("ObstacleGoal-v1", marks=pytest.mark.slow),
        pytest.param("Barn-v1", marks=pytest.mark.slow),
    ],
)
def test_the_scenes_are_those_that_were_recorded(env_id: str) -> None:
    SCENES[env_id].test.check(1000)
    SCENES[env_id].validation.check(64)


def test_another_version_of_the_scenes_is_refused() -> None:
    changed = SceneSet("PathFollow-v0", "test", "smooth_path", range(100_001, 100_101))
    with pytest.raises(ConfigError, match="PathFollow-v0 test") as caught:
        changed.check(1)
    assert "\n" not in str(caught.value)


def test_the_hash_is_of_geometry_start_and_goal() -> None:
    world = World(np.array([[1.0, 0.5, 0.1]]), goal=Region(3.0, 0.0))
    others = [
        World(np.array([[1.0, 0.5, 0.1001]]), goal=Region(3.0, 0.0)),
        World(np.array([[1.0, 0.5, 0.1]]), goal=Region(3.0, 0.1)),
        World(np.array([[1.0, 0.5, 0.1]]), start=Region(0.0, 0.0), goal=Region(3.0, 0.0)),
        World(segments=np.array([[1.0, 0.5, 0.1, 0.0]]), goal=Region(3.0, 0.0)),
    ]
    own = scenes.hash_world(world)
    assert all(scenes.hash_world(other) != own for other in others)
    same = World(np.array([[1.0 + 1e-12, 0.5, 0.1]]), goal=Region(3.0, -1e-12), name="other")
    assert scenes.hash_world(same) == own


def test_published_worlds_are_a_set_of_their_own(tmp_path: Path) -> None:
    for number in range(2):
        files.save_world(World(goal=Region(3.0 + number, 0.0)), tmp_path / f"{number}.json")
    found = scenes.published_scenes("Barn-v1", tmp_path)
    assert (found.name, len(found), found.worlds) == ("published", 2, str(tmp_path))
    found.check(2)
    before = found.sha256
    files.save_world(World(goal=Region(9.0, 0.0)), tmp_path / "2.json")
    scenes.read_pool.cache_clear()
    scenes.hash_scenes.cache_clear()
    assert scenes.published_scenes("Barn-v1", tmp_path).sha256 != before


def test_a_reset_begins_a_scene() -> None:
    assert SCENES["Barn-v1"].test.reset(3) == (100_003, {"world": 100_003})
    assert SCENES["PointGoal-v0"].test.reset(3) == (2**33 + 3, {})
