"""Environments that other packages register (`--env mine.module:mine/Task-v0`), and the recipes."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest
from cli_tools import Call, assert_one_line

pytestmark = pytest.mark.xdist_group(__name__)


ENV = "mine_of_tests.tasks:mine/Ahead-v0"
TASKS = """
from dataclasses import dataclass

import acsar_gym
import gymnasium
from acsar_gym import Outcome, Task


@dataclass(frozen=True)
class Ahead(Task):
    observation = {"ahead": (-2.0, 2.0), "aside": (-2.0, 2.0)}
    goal_distance = (0.5, 1.0)
    memory = {"fastest": 0.0, "own": 0.0}
    told = ("fastest",)
    compiled = True

    def outcome(self, state, memory):
        memory.fastest = max(memory.fastest, state.twist[0])
        gap = (state.goal[0] - state.pose[0], state.goal[1] - state.pose[1])
        return Outcome.SUCCESS if gap[0] ** 2 + gap[1] ** 2 < 0.04 else Outcome.GOING

    def reward(self, state, memory, outcome):
        return state.twist[0]

    def observe(self, state, memory):
        return state.goal[0] - state.pose[0], state.goal[1] - state.pose[1]


class Unsound(Ahead):
    compiled = True

    def reward(self, state, memory, outcome):
        return float("nan") if state.time > 0.1 else 0.0


class Failing(Ahead):
    compiled = True

    def reward(self, state, memory, outcome):
        return state.twist[0] if state.time < 0.3 else 1 / (outcome * 0)


acsar_gym.register("mine/Ahead-v0", task=Ahead, max_episode_steps=20)
acsar_gym.register("mine/Unsound-v0", task=Unsound, max_episode_steps=20)
acsar_gym.register("mine/Failing-v0", task=Failing, max_episode_steps=20)
acsar_gym.register("mine/Endless-v0", task=Ahead)
gymnasium.register(
    "mine/Single-v0",
    "acsar_gym.envs.robot_env:RobotEnv",
    kwargs={"task": Ahead},
    max_episode_steps=20,
)
"""


@pytest.fixture(autouse=True)
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A package of somebody's own, in the current folder, as where a user works."""
    folder = tmp_path / "mine_of_tests"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "tasks.py").write_text(TASKS)
    (folder / "broken.py").write_text("import no_such_thing_at_all")
    (folder / "wrong.py").write_text("raise SystemExit('two\\nlines')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    importlib.invalidate_caches()
    yield
    for name in [name for name in sys.modules if name.startswith("mine_of_tests")]:
        del sys.modules[name]
    for env_id in [env_id for env_id in gymnasium.registry if env_id.startswith("mine/")]:
        del gymnasium.registry[env_id]


@pytest.mark.parametrize(
    ("env", "said"),
    [
        ("no_such_module:mine/Ahead-v0", "No module named 'no_such_module'"),
        ("mine_of_tests.broken:mine/Ahead-v0", "No module named 'no_such_thing_at_all'"),
        ("mine_of_tests.wrong:mine/Ahead-v0", "can't be imported: SystemExit: two lines"),
        ("mine_of_tests.tasks:mine/Astern-v0", "importing mine_of_tests.tasks doesn't register it"),
        ("..relative:mine/Ahead-v0", "can't be imported"),
        ("mine/Ahead-v0", "name the module that registers it, too, as in mine_package:mine/Ahead"),
    ],
)
@pytest.mark.parametrize("command", ["train", "evaluate --link planar", "run 1 0 --link planar"])
def test_an_env_that_is_not_there_is_one_line(
    command: str, env: str, said: str, call: Call
) -> None:
    code, _, error = call(*command.split(), "--env", env)
    assert code == 2
    assert_one_line(error, said)


@pytest.mark.parametrize(
    ("task", "said"),
    [
        ("Unsound", "mine/Unsound-v0.reward returned nan for robot 0: must be a finite number"),
        ("Failing", "mine/Failing-v0: ZeroDivisionError: division by zero, in a compiled"),
    ],
)
def test_a_task_that_fails_in_a_training_is_one_line(task: str, said: str, call: Call) -> None:
    small = ("--steps", "64", "--robots", "4", "--threads", "1", "--net", "8", "--no-progress")
    code, _, error = call("train", "--env", f"mine_of_tests.tasks:mine/{task}-v0", *small)
    assert code == 2
    assert_one_line(error, said)


def test_a_policy_for_it_is_trained_evaluated_driven_and_exported(
    call: Call, tmp_path: Path
) -> None:
    small = ("--steps", "1", "--robots", "4", "--threads", "1", "--net", "8", "--no-progress")
    code, out, error = call("train", "--env", ENV, *small)
    assert error == ""
    assert code == 0
    assert out.startswith("training on an open floor")
    policy = Path("runs/Ahead-v0/1/policy.onnx")
    following = ("evaluate", "--policy", str(policy), "--env", ENV)
    assert out.splitlines()[-1] == f"next: acsar-gym {' '.join(following)}"

    code, _, error = call("evaluate", "--policy", policy, "--link", "planar")
    assert code == 2  # a file imports no package
    assert_one_line(error, "made for mine/Ahead-v0, which isn't acsar_gym's")

    figures = tmp_path / "figures.json"
    quick = ("--link", "planar", "--episodes", "2", "--json", str(figures))
    code, out, error = call(*following, *quick)
    assert (code, error) == (0, "")
    found = json.loads(figures.read_text())
    told = found["header"]
    assert (told["policy"]["env"], told["env"]["id"]) == (ENV, "mine/Ahead-v0")
    fastest = [episode["told"]["fastest"] for episode in found["per_episode"]]
    assert [list(episode["told"]) for episode in found["per_episode"]] == [["fastest"]] * 2
    assert found["told"]["fastest"] == pytest.approx(sum(fastest) / 2)

    code, _, error = call("run", "0.8", "0", "--link", "planar", *following[1:])
    assert code in (0, 1)
    assert error == ""

    again = tmp_path / "again.onnx"
    zipped = policy.with_name("model.zip")
    assert call("policy", zipped, "--out", again, "--trust", "--env", ENV)[::2] == (0, "")
    assert call("evaluate", "--policy", again, *following[3:], *quick)[::2] == (0, "")


def test_it_is_warmed_up(call: Call) -> None:
    code, out, error = call("train", "--warm-up", "--env", ENV)
    assert (code, error) == (0, "")
    assert out.startswith(f"{ENV}: ")
