"""Fixed sets of scenes: which they are, that none is in two sets, and their hashes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.registration import IDS
from acsar_gym.tools.benchmark import SCENES, SceneSet
from acsar_gym.tools.benchmark.scenes import (
    choose_sets,
    find_sets,
    hash_scenes,
    published_sets,
    read_pool,
)
from acsar_gym.tools.evaluation.provenance import hash_world
from acsar_gym.worlds import Region, World, files
from acsar_gym.worlds.movers import walk

SPLITS = [scenes for splits in SCENES.values() for scenes in splits if scenes.split != "train"]
DRIVEN = [scenes for name in IDS for scenes in find_sets(f"acsar_gym/{name}")]


@pytest.mark.parametrize(
    "scenes",
    [
        pytest.param(
            scenes,
            id=f"{scenes.id} {scenes.name}",
            marks=() if scenes.id in ("PointGoal-v0", "PathFollow-v0") else pytest.mark.slow,
        )
        for scenes in (*SPLITS, *DRIVEN)
    ],
)
def test_check_accepts_the_scenes_that_were_recorded(scenes: SceneSet) -> None:
    assert len(scenes.blocks) == (1 if scenes.split == "validation" else 10)
    scenes.check(min(300 if scenes in DRIVEN else 1000, len(scenes)))


def test_find_sets_of_this_package() -> None:
    """Robots in the names of sets that have several, scores, easy worlds for wide robots."""
    sets = {scenes.name: scenes for scenes in DRIVEN}
    assert len(sets) == 28
    assert {"clutter-unseen/drawn:2004", "crowd-reacting/jackal", "dynabarn/jackal"} < set(sets)
    chosen = [(s.robot, s.score, s.difficulty) for s in (sets["barn-fast"], sets["barn-husky"])]
    assert chosen == [("jackal", "barn_score", None), ("husky", "barn_score_own", 0.2)]
    assert sets["path/acsar"].resets[1] == (100_001, {"world": 100_001})
    assert sets["open/acsar"].resets[1] == (2**33 + 1, {})


@pytest.mark.parametrize(
    ("envs", "names", "chosen"),
    [
        (["barn"], (), ["barn", "barn-fast", "barn-husky"]),
        ([], (), ["crowd/acsar", "crowd/jackal", "barn-fast"]),
        ([], ("clutter", "clutter/husky"), ["clutter/acsar", "clutter/jackal", "clutter/husky"]),
    ],
)
def test_choose_sets(envs: list[str], names: tuple[str, ...], chosen: list[str]) -> None:
    sets = choose_sets(envs, names)
    assert [scenes.name for scenes in sets if "drawn:" not in scenes.robot] == chosen
    with pytest.raises(ConfigError, match=r"--sets .barn-slow.*barn"):
        choose_sets(envs, ["barn-slow"])


def test_find_sets_takes_robots_of_a_user(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    RobotConfig.preset("jackal").save(file)
    sets = {s.name: s for s in find_sets("acsar_gym/Barn-v1", ["jackal", str(file)])}
    assert sets["barn/jackal"].robot == "jackal"
    about = sets["barn-fast/mine"].about
    assert (about["robot"], str(tmp_path) in str(about)) == ("mine.yaml", False)
    RobotConfig.preset("jackal").with_(max_linear=1.0).save(file)
    (changed,) = find_sets("acsar_gym/PointGoal-v0", [str(file)])
    assert changed.about["robot_sha256"] != about["robot_sha256"]
    with pytest.raises(ConfigError, match="two of them are mine: rename"):
        find_sets("acsar_gym/Barn-v1", [str(file), "mine.urdf"])


def test_check_refuses_another_version() -> None:
    changed = SceneSet("acsar_gym/PathFollow-v0", "test", "smooth_path", range(100_001, 100_101))
    with pytest.raises(ConfigError, match=r"PathFollow-v0 test .* from 100001 on"):
        changed.check(1)
    with pytest.raises(ConfigError, match="has 100 scenes, 101 were asked for"):
        changed.check(101)


def test_hash_world_depends_on_geometry_start_and_goal() -> None:
    circles = np.array([[1.0, 0.5, 0.1]])
    world = World(circles, goal=Region(3.0, 0.0))
    changes: list[dict[str, Any]] = [
        {"circles": circles + 0.0001},
        {"goal": Region(3.0, 0.1)},
        {"segments": circles[:, [0, 1, 1, 2]]},
        *({"movers": [walk([[0.0, y], [4.0, y]])]} for y in (1.0, 1.0001)),
    ]
    hashes = {hash_world(replace(world, **change)) for change in (*changes, {})}
    assert len(hashes) == 6
    same = World(circles + 1e-12, goal=Region(3.0, -1e-12), name="other")
    assert hash_world(same) in hashes


def test_published_sets(tmp_path: Path) -> None:
    for number in range(2):
        files.save_world(World(goal=Region(3.0 + number, 0.0)), tmp_path / f"{number}.json")
    packaged = find_sets("acsar_gym/Barn-v1")
    slow, fast = published_sets(packaged, tmp_path)
    assert (slow.name, len(slow), slow.worlds) == ("barn-published", 2, str(tmp_path))
    assert (fast.name, fast.robot, fast.score) == ("barn-fast-published", "jackal", "barn_score")
    slow.check(2)

    # Another world is another set.
    sha256 = slow.sha256
    files.save_world(World(goal=Region(9.0, 0.0)), tmp_path / "2.json")
    read_pool.cache_clear()
    hash_scenes.cache_clear()
    assert published_sets(packaged, tmp_path)[0].sha256 != sha256
