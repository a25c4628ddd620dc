"""Evaluations in several processes."""

from __future__ import annotations

import json
import pickle
from pathlib import Path
from typing import Any

import pytest

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.tools.evaluation import runs, shards
from acsar_gym.tools.evaluation.runs import EvaluationRun
from acsar_gym.tools.evaluation.shards import PortablePolicy
from acsar_gym.tools.jobs import completed
from acsar_gym.tools.policies import FilePolicy
from acsar_gym.worlds import Region, World, files

pytestmark = pytest.mark.xdist_group(__name__)

SLOW = "def act(observation):\n    return 0.5 + 0.1 * float(observation[0]), 0.3\n"


@pytest.fixture
def policy(tmp_path: Path) -> FilePolicy:
    file = tmp_path / "mine.py"
    file.write_text(SLOW, encoding="utf-8")
    return runs.load_policy(f"{file}:act", trust=False, env="obstacle_goal")


def both(policy: FilePolicy, count: int, **options: Any) -> list[EvaluationRun]:
    """The same evaluation in one process and in two."""
    seeds = range(5, 5 + count)
    return [
        shards.evaluate_in_parallel(policy, "planar", None, seeds, workers=workers, **options)
        for workers in (1, 2)
    ]


def here(function: Any, jobs: list[Any], **_: Any) -> Any:
    """Run jobs in this process after they were pickled: faster than starting others."""
    return completed(function, [pickle.loads(pickle.dumps(job)) for job in jobs])  # noqa: S301


@pytest.mark.parametrize("started", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_two_processes_give_the_results_of_one(
    policy: FilePolicy, monkeypatch: pytest.MonkeyPatch, started: bool
) -> None:
    if not started:
        monkeypatch.setattr(shards, "completed", here)
    one, two = both(policy, 4, worlds="open", difficulty=0.3)
    assert repr(one.results) == repr(two.results)
    assert one.worlds == two.worlds
    assert [done.header.pop("workers") for done in (one, two)] == [1, 2]
    assert json.dumps(one.as_dict()) == json.dumps(two.as_dict())


def test_worlds_of_a_file_are_sent_and_keep_their_order(
    policy: FilePolicy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[Any] = []

    def noticed(function: Any, jobs: list[Any], **_: Any) -> Any:
        sent.extend(jobs)
        return here(function, jobs)

    monkeypatch.setattr(shards, "completed", noticed)
    folder = tmp_path / "worlds"
    folder.mkdir()
    for number in range(3):
        files.save_world(World(goal=Region(0.8 + 0.1 * number, 0.3)), folder / f"{number}.json")
    one, two = both(policy, 3, worlds=str(folder), how={"in_order": True})
    assert [result.world for result in two.results] == [0, 1, 2]
    assert all(isinstance(world, World) for job in sent for world in job.options["worlds"])
    assert repr(one.results) == repr(two.results)


def test_one_robot_has_one_process(policy: FilePolicy) -> None:
    with pytest.raises(ConfigError, match="--link"):
        shards.evaluate_in_parallel(policy, "socket://robot:9000", None, range(4), workers=2)
    with pytest.raises(ConfigError, match="--record"):
        shards.evaluate_in_parallel(policy, "planar", None, range(4), workers=2, record=object())


def test_a_policy_is_loaded_from_what_was_sent_where_its_file_is_another(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(SLOW, encoding="utf-8")
    sent = PortablePolicy.of(runs.load_policy(f"{file}:act", trust=False, env="point_goal"))
    file.write_text("raise SystemExit('never run')", encoding="utf-8")
    loaded = sent.load()
    assert loaded.sha256 == sent.sha256
    assert loaded.path != file
    assert (loaded.env_id, loaded.function) == ("acsar_gym/PointGoal-v0", "act")


def test_a_policy_that_changed_after_loading_isnt_sent(policy: FilePolicy) -> None:
    policy.path.write_text("# another one", encoding="utf-8")
    with pytest.raises(PolicyError, match=str(policy.path)):
        PortablePolicy.of(policy)


@pytest.mark.parametrize(
    ("count", "workers", "sizes"),
    [(3, 2, [1, 1, 1]), (80, 2, [10] * 8), (41, 2, [5] * 8 + [1]), (25, None, [10, 10, 5])],
)
def test_shards_are_small_enough_for_every_worker(
    count: int, workers: int | None, sizes: list[int]
) -> None:
    parts = shards.split_seeds(range(100, 100 + count), workers)
    assert [len(part) for part in parts] == sizes
    assert [seed for part in parts for seed in part] == list(range(100, 100 + count))
