"""Environments that other packages register (`--env mine.module:mine/Task-v0`)."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import pytest
from cli_tools import assert_one_line

pytestmark = pytest.mark.xdist_group(__name__)

ENV = "mine_of_tests.tasks:mine/Ahead-v0"
SMALL = "--robots 4 --threads 1 --net 8 --no-progress"
TASKS = """
from dataclasses import dataclass

import acsar_gym
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


acsar_gym.register("mine/Ahead-v0", task=Ahead, max_episode_steps=20)
acsar_gym.register("mine/Unsound-v0", task=Unsound, max_episode_steps=20)
"""


@pytest.fixture(autouse=True)
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A user's package in the current folder."""
    folder = tmp_path / "mine_of_tests"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "tasks.py").write_text(TASKS)
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
    ("command", "env", "message"),
    [
        ("train", "no_such_module:mine/Ahead-v0", "No module named 'no_such_module'"),
        ("train", "mine_of_tests.wrong:mine/Ahead-v0", "can't be imported: SystemExit: two lines"),
        ("run 1 0 --link planar", "mine/Ahead-v0", "name the module that registers it, too"),
    ],
)
def test_env_that_isnt_there_is_one_line(command: str, env: str, message: str, call: Any) -> None:
    call.refuse(message, command, "--env", env)


def test_train_reports_a_task_that_fails_in_one_line(call: Any) -> None:
    env = "mine_of_tests.tasks:mine/Unsound-v0"
    call.refuse(
        "mine/Unsound-v0.reward returned nan for robot 0: must be a finite number",
        f"train --env {env} --steps 64 {SMALL}",
    )


def test_a_policy_for_a_users_env_is_trained_evaluated_driven_and_exported(
    call: Any, tmp_path: Path
) -> None:
    out = call.succeed(f"train --env {ENV} --steps 1 {SMALL}")
    assert out.startswith("training on an open floor")
    policy = Path("runs/Ahead-v0/1/policy.onnx")
    options = f"--policy {policy} --env {ENV}"
    assert out.splitlines()[-1] == f"next: acsar-gym evaluate {options}"

    code, _, error = call(f"evaluate --policy {policy} --link planar")
    assert code == 2  # a file imports no package
    assert_one_line(error, "made for mine/Ahead-v0, which isn't acsar_gym's")

    figures = tmp_path / "figures.json"
    quick = f"--link planar --episodes 2 --json {figures}"
    out = call.succeed(f"evaluate {options} {quick}")
    data = json.loads(figures.read_text())
    header = data["header"]
    assert (header["policy"]["env"], header["env"]["id"]) == (ENV, "mine/Ahead-v0")
    fastest = [episode["told"]["fastest"] for episode in data["per_episode"]]
    assert data["told"]["fastest"] == pytest.approx(sum(fastest) / 2)

    code, _, error = call(f"run 0.8 0 --link planar {options}")
    assert code in (0, 1)
    assert error == ""

    onnx = tmp_path / "again.onnx"
    model = policy.with_name("model.zip")
    call.succeed(f"policy {model} --out {onnx} --trust --env {ENV}")
    call.succeed(f"evaluate --policy {onnx} --env {ENV} {quick}")


def test_train_warms_up_a_users_env(call: Any) -> None:
    out = call.succeed(f"train --warm-up --env {ENV}")
    assert out.startswith(f"{ENV}: ")
