"""Fixed sets of scenes: which they are, that none is in two sets, and their hashes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.registration import IDS
from acsar_gym.tools.benchmark import SCENES, SceneSet, scenes
from acsar_gym.tools.evaluation.provenance import hash_world
from acsar_gym.worlds import Region, World, files
from acsar_gym.worlds.movers import walk


@pytest.mark.parametrize(
    "env_id",
    [
        "PointGoal-v0",
        "PathFollow-v0",
        pytest.param("ObstacleGoal-v1", marks=pytest.mark.slow),
        pytest.param("Barn-v1", marks=pytest.mark.slow),
        pytest.param("Crowd-v0", marks=pytest.mark.slow),
        pytest.param("DynaBarn-v0", marks=pytest.mark.slow),
    ],
)
def test_the_scenes_are_those_that_were_recorded(env_id: str) -> None:
    SCENES[env_id].test.check(1000)
    SCENES[env_id].validation.check(64)


EVERY_SET = [some for name in IDS for some in scenes.find_sets(f"acsar_gym/{name}")]


@pytest.mark.parametrize(
    "some",
    [
        pytest.param(
            each,
            id=each.name,
            marks=() if each.id in ("PointGoal-v0", "PathFollow-v0") else pytest.mark.slow,
        )
        for each in EVERY_SET
    ],
)
def test_the_sets_are_those_that_were_recorded(some: SceneSet) -> None:
    assert len(some.blocks) == 10
    some.check(300)


def test_the_sets_that_are_driven() -> None:
    """Robots in the names of sets that have several; their scores; easy worlds for wide robots."""
    found = {some.name: some for some in EVERY_SET}
    names = ["open", "clutter", "clutter-unseen", "barn", "barn-fast", "barn-husky", "barn-unseen"]
    names += ["crowd", "crowd-reacting", "dynabarn", "path"]
    assert list(dict.fromkeys(name.partition("/")[0] for name in found)) == names
    assert {found[f"{name}/jackal"].score for name in names[-4:-1]} == {"completion_time"}
    assert len([name for name in found if name.startswith("clutter-unseen/drawn:")]) == 5
    fast, husky = found["barn-fast"], found["barn-husky"]
    assert (fast.robot, fast.score, fast.config.max_linear) == ("jackal", "barn_score", 2.0)
    assert (husky.score, husky.difficulty, fast.difficulty) == ("barn_score_own", 0.2, None)
    assert found["clutter/husky"].difficulty is None
    assert found["clutter/acsar"].sha256 != found["clutter/husky"].sha256


@pytest.mark.parametrize(
    ("names", "chosen"),
    [
        ((), ["barn", "barn-fast", "barn-husky"]),
        (("barn",), ["barn"]),
        (("barn-fast", "barn"), ["barn-fast", "barn"]),
        (("clutter",), ["clutter/acsar", "clutter/jackal", "clutter/husky"]),
        (("clutter/husky",), ["clutter/husky"]),
    ],
)
def test_sets_are_chosen_by_name(names: tuple[str, ...], chosen: list[str]) -> None:
    envs = [] if names else ["acsar_gym/Barn-v1"]
    found = scenes.choose_sets(envs, names)
    assert [some.name for some in found if "drawn:" not in some.robot] == chosen


def test_robots_of_ones_own_drive_the_same_sets(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    RobotConfig.preset("jackal").save(file)
    found = scenes.find_sets("acsar_gym/Barn-v1", ["jackal", str(file)])
    told = {some.name: some for some in found}
    assert told["barn/jackal"].robot == told["barn-fast"].robot == "jackal"
    before = told["barn-fast/mine"].about
    assert before["robot"] == "mine.yaml"
    assert str(tmp_path) not in str(before)
    RobotConfig.preset("jackal").with_(max_linear=1.0).save(file)
    (one,) = scenes.find_sets("acsar_gym/PointGoal-v0", [str(file)])
    assert one.about["robot_sha256"] != before["robot_sha256"]
    with pytest.raises(ConfigError, match="two of them are mine: rename"):
        scenes.find_sets("acsar_gym/Barn-v1", [str(file), "mine.urdf"])


def test_another_version_of_the_scenes_is_refused() -> None:
    changed = SceneSet("acsar_gym/PathFollow-v0", "test", "smooth_path", range(100_001, 100_101))
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
    others += [replace(world, movers=[walk([[0.0, y], [4.0, y]])]) for y in (1.0, 1.0001)]
    assert len({hash_world(other) for other in others}) == len(others)
    own = hash_world(world)
    assert all(hash_world(other) != own for other in others)
    same = World(np.array([[1.0 + 1e-12, 0.5, 0.1]]), goal=Region(3.0, -1e-12), name="other")
    assert hash_world(same) == own


def test_published_worlds_are_a_set_of_their_own(tmp_path: Path) -> None:
    for number in range(2):
        files.save_world(World(goal=Region(3.0 + number, 0.0)), tmp_path / f"{number}.json")
    own = scenes.find_sets("acsar_gym/Barn-v1")
    found, fast = scenes.published_sets(own, tmp_path)
    assert (found.name, len(found), found.worlds) == ("barn-published", 2, str(tmp_path))
    assert (fast.name, fast.robot, fast.score) == ("barn-fast-published", "jackal", "barn_score")
    found.check(2)
    before = found.sha256
    files.save_world(World(goal=Region(9.0, 0.0)), tmp_path / "2.json")
    scenes.read_pool.cache_clear()
    scenes.hash_scenes.cache_clear()
    assert scenes.published_sets(own, tmp_path)[0].sha256 != before
