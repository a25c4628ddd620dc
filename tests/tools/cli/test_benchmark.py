"""`acsar-gym benchmark`: what it writes, for tasks of this package and of users."""

from __future__ import annotations

import json
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acsar_gym.registration import SCENE_CHOICES

TASK = """
import math
from dataclasses import dataclass
import acsar_gym
from acsar_gym import Outcome, Task

@dataclass(frozen=True)
class Park(Task):
    observation = {"ahead": (-30, 30), "left": (-30, 30)}
    memory = {"stars": 0.0}

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


def test_benchmark_writes_json_and_a_page(call: Any, tmp_path: Path) -> None:
    small = "benchmark --env point_goal --sets open/acsar --links planar --scenes 2"
    page_file = tmp_path / "page.html"
    json_file = tmp_path / "rows.json"
    files = f"--out {tmp_path / 'run'} --html {page_file} --json {json_file}"
    code, out, error = call(f"{small} --agents packaged turn_drive {files}")
    assert code == 0, error
    assert "packaged" in out

    result = json.loads(json_file.read_text())
    assert json_file.read_text() == (tmp_path / "run" / "benchmark.json").read_text()
    rates = {row["agent"]: row["success_rate"] for row in result["rows"]}
    assert rates == {"packaged": 1.0, "turn_drive": 1.0}
    page = page_file.read_text()
    assert "turn_drive" in page
    assert str(tmp_path) not in page


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of a new module in the current folder, which is a namespace as well."""
    monkeypatch.chdir(tmp_path)
    name = f"mine_{uuid.uuid4().hex}"
    yield name
    sys.modules.pop(name, None)
    SCENE_CHOICES.pop(f"{name}/Park-v0", None)


def write_task(module: str, options: str = "") -> str:
    """Write the module. Returns the id of its task."""
    text = TASK.replace("OPTIONS", options).replace("NAME", module)
    Path(f"{module}.py").write_text(text)
    return f"{module}:{module}/Park-v0"


def test_benchmark_of_a_users_task_and_resume_after_a_change(
    module: str, call: Any, tmp_path: Path
) -> None:
    scenes = ", scenes={'fast': {'worlds': '', 'robots': ['jackal'], 'score': 'stars'}}"
    env_id = write_task(module, scenes)
    small = f"benchmark --env {env_id} --agents {module}:Planner --links planar --scenes 2"
    code, _, error = call(f"{small} --out run")
    assert code == 0, error
    (row,) = json.loads((tmp_path / "run" / "benchmark.json").read_text())["rows"]
    assert (row["id"], row["scenes"], row["success_rate"]) == (f"{module}/Park-v0", "fast", 1.0)
    assert 4.0 < row["score"] < 5.0

    source = Path(f"{module}.py").read_text()
    Path(f"{module}.py").write_text(source.replace("0.3", "0.2"))
    call.refuse("has changed since the benchmark was started", f"{small} --resume run")


@pytest.mark.parametrize(
    ("options", "agent", "code", "message"),
    [
        (", scenes={'a': {'score': 'star'}}", "Planner", 2, "'star'; did you mean 'stars'?"),
        ("", "turn_drive", 0, "Park-v0 doesn't observe"),
    ],
)
def test_benchmark_explains_scores_and_agents_that_dont_fit(
    options: str, agent: str, code: int, message: str, module: str, call: Any
) -> None:
    name = f"{module}:{agent}" if agent == "Planner" else agent
    env_id = write_task(module, options)
    small = f"benchmark --env {env_id} --agents {name} --links planar --scenes 1 --out run"
    status, out, error = call(small)
    assert status == code
    assert message in " ".join((out + error).split())
