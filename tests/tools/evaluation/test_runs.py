"""Where a policy is evaluated, and what is told of that."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.resources import hash_modules
from acsar_gym.tools.evaluation import provenance, runs
from acsar_gym.tools.jobs import run_jobs
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import Region, World
from acsar_gym.worlds.movers import walk

OBSTACLES = "acsar_gym/ObstacleGoal-v1"


class Idle(FilePolicy):
    """A policy that stands still."""

    path = Path("nowhere.onnx")
    env_id = OBSTACLES

    def __call__(self, observation: Any) -> Any:
        return np.zeros(2, np.float32)


@pytest.mark.parametrize(
    ("env_id", "asked", "worlds"),
    [
        ("acsar_gym/PointGoal-v0", None, "None"),
        (OBSTACLES, None, "clutter 0 to 199 (test split)"),
        (OBSTACLES, "clutter:train", "clutter 1000 to 1399 (train split)"),
    ],
)
def test_make_env_takes_the_test_split(env_id: str, asked: Any, worlds: str) -> None:
    policy = Idle()
    policy.env_id = env_id
    env = runs.make_env(policy, "planar", None, {"worlds": asked})
    inner: Any = env.unwrapped
    assert str(inner.pool) == worlds
    env.close()


def test_evaluate_policy_records_what_it_was_measured_with() -> None:
    seeds = range(3, 5)
    run = runs.evaluate_policy(Idle(), "planar", None, seeds, worlds="open", goal_tolerance=0.2)
    data = json.loads(json.dumps(run.as_dict(), allow_nan=False))
    header = data["header"]

    assert header["versions"]["onnxruntime"] == metadata.version("onnxruntime")
    policy = {"file": "nowhere.onnx", "sha256": None, "function": None, "env": OBSTACLES}
    assert header["policy"] == policy | {"differences": [], "privileged": False}
    kwargs = {"robot": None, "worlds": "open:test", "goal_tolerance": 0.2}
    assert header["env"] == {"id": OBSTACLES, "kwargs": kwargs, "max_episode_steps": 600}
    assert (header["link"], header["seeds"]) == ("planar", {"first": 3, "last": 4})
    assert header["worlds"]["sets"] == "open 0 to 199 (test split)"

    for number, episode in enumerate(data["per_episode"]):
        assert (episode["seed"], episode["length"]) == (3 + number, 600)
        assert 0 <= episode["world"] < 200
    assert data["episode_return"] == pytest.approx(sum(e.episode_return for e in run.results) / 2)


def hash_parts(**options: Any) -> list[str]:
    """The hashes of worlds and robot in the header of an env."""
    env = gymnasium.make(OBSTACLES, link="planar", **options)
    header = provenance.make_header(env, Idle(), "planar", range(1), {})
    return [header[part]["sha256"] for part in ("worlds", "robot")]


def test_make_header_hashes_worlds_and_robots() -> None:
    worlds, robot = hash_parts(worlds="open:5")
    assert hash_parts(worlds="open:5") == [worlds, robot]
    slow_worlds, slow_robot = hash_parts(worlds="open:5", robot={"max_linear": 0.1})
    assert (slow_worlds == worlds, slow_robot == robot) == (True, False)
    world = World(goal=Region(2.0, 0.0))
    moving = replace(world, movers=[walk([[2.0, 1.0], [3.0, 1.0]])])
    options: list[dict[str, Any]] = [{"worlds": source} for source in ("open:6", world, moving)]
    options.append({"worlds": "open:5", "difficulty": 0.5})
    hashes = {hash_parts(**parts)[0] for parts in options}
    assert len(hashes | {worlds}) == 5


def test_hash_modules_of_files_that_try_imports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Imports that fail are those of an optional module, not an error after all episodes."""
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "broken_package").mkdir()
    (tmp_path / "broken_package" / "__init__.py").write_text("raise RuntimeError\n")
    imports = ("from .gains import GAIN", "import broken_package.gains")
    for number, line in enumerate(imports):
        text = f"try:\n    {line}\nexcept (ImportError, RuntimeError):\n    GAIN = 0.8\n"
        (tmp_path / f"trying_{number}.py").write_text(text)
        assert len(hash_modules(f"trying_{number}")) == 64


ACT = "def act(observation):\n    return 0.5 + 0.1 * float(observation[0]), 0.3\n"


@pytest.fixture
def policy(tmp_path: Path) -> FilePolicy:
    file = tmp_path / "mine.py"
    file.write_text(ACT, encoding="utf-8")
    return runs.load_policy(f"{file}:act", trust=False, env="obstacle_goal")


def test_evaluate_policy_with_two_workers_gives_the_same_results(
    policy: FilePolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Processes aren't started here, but the jobs are pickled all the same."""
    sizes: list[int] = []

    def run_here(function: Any, jobs: Any, *_: Any) -> Any:
        sent = [pickle.loads(pickle.dumps(job)) for job in jobs]  # noqa: S301 - made here
        sizes.extend(len(job.resets) for job in sent)
        return run_jobs(function, sent)

    monkeypatch.setattr(runs, "run_jobs", run_here)
    alone, shared = (
        runs.evaluate_policy(
            policy, "planar", None, range(5, 22), workers=workers, worlds="open", difficulty=0.3
        )
        for workers in (1, 2)
    )
    assert sizes == [2] * 8 + [1]
    assert [run.header.pop("workers") for run in (alone, shared)] == [1, 2]
    assert json.dumps(alone.as_dict()) == json.dumps(shared.as_dict())


def test_evaluate_policy_sends_small_jobs_to_slow_simulations(
    policy: FilePolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C loses the episodes of jobs that aren't finished."""
    sizes: set[int] = set()

    def run_nothing(_function: Any, jobs: Any, *_: Any) -> Any:
        sizes.update(len(job.resets) for job in jobs)
        yield from ()

    monkeypatch.setattr(runs, "run_jobs", run_nothing)
    runs.evaluate_policy(policy, "bullet", None, range(1000), workers=2, worlds="open")
    assert sizes == {10}


@pytest.mark.parametrize(
    ("link", "workers", "options", "message"),
    [
        ("socket://robot:9000", 2, {}, "--link"),
        ("planar", 2, {"record": object()}, "--record"),
        ("planar", 0, {}, "--workers 0: must be 1 to 1,024"),
    ],
)
def test_evaluate_policy_refuses_workers(
    policy: FilePolicy, link: str, workers: int, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        runs.evaluate_policy(policy, link, None, range(4), workers=workers, **options)


def test_send_policy_refuses_code_that_has_changed(policy: FilePolicy) -> None:
    load = pickle.loads(pickle.dumps(runs.send_policy(policy)))  # noqa: S301 - made here
    loaded = load()
    assert (loaded.sha256, loaded.env_id, loaded.function) == (policy.sha256, policy.env_id, "act")
    policy.path.write_text("def act(observation):\n    return 0.0, 0.0\n", encoding="utf-8")
    runs._load_code.cache_clear()
    with pytest.raises(PolicyError, match=f"{policy.path}: changed since it was loaded"):
        load()
