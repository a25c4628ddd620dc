"""Functions, classes and objects in Python as policies."""

from __future__ import annotations

import importlib
import itertools
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acsar_gym.errors import ConfigError, PolicyError
from acsar_gym.tools.evaluation import runs

AHEAD = """
import math
from beside import GAIN  # a file of the same folder

ENV_ID = "acsar_gym/PointGoal-v0"

def act(observation):
    distance, cosine, sine = observation[:3]
    return GAIN * max(cosine, 0.0), math.atan2(sine, cosine)
"""
GRADIENT = """
class Tensor:
    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("Can't call numpy() on Tensor that requires grad.")

def act(o):
    return Tensor()
"""
PLANNER = """
ENV_ID = "acsar_gym/PointGoal-v0"
CALLS = []

class Planner:
    def bind(self, setting):
        CALLS.append(f"bound to {setting.task} at {setting.config.max_linear:g} m/s")

    def reset(self):
        CALLS.append("reset")

    def __call__(self, observation):
        CALLS.append("called")
        return 0.5, 0.0

made = Planner
"""
BASELINE = """
from acsar_gym.tools.baselines import BaselinePolicy

ENV_ID = "acsar_gym/PointGoal-v0"
CALLS = []

class Mine(BaselinePolicy):
    needs = ("goal_distance",)

    def equip(self, setting):
        super().equip(setting)
        CALLS.append(f"bound to {setting.task} at {setting.config.max_linear:g} m/s")

    def reset(self):
        super().reset()
        CALLS.append("reset")

    def act(self, seen):
        self.setting.rng("mine").uniform()
        CALLS.append("called")
        return 0.25 + 0.0 * seen.distance, 0.0
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """Return a policy file, which imports a file of its folder."""
    (tmp_path / "beside.py").write_text("GAIN = 0.8\n")
    path = tmp_path / "mine.py"
    path.write_text(AHEAD)
    return path


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return the name of an empty module in the current folder, which isn't imported yet.

    Imports keep lists of folders, as old as the folders' times, which are coarse.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    name = f"mine_{uuid.uuid4().hex}"
    Path(f"{name}.py").touch()
    importlib.invalidate_caches()
    yield name
    sys.modules.pop(name, None)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def acts(o): return 0", "has no function 'act', as in mine.py:act; did you mean 'acts'?"),
        ("def act(o: return", "line 1: can't be run: SyntaxError"),
        ("def act(o): return [float('nan'), 0.0]", "must be two finite numbers"),
        ("def act(o):\n  raise SystemExit(0)", "line 2: act failed: SystemExit: 0"),
        pytest.param(GRADIENT, "must be two finite numbers", id="gradient"),
    ],
)
def test_callable_policy_reports_errors_in_one_line(source: str, message: str, mine: Path) -> None:
    mine.write_text(source)
    with pytest.raises(PolicyError) as raised:
        runs.load_policy(f"{mine}:act", trust=False, env="point_goal")(np.zeros(7, np.float32))
    assert str(raised.value).startswith(str(mine))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("kind", ["module", "file", "object"])
@pytest.mark.parametrize(
    ("source", "name"), [(PLANNER, "Planner"), (PLANNER, "made"), (BASELINE, "Mine")]
)
def test_callable_policy_is_bound_once_and_reset_before_every_episode(
    source: str, name: str, kind: str, module: str
) -> None:
    Path(f"{module}.py").write_text(source)
    policy: Any = f"{module}:{name}" if kind == "module" else f"{module}.py:{name}"
    if kind == "object":
        sys.path.append("")
        code = getattr(importlib.import_module(module), name)
        policy = code("acsar_gym/PointGoal-v0") if source == BASELINE else code()

    loaded = runs.load_policy(policy, trust=False, env="point_goal")
    runs.evaluate_policy(loaded, "planar", None, range(2))
    imported = f"acsar_gym_policy_{module}" if kind == "file" else module
    calls = [key for key, _ in itertools.groupby(sys.modules[imported].CALLS)]
    bound = "bound to acsar_gym/PointGoal-v0 at 0.5 m/s"
    assert calls == [bound, "reset", "called", "reset", "called"]


@pytest.mark.parametrize(
    ("policy", "source", "message"),
    [
        ("{0}.py", PLANNER, "name a function"),
        ("missing.py:act", PLANNER, "no such file"),
        ("{0}:Planner", PLANNER.replace("CALLS.append(f", "raise V(f"), "line 7: bind failed"),
        ("{0}:Mine", BASELINE.replace("goal_distance", "ahead_1"), "needs a goal"),
    ],
)
def test_callable_policy_reports_errors_of_classes_in_one_line(
    policy: str, source: str, message: str, module: str
) -> None:
    Path(f"{module}.py").write_text(source)
    with pytest.raises((PolicyError, ConfigError)) as raised:
        loaded = runs.load_policy(policy.format(module), trust=False, env="point_goal")
        runs.evaluate_policy(loaded, "planar", None, range(1))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_callable_policy_imports_and_finds_files_of_its_folder(
    mine: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(mine.parent)
    policy = runs.load_policy("mine.py:act", trust=False)
    assert policy(np.array([1.0, 0.5, 0.0], np.float32)) == pytest.approx([0.4, 0.0])
    assert sys.modules["acsar_gym_policy_mine"].__file__ == str(mine)
