"""Benchmarks that run: with baselines and users' agents, interrupted and continued."""

from __future__ import annotations

import json
import math
import shutil
import sys
import uuid
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from policy_tools import relabelled

from acsar_gym.errors import AcsarError, AcsarWarning, CancelledError, ConfigError, PolicyError
from acsar_gym.resources import AGENTS
from acsar_gym.tools.benchmark import plan, runner
from acsar_gym.tools.benchmark.plan import Agent, Cell, Plan, choose_agents
from acsar_gym.tools.benchmark.report import CellResult
from acsar_gym.tools.benchmark.scenes import choose_sets, find_sets
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.metrics import replace_nonfinite

ID = "acsar_gym/PointGoal-v0"
SET = find_sets(ID)[0]


def choose(*names: str, sets: Any = (SET,), trained: Path | None = None) -> list[Agent]:
    return choose_agents(names, sets, trained, seeds=2)


def make_plan(*names: str, **changes: Any) -> Plan:
    """Two scenes of the open floor, planar."""
    options = {"links": ("planar",), "count": 2, **changes}
    return Plan(tuple(choose(*(names or ("turn_drive",)))), (SET,), **options)


def describe(results: Mapping[Cell, CellResult]) -> str:
    """The cells without their times, as JSON has them."""
    return json.dumps([(cell.about, replace_nonfinite(r.episodes)) for cell, r in results.items()])


def test_run_plan_gives_the_episodes_of_an_evaluation(tmp_path: Path) -> None:
    wanted = make_plan("packaged")
    (result,) = runner.run_plan(wanted, tmp_path).values()
    policy = wanted.agents[0].policy
    run = runs.evaluate_policy(policy, "planar", None, SET.numbers[:2])
    assert repr([replace(e, score=math.nan) for e in result.episodes]) == repr(run.results)
    assert all(0.0 < episode.score < 1.0 for episode in result.episodes)


def test_run_plan_continues_an_interrupted_benchmark(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finished cells aren't driven again, and the result is that of one run."""
    wanted = make_plan(conditions=("nominal", "feedback-30", "dropped-2"))
    expected = runner.run_plan(wanted, runner.open_folder(wanted, tmp_path / "whole", None))
    drive = runner.drive_cell
    jobs = []

    def interrupted(job: runs.EpisodeJob) -> CellResult:
        jobs.append(job)
        if len(jobs) == 3:
            raise KeyboardInterrupt
        return drive(job)

    monkeypatch.setattr(runner, "drive_cell", interrupted)
    folder = runner.open_folder(wanted, tmp_path / "cut", None)
    with pytest.raises(CancelledError, match=r"2 of 3 .* --resume") as caught:
        runner.run_plan(wanted, folder)
    assert caught.value.exit_code == 130

    with (folder / runner.CELLS_FILE).open("a", encoding="utf-8") as file:
        # Damaged lines, and another that a full disk cut.
        file.write(f'\n[1]\n{json.dumps(next(wanted.cells()).about)}\n{{"agent": "turn_dr')
    assert runner.open_folder(wanted, None, folder) == folder
    assert describe(runner.run_plan(wanted, folder)) == describe(expected)
    assert describe(runner.run_plan(wanted, folder)) == describe(expected)
    assert len(jobs) == 4


def test_open_folder_makes_the_next_number(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    folders = [runner.open_folder(make_plan(), None, None) for _ in range(2)]
    assert [str(folder) for folder in folders] == ["runs/benchmark/1", "runs/benchmark/2"]
    with pytest.raises(ConfigError, match="isn't empty: name a new folder, or --resume"):
        runner.open_folder(make_plan(), folders[0], None)
    with pytest.raises(
        ConfigError, match=r"--resume .*: scenes\.PointGoal-v0 open/acsar\.count has"
    ):
        runner.open_folder(make_plan(count=3), None, folders[0])


def test_open_folder_with_wrong_scenes_or_a_damaged_plan(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(ConfigError, match="has 1,000 scenes, 1,001 were asked for"):
        runner.open_folder(make_plan(count=1001), folder, None)
    assert not folder.exists()

    runner.open_folder(make_plan(), folder, None)
    (folder / runner.PLAN_FILE).write_text("{")
    with pytest.raises(ConfigError, match=r"--resume .*run: plan\.json: not valid JSON"):
        runner.open_folder(make_plan(), None, folder)


@pytest.mark.parametrize("name", list(plan.CONDITIONS))
def test_drive_cell_drives_under_every_condition(name: str) -> None:
    (cell,) = make_plan(conditions=(name,), count=1).cells()
    (episode,) = runner.drive_cell(cell.job).episodes
    assert episode.seed == SET.numbers[0]


def test_choose_agents_without_names_leaves_out_what_does_not_fit() -> None:
    """Agents for movers drive if the robot senses them, agents that know the truth if named."""
    sets = choose_sets([], ["clutter/acsar", "crowd/acsar"])
    chosen = {f"{agent.name} {agent.env[10:-3]}" for agent in choose(sets=sets)}
    assert {"dwa ObstacleGoal", "dwa Crowd", "orca Crowd"} < chosen
    assert not {"orca ObstacleGoal", "orca_true Crowd"} & chosen
    kinds = {agent.name: agent.kind for agent in choose("orca_true", "dwa")}
    assert kinds == {"orca_true": "privileged", "dwa": "baseline"}


PLANNERS = """
def act(seen):
    return 0.8 * max(seen[1], 0.0), seen[2]


class Planner:
    def __call__(self, seen):
        return act(seen)


class Own(Planner):
    env_id = "acsar_gym/PointGoal-v0"
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of a new module in the current folder."""
    monkeypatch.chdir(tmp_path)
    name = f"planners_{uuid.uuid4().hex}"
    Path(f"{name}.py").write_text(PLANNERS)
    monkeypatch.syspath_prepend(str(tmp_path))
    return name


def test_choose_agents_takes_policies_of_a_user(module: str) -> None:
    sets = [SET, find_sets("acsar_gym/PathFollow-v0")[0]]
    agents = choose(f"{module}:Planner", f"{module}.py:act", "turn_drive", sets=sets)
    names = [name for name in ("Planner", module, "turn_drive") for _ in sets]
    assert [agent.name for agent in agents] == names
    assert [agent.env for agent in agents] == [scenes.env for scenes in sets] * 3

    # Files and classes that name an id, and the first seeds of a folder.
    for file in ("mine.onnx", *(f"trained/ours/seed-{seed}/policy.onnx" for seed in (10, 2, 1))):
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(AGENTS / "policies" / "point_goal.onnx", file)
    named = choose("mine.onnx", f"{module}:Own", "ours", trained=Path("trained"))
    assert [(agent.name, agent.env, agent.training_seed) for agent in named] == [
        ("mine", ID, None),
        ("Own", ID, None),
        ("ours", ID, 1),
        ("ours", ID, 2),
    ]


def test_choose_agents_refuses_trained_policies_of_other_packages(tmp_path: Path) -> None:
    """Without a message their rows would be missing."""
    file = tmp_path / "ours" / "seed-1" / "policy.onnx"
    file.parent.mkdir(parents=True)
    relabelled(file, env="mine/Task-v0")
    with pytest.raises(PolicyError, match=r"made for 'mine/Task-v0', .*name it with --env"):
        choose(trained=tmp_path)


def test_choose_agents_reports_trained_policies_of_other_ids(tmp_path: Path) -> None:
    file = tmp_path / "ours" / "seed-1" / "policy.onnx"
    file.parent.mkdir(parents=True)
    shutil.copy(AGENTS / "policies" / "barn.onnx", file)
    with pytest.warns(AcsarWarning, match="ours has no policy for PointGoal-v0 .*name its --env"):
        assert "ours" not in [agent.name for agent in choose(trained=tmp_path)]


def test_open_folder_hashes_what_an_agent_imports(module: str, tmp_path: Path) -> None:
    source = Path(f"{module}.py").read_text()
    Path(f"{module}_gain.py").write_text("GAIN = 0.8\n")
    Path(f"{module}.py").write_text(f"from {module}_gain import GAIN\n{source}")
    folder = runner.open_folder(make_plan(f"{module}:Planner"), tmp_path / "run", None)
    runner.open_folder(make_plan(f"{module}:Planner"), None, folder)
    Path(f"{module}_gain.py").write_text("GAIN = 0.9\n")
    with pytest.raises(ConfigError, match=r"agents\.Planner has changed"):
        runner.open_folder(make_plan(f"{module}:Planner"), None, folder)
    sys.modules.pop(module)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["barn.onnx"], "--agents barn.onnx: has no policy for PointGoal-v0 of set open/acsar"),
        (["turn_drive.py:act", "turn_drive"], "2 of them are called 'turn_drive'"),
        (["turn_drve"], "--agents 'turn_drve'; did you mean 'turn_drive'"),
    ],
)
def test_choose_agents_refuses_what_cannot_be_compared(
    names: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("barn.onnx").write_bytes((AGENTS / "policies" / "barn.onnx").read_bytes())
    Path("turn_drive.py").write_text(PLANNERS)
    with pytest.raises(AcsarError) as error:
        choose(*names)
    assert message in str(error.value)
    assert error.value.exit_code == 2


def test_run_plan_gives_the_same_results_with_two_workers(module: str, tmp_path: Path) -> None:
    """The same numbers, of a policy in a file, planners and code of a user, or a refusal."""
    wanted = make_plan("packaged", "turn_drive", f"{module}.py:act", "pure_pursuit")
    folders = [runner.open_folder(wanted, tmp_path / name, None) for name in ("1", "2")]
    results = [runner.run_plan(wanted, folders[n], workers=n + 1) for n in range(2)]
    assert describe(results[0]) == describe(results[1])
    *driven, refused = results[1].values()
    assert [len(result.episodes) for result in driven] == [2, 2, 2]
    assert "needs a path" in refused.refused
    assert not refused.episodes
