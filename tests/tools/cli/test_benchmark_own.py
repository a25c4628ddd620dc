"""Benchmarks of tasks that other packages register."""

from __future__ import annotations

import json
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_tools import Call

from acsar_gym.registration import SCENE_CHOICES
from acsar_gym.tools.benchmark.scenes import find_sets

TASK = """
import math
from dataclasses import dataclass
import acsar_gym
from acsar_gym import Outcome, Task

@dataclass(frozen=True)
class Park(Task):
    observation = {"ahead": (-30, 30), "left": (-30, 30)}
    memory = {"stars": 0.0}
    WORLDS

    def outcome(self, state, memory):
        memory.stars = 5.0 - 0.1 * state.time
        near = math.dist(state.goal, state.pose[:2]) < 0.3
        return Outcome.SUCCESS if near else Outcome.GOING

    def reward(self, state, memory, outcome):
        return 0.0

    def observe(self, state, memory):
        x, y, theta = state.pose
        dx, dy, c, s = state.goal[0] - x, state.goal[1] - y, math.cos(theta), math.sin(theta)
        return dx * c + dy * s, dy * c - dx * s

class Planner:
    def bind(self, setting):
        self.most = setting.config.max_linear

    def __call__(self, seen):
        return min(1.0, max(0.0, seen[0]) / self.most), math.atan2(seen[1], seen[0])

acsar_gym.register("NAME/Park-v0", task=Park, max_episode_steps=150 OPTIONS)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of a new module in the current folder, which is a namespace, too."""
    monkeypatch.chdir(tmp_path)
    name = f"mine_{uuid.uuid4().hex}"
    yield name
    sys.modules.pop(name, None)
    SCENE_CHOICES.pop(f"{name}/Park-v0", None)


def write_task(module: str, worlds: str = "", options: str = "") -> str:
    """Write the module; returns the id of its task."""
    text = TASK.replace("WORLDS", worlds).replace("OPTIONS", options).replace("NAME", module)
    Path(f"{module}.py").write_text(text)
    return f"{module}:{module}/Park-v0"


@pytest.mark.parametrize(
    ("worlds", "options", "told"),
    [
        ("", "", {"test": ("acsar", "", 2**33, "success")}),
        ('worlds = "rooms:train"', "", {"test": ("acsar", "rooms", 100_000, "success")}),
        (
            "",
            ", kwargs={'worlds': 'clutter:50'}",
            {"test": ("acsar", "clutter", 100_000, "success")},
        ),
        (
            "",
            ", scenes={'a': {'robots': ['jackal'], 'score': 'stars'}, 'b': {'worlds': 'rooms'}}",
            {
                "a": ("jackal", "", 2**33, "stars"),
                "b": ("acsar", "rooms", 100_000, "success"),
            },
        ),
    ],
)
def test_the_scenes_of_a_task(
    worlds: str, options: str, told: dict[str, tuple[object, ...]], module: str
) -> None:
    found = find_sets(write_task(module, worlds, options))
    assert {
        some.name: (some.robot, some.source, some.numbers[0], some.score) for some in found
    } == told
    assert all(some.id == f"{module}/Park-v0" for some in found)


def test_the_score_is_completion_time_where_the_shortest_path_is_known(
    module: str, call: Call, tmp_path: Path
) -> None:
    env_id = write_task(module, "", ", scenes={'a': {'score': 'completion_time'}}")
    small = ("--links", "planar", "--scenes", "1", "--agents", f"{module}:Planner")
    code, _, error = call("benchmark", "--env", env_id, *small, "--out", tmp_path / "run")
    assert code == 2
    assert "score 'completion_time': the task has no method shortest_path()" in error
    path = "def shortest_path(self, state, memory):\n        return [state.goal]\n\n    def reward"
    text = Path(f"{module}.py").read_text().replace("def reward", path)
    other = f"other_{module}"
    Path(f"{other}.py").write_text(
        text.replace(", scenes={'a': {'score': 'completion_time'}}", "").replace(module, other)
    )
    (some,) = find_sets(f"{other}:{other}/Park-v0")
    assert some.score == "completion_time"
    SCENE_CHOICES.pop(f"{other}/Park-v0")


def test_its_benchmark(module: str, call: Call, tmp_path: Path) -> None:
    env_id = write_task(
        module, "", ", scenes={'fast': {'worlds': '', 'robots': ['jackal'], 'score': 'stars'}}"
    )
    small = ("--links", "planar", "--scenes", "2", "--out", tmp_path / "run")
    code, _, error = call(*("benchmark", "--env", env_id, "--agents", f"{module}:Planner", *small))
    assert code == 0, error
    told = json.loads((tmp_path / "run" / "benchmark.json").read_text())
    (row,) = told["rows"]
    assert (row["id"], row["scenes"], row["success_rate"]) == (f"{module}/Park-v0", "fast", 1.0)
    assert 4.0 < row["score"] < 5.0

    source = Path(f"{module}.py").read_text()
    Path(f"{module}.py").write_text(source.replace("0.3", "0.2"))
    again = ("--agents", f"{module}:Planner", "--links", "planar", "--scenes", "2")
    code, _, error = call("benchmark", "--env", env_id, *again, "--resume", tmp_path / "run")
    assert code == 2
    assert "has changed since the benchmark was started" in error


def test_a_score_that_no_task_tells_is_an_error(module: str, call: Call, tmp_path: Path) -> None:
    small = ("--links", "planar", "--scenes", "1", "--out", tmp_path / "run")
    env_id = write_task(module, "", ", scenes={'any': {'score': 'star'}}")
    code, _, error = call("benchmark", "--env", env_id, "--agents", f"{module}:Planner", *small)
    assert code == 2
    assert error.splitlines()[-1].endswith("score 'star'; did you mean 'stars'?")


def test_a_baseline_that_cant_drive_it_says_why(module: str, call: Call, tmp_path: Path) -> None:
    small = ("--links", "planar", "--scenes", "1", "--out", tmp_path / "run")
    code, said, error = call(
        "benchmark", "--env", write_task(module), "--agents", "turn_drive", *small
    )
    assert code == 0, error
    assert f"which {module}/Park-v0 doesn't observe" in " ".join(said.split())
