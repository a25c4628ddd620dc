"""Benchmarks that run: with baselines, interrupted and gone on with, over a port."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

from acsar_gym.errors import AcsarError, CancelledError, ConfigError, WorldError
from acsar_gym.registration import IDS
from acsar_gym.resources import AGENTS
from acsar_gym.tools.benchmark import plan, runner
from acsar_gym.tools.benchmark.cells import CellResult, Store
from acsar_gym.tools.benchmark.plan import BenchmarkJob, BenchmarkPlan
from acsar_gym.tools.benchmark.scenes import SceneSet, find_sets
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episodes import run_episodes

ID = "acsar_gym/PointGoal-v0"
SET = find_sets(ID)[0]
AGENTS_OF_ID = {agent.name: agent for agent in plan.choose_agents([], [ID], None, 1)}


def set_named(name: str) -> SceneSet:
    ids = (f"acsar_gym/{each}" for each in IDS)
    return next(some for each in ids for some in find_sets(each) if some.name == name)


def make_plan(*names: str, **changes: Any) -> BenchmarkPlan:
    """Two scenes of the open floor, planar."""
    some = tuple(AGENTS_OF_ID[name] for name in names or ("turn_drive",))
    return BenchmarkPlan(some, (SET,), **{"links": ("planar",), "count": 2, **changes})


def make_store(folder: Path) -> Store:
    folder.mkdir()
    return Store(folder)


@pytest.mark.parametrize("name", ["turn_drive", "packaged"])
def test_episodes_are_those_of_an_evaluation_with_the_same_seeds(name: str, tmp_path: Path) -> None:
    (result,) = runner.run_plan(make_plan(name), Store(tmp_path))
    agent = AGENTS_OF_ID[name]
    policy = runs.load_policy(agent.policy, trust=False, env=agent.env)
    env = runs.make_env(policy, "planar", None, {})
    episodes = list(run_episodes(env, policy, 2, SET.numbers[0]))
    env.close()
    assert [episode.success for episode in result.episodes] == [True, True]
    for figure in ("path", "energy"):
        theirs = [getattr(episode, figure) for episode in episodes]
        ours = [getattr(episode, figure) for episode in result.episodes]
        assert ours == pytest.approx(theirs, rel=1e-5)
    assert all(0.0 < episode.score < 1.0 for episode in result.episodes)


def test_an_interrupted_benchmark_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Finished cells aren't driven again, and the result is that of one run."""
    wanted = make_plan(conditions=("nominal", "feedback-30", "dropped-2"))
    whole = runner.run_plan(wanted, make_store(tmp_path / "whole"))
    drive, conditions = runner.run_job, []

    def interrupted(job: BenchmarkJob) -> CellResult:
        conditions.append(job.cell.condition)
        if len(conditions) == 3:
            raise KeyboardInterrupt
        return drive(job)

    monkeypatch.setattr(runner, "run_job", interrupted)
    store = make_store(tmp_path / "cut")
    with pytest.raises(CancelledError, match="2 of 3") as caught:
        runner.run_plan(wanted, store)
    assert caught.value.exit_code == 130
    again = runner.run_plan(wanted, store)
    assert conditions == ["nominal", "feedback-30", "dropped-2", "dropped-2"]
    assert untimed(again) == untimed(whole)


def untimed(results: list[CellResult]) -> str:
    """The cells without their times."""
    return repr([(result.cell, result.episodes) for result in results])


def test_an_agent_that_cannot_drive_there_is_refused(tmp_path: Path) -> None:
    wanted = make_plan("pure_pursuit", "turn_drive", count=1)
    refused, driven = runner.run_plan(wanted, Store(tmp_path))
    assert "needs a path" in refused.refused
    assert not refused.episodes
    assert len(driven.episodes) == 1


@pytest.mark.parametrize("name", list(plan.CONDITIONS))
def test_every_condition_can_be_driven(name: str) -> None:
    job = next(make_plan(conditions=(name,), count=1).jobs())
    (episode,) = runner.run_job(job).episodes
    assert episode.seed == SET.numbers[0]


def test_randomization_is_refused_behind_the_port() -> None:
    job = next(make_plan(links=("port",), conditions=("randomization-1",), count=1).jobs())
    assert "physics don't vary" in runner.run_job(job).refused


@pytest.mark.parametrize("error", [ConfigError("disk full"), WorldError("no such folder")])
def test_a_fault_of_this_machine_is_no_refusal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: ConfigError
) -> None:
    """The same command tries again, and drives once it is mended."""

    def fails(*args: Any, **options: Any) -> Any:
        raise error

    with monkeypatch.context() as patched:
        patched.setattr(runs, "make_env", fails)
        with pytest.raises(ConfigError, match=str(error)):
            runner.run_plan(make_plan(), Store(tmp_path))
    (part,) = runner.run_plan(make_plan(), Store(tmp_path))
    assert not part.refused
    assert len(part.episodes) == 2


@pytest.mark.slow
@pytest.mark.parametrize(("scenes", "name"), [("open/acsar", "turn_drive"), ("barn", "dwa")])
def test_over_an_emulated_port(scenes: str, name: str) -> None:
    """The emulator's log says what odometry can't: the path driven, and distances to obstacles."""
    some = set_named(scenes)
    agents = plan.choose_agents([name], [f"acsar_gym/{some.id}"], None, 1)
    job = next(BenchmarkPlan(tuple(agents), (some,), ("port",), port_count=1).jobs())
    (episode,) = runner.run_job(job).episodes
    assert episode.success
    assert episode.driven == pytest.approx(episode.path, rel=0.05)
    assert 0.0 <= episode.odometry_error < 0.05 * episode.driven
    assert (episode.clearance > 0.0) == (scenes == "barn")
    assert 0.0 < episode.spl <= 1.0


def test_what_knows_the_truth_is_privileged_and_drives_where_it_is_named() -> None:
    assert plan.PRIVILEGED not in {agent.kind for agent in AGENTS_OF_ID.values()}
    found = plan.choose_agents(["orca_true", "dwa"], [ID], None, 1)
    assert {agent.name: agent.kind for agent in found} == {
        "orca_true": "privileged",
        "dwa": "baseline",
    }


def test_what_knows_the_truth_is_refused_behind_the_port() -> None:
    agents = plan.choose_agents(["orca_true"], [ID], None, 1)
    (job,) = BenchmarkPlan(tuple(agents), (SET,), ("port",), port_count=1).jobs()
    assert runner.run_job(job).refused.startswith("orca_true: knows what only a simulator does")


def test_what_is_made_for_movers_drives_unnamed_only_where_the_robot_senses_them() -> None:
    ids = ["acsar_gym/ObstacleGoal-v1", "acsar_gym/Crowd-v0"]
    found = {(agent.name, agent.id) for agent in plan.choose_agents([], ids, None, 1)}
    assert {("dwa", "ObstacleGoal-v1"), ("dwa", "Crowd-v0"), ("orca", "Crowd-v0")} < found
    assert ("orca", "ObstacleGoal-v1") not in found
    assert plan.choose_agents(["orca"], ids[:1], None, 1)


def test_trained_seeds_are_found_in_a_folder(tmp_path: Path) -> None:
    policy = (AGENTS / "policies" / "point_goal.onnx").read_bytes()
    for seed in ("0", "seed-3", "1"):
        (tmp_path / "ppo" / seed).mkdir(parents=True)
        (tmp_path / "ppo" / seed / "policy.onnx").write_bytes(policy)
    found = plan.choose_agents(["ppo"], [ID], tmp_path, 2)
    told = [(each.name, each.training_seed, each.env) for each in found]
    assert told == [("ppo", 0, ID), ("ppo", 1, ID)]
    assert not plan.choose_agents(["ppo"], ["acsar_gym/Barn-v1"], tmp_path, 2)


PLANNERS = """
import math


class Planner:
    def __call__(self, seen):
        return 0.8 * max(seen[1], 0.0), math.atan2(seen[2], seen[1])


def act(seen):
    return Planner()(seen)


class Own(Planner):
    env_id = "acsar_gym/PointGoal-v0"
"""


def test_planners_of_ones_own_drive_beside_packaged_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    name = f"mine_{tmp_path.name}"
    Path(f"{name}.py").write_text(PLANNERS)
    shutil.copy(AGENTS / "policies" / "point_goal.onnx", "mine.onnx")
    other = "acsar_gym/PathFollow-v0"
    names = [
        "packaged",
        "turn_drive",
        f"{name}:Planner",
        f"{name}.py:act",
        f"{name}:Own",
        "mine.onnx",
    ]
    found = plan.choose_agents(names, [ID, other], None, 1)
    told = [(each.name, each.kind, each.id) for each in found]
    assert sorted(told) == sorted(
        [
            ("Own", "learned", "PointGoal-v0"),
            ("Planner", "learned", "PathFollow-v0"),
            ("Planner", "learned", "PointGoal-v0"),
            (name, "learned", "PathFollow-v0"),
            (name, "learned", "PointGoal-v0"),
            ("mine", "learned", "PointGoal-v0"),
            ("packaged", "learned", "PathFollow-v0"),
            ("packaged", "learned", "PointGoal-v0"),
            ("turn_drive", "baseline", "PathFollow-v0"),
            ("turn_drive", "baseline", "PointGoal-v0"),
        ]
    )
    some = [each for each in found if each.name in ("Planner", "packaged") and each.env == ID]
    cells = runner.run_plan(
        BenchmarkPlan(tuple(some), (SET,), ("planar",), count=2), make_store(tmp_path / "out")
    )
    assert [(result.cell.agent, len(result.episodes)) for result in cells] == [
        ("packaged", 2),
        ("Planner", 2),
    ]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["none.onnx"], "none.onnx"),
        (["no_such_module:Planner"], "no_such_module"),
        (["barn.onnx"], "--agents barn.onnx: drives on Barn-v1: name it with --env, too"),
        (["turn_drive.py:act", "turn_drive"], "2 of them are called 'turn_drive'"),
        (["turn_drve"], "--agents 'turn_drve'; did you mean 'turn_drive'"),
    ],
)
def test_agents_that_cannot_be_compared_are_one_line(
    names: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(AGENTS / "policies" / "barn.onnx", "barn.onnx")
    Path("turn_drive.py").write_text(PLANNERS)
    with pytest.raises(AcsarError) as error:
        plan.choose_agents(names, [ID], None, 1)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
