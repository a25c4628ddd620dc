"""Where a policy is evaluated, and what is told of that."""

from __future__ import annotations

import hashlib
import json
import pickle
import re
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.resources import AGENTS
from acsar_gym.tools.evaluation import provenance, runs
from acsar_gym.tools.evaluation.runs import EvaluationRun, PortablePolicy
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk

POINT_GOAL = AGENTS / "policies" / "point_goal.onnx"

OBSTACLES = "acsar_gym/ObstacleGoal-v1"


class Idle(FilePolicy):
    """A policy that stands still."""

    path = Path("nowhere.onnx")
    env_id = OBSTACLES

    def __call__(self, observation: Any) -> Any:
        return np.zeros(2, np.float32)


def drive(count: int, seed: int = 3, **options: Any) -> EvaluationRun:
    """Episodes of a policy that stands still, in worlds that are quick to make."""
    return runs.evaluate_policy(Idle(), "planar", None, range(seed, seed + count), **options)


@pytest.mark.parametrize(
    ("env_id", "asked", "worlds"),
    [
        ("acsar_gym/PointGoal-v0", None, "None"),
        (OBSTACLES, None, "clutter 0 to 199 (test split)"),
        ("acsar_gym/Barn-v1", None, "barn 0 to 299 (test split)"),
        ("acsar_gym/PathFollow-v0", None, "smooth_path 0 to 199 (test split)"),
        (OBSTACLES, "rooms:5", "rooms 0 to 4 (test split)"),
        (OBSTACLES, "clutter:train", "clutter 1000 to 1399 (train split)"),
        (OBSTACLES, "clutter:500-599", "clutter 500 to 599"),
    ],
)
def test_policies_are_evaluated_in_the_test_split(env_id: str, asked: Any, worlds: str) -> None:
    policy = Idle()
    policy.env_id, policy.env_named = env_id, True
    env = runs.make_env(policy, "planar", None, {"worlds": asked})
    inner: Any = env.unwrapped
    assert str(inner.pool) == worlds
    env.close()


@pytest.mark.parametrize(("link", "worlds"), [("planar", "clutter 0 to 9"), ("ros2", "none")])
def test_a_real_robot_is_in_no_world(link: str, worlds: str) -> None:
    env: Any = gymnasium.make("acsar_gym/ObstacleGoal-v1", link=link, worlds="clutter:10")
    assert runs.describe_worlds(env.unwrapped).startswith(worlds)


def test_an_evaluation_says_what_it_was_measured_with() -> None:
    run = drive(2, worlds="open", goal_tolerance=0.2)
    data = json.loads(json.dumps(run.as_dict(), allow_nan=False))
    header = data["header"]
    assert header["versions"]["onnxruntime"] == metadata.version("onnxruntime")
    policy = {"file": "nowhere.onnx", "sha256": None, "function": None, "env": OBSTACLES}
    assert header["policy"] == policy | {"differences": [], "privileged": False}
    assert header["env"]["id"] == OBSTACLES
    assert header["env"]["kwargs"] == {"robot": None, "worlds": "open:test", "goal_tolerance": 0.2}
    assert header["env"]["max_episode_steps"] == 600
    assert (header["link"], header["seeds"]) == ("planar", {"first": 3, "last": 4})
    told = {"kind": "open", "split": "test", "first": 0, "last": 199}
    assert told.items() <= header["worlds"].items()
    for part in (header["robot"], header["worlds"]):
        assert re.fullmatch("[0-9a-f]{64}", part["sha256"])
    standing = -sum(0.04 + 0.1 * min((step + 1) / 50, 1.0) for step in range(1, 601))
    for number, episode in enumerate(data["per_episode"]):
        assert (episode["seed"], episode["length"]) == (3 + number, 600)
        assert 0 <= episode["world"] < 200
        assert episode["episode_return"] == pytest.approx(standing)
    assert data["episode_return"] == pytest.approx(standing)


def test_hashes_tell_worlds_and_robots_apart(tmp_path: Path) -> None:
    world = World(np.array([[1.0, 1.0, 0.1]]), goal=Region(2.0, 0.0))
    moved = World(np.array([[1.0, 1.1, 0.1]]), goal=Region(2.0, 0.0))
    kinds: list[dict[str, Any]] = [
        {"worlds": "open:5"},
        {"worlds": "open:6"},
        {"worlds": "open:5", "difficulty": 0.5},
        {"worlds": world},
        {"worlds": moved},
        *({"worlds": replace(world, movers=[walk([[2.0, y], [3.0, y]])])} for y in (1.0, 2.0)),
    ]
    headers = []
    for options in kinds:
        env = gymnasium.make(OBSTACLES, link="planar", **options)
        headers.append(provenance.make_header(env, Idle(), "planar", range(1), {}))
    assert len({header["worlds"]["sha256"] for header in headers}) == len(kinds)
    assert len({header["robot"]["sha256"] for header in headers}) == 1
    env = gymnasium.make(OBSTACLES, link="planar", robot={"max_linear": 0.1})
    other = provenance.make_header(env, Idle(), "planar", range(1), {})
    assert other["robot"] != headers[0]["robot"]


@pytest.mark.parametrize(
    ("name", "source", "function"),
    [
        ("policy.onnx", POINT_GOAL.read_bytes(), None),
        ("mine.py", b"def act(observation):\n    return 0.0, 0.0\n", "act"),
    ],
    ids=["onnx", "python"],
)
def test_the_hash_of_a_policy_is_that_of_what_was_read(
    name: str, source: bytes, function: str | None, tmp_path: Path
) -> None:
    """Though the file is another one by now, or gone."""
    file = tmp_path / name
    file.write_bytes(source)
    path = f"{file}:{function}" if function else str(file)
    policy = runs.load_policy(path, trust=False, env="point_goal")
    file.write_bytes(b"of a later training")
    env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar")
    told = provenance.make_header(env, policy, "planar", range(1), {})["policy"]
    assert (told["function"], told["sha256"]) == (function, hashlib.sha256(source).hexdigest())


def test_worlds_in_order_have_their_own_numbers() -> None:
    run = drive(2, worlds="open:1250-1251", how={"in_order": True})
    assert [episode.world for episode in run.results] == [1250, 1251]
    assert run.header["options"] == {"in_order": True}
    with pytest.raises(ConfigError, match="3 episodes"):
        drive(3, worlds="open:1250-1251", how={"in_order": True})


ACT = "def act(observation):\n    return 0.5 + 0.1 * float(observation[0]), 0.3\n"


@pytest.fixture
def policy(tmp_path: Path) -> FilePolicy:
    file = tmp_path / "mine.py"
    file.write_text(ACT, encoding="utf-8")
    return runs.load_policy(f"{file}:act", trust=False, env="obstacle_goal")


def both(policy: FilePolicy, count: int, **options: Any) -> list[EvaluationRun]:
    """The same evaluation in one process and in two."""
    seeds = range(5, 5 + count)
    return [
        runs.evaluate_policy(policy, "planar", None, seeds, workers=workers, **options)
        for workers in (1, 2)
    ]


@pytest.mark.parametrize("started", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_two_processes_give_the_results_of_one(
    policy: FilePolicy, monkeypatch: pytest.MonkeyPatch, started: bool
) -> None:
    """Where they aren't started, the jobs are pickled all the same."""

    def here(function: Any, jobs: list[Any], **_: Any) -> Any:
        return completed(function, [pickle.loads(pickle.dumps(job)) for job in jobs])  # noqa: S301

    if not started:
        monkeypatch.setattr(runs, "completed", here)
    one, two = both(policy, 4, worlds="open", difficulty=0.3)
    assert repr(one.results) == repr(two.results)
    assert one.worlds == two.worlds
    assert [done.header.pop("workers") for done in (one, two)] == [1, 2]
    assert json.dumps(one.as_dict()) == json.dumps(two.as_dict())


def test_one_robot_has_one_process(policy: FilePolicy) -> None:
    with pytest.raises(ConfigError, match="--link"):
        runs.evaluate_policy(policy, "socket://robot:9000", None, range(4), workers=2)
    with pytest.raises(ConfigError, match="--record"):
        runs.evaluate_policy(policy, "planar", None, range(4), workers=2, record=object())


def test_a_policy_is_loaded_from_what_was_sent_where_its_file_is_another(
    policy: FilePolicy,
) -> None:
    sent = PortablePolicy.of(policy)
    policy.path.write_text("raise SystemExit('never run')", encoding="utf-8")
    loaded = sent.load()
    assert loaded.sha256 == policy.sha256
    assert loaded.path != policy.path
    assert (loaded.env_id, loaded.function) == (policy.env_id, "act")
    with pytest.raises(PolicyError, match=str(policy.path)):
        PortablePolicy.of(policy)  # it changed after it was loaded


@pytest.mark.parametrize(
    ("name", "count", "workers", "sizes"),
    [
        ("turn_drive", 3, 2, [1, 1, 1]),
        ("turn_drive", 80, 2, [10] * 8),
        ("turn_drive", 41, 2, [5] * 8 + [1]),
        ("turn_drive", 25, None, [10, 10, 5]),
        ("point_goal", 400, 2, [50] * 8),  # is driven as a batch
    ],
)
def test_shards_are_small_enough_for_every_worker(
    name: str, count: int, workers: int | None, sizes: list[int]
) -> None:
    policy = runs.load_policy(name, trust=False, env="point_goal")
    seeds = range(100, 100 + count)
    shards = runs._split_evaluation(policy, "planar", None, seeds, {}, workers, {})
    assert [len(shard.seeds) for shard in shards] == sizes
    assert [seed for shard in shards for seed in shard.seeds] == list(seeds)
    assert [shard.skip for shard in shards] == [shard.seeds[0] - 100 for shard in shards]
