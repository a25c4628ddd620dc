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
from acsar_gym.tools import cli
from acsar_gym.tools.evaluation import runs

AHEAD = """
import math
from beside import GAIN  # a file of its own

ENV_ID = "acsar_gym/PointGoal-v0"

def act(observation):
    distance, cosine, sine = observation[:3]
    return GAIN * max(cosine, 0.0), math.atan2(sine, cosine)
"""

GRADIENT = """
class Tensor:
    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("Can't call numpy() on Tensor that requires grad.")

    def __repr__(self):
        return "Tensor"

def act(o):
    return Tensor()
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    (tmp_path / "beside.py").write_text("GAIN = 0.8\n")
    path = tmp_path / "mine.py"
    path.write_text(AHEAD)
    return path


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("act = 1", "has no function 'act'"),
        ("def acts(o): return 0", "did you mean 'acts'?"),
        ("def act(o: return", "line 1: can't be run: SyntaxError"),
        ("\nimport no_such_module", "line 2: can't be run: ModuleNotFoundError"),
        ("def act(o): return [1.0]", "act gave [1.0]: must be two finite numbers"),
        ("def act(o): return [float('nan'), 0.0]", "must be two finite numbers"),
        ("def act(o): return 'ab'", "act gave 'ab': must be"),
        ("def act(o):\n  return o['x']", "line 2: act failed: IndexError"),
        ("import sys\nsys.exit()", "line 2: can't be run: SystemExit"),
        ("def act(o):\n  raise SystemExit(0)", "line 2: act failed: SystemExit: 0"),
        pytest.param(GRADIENT, "act gave Tensor: must be two finite numbers", id="gradient"),
    ],
)
def test_what_is_wrong_is_one_line(source: str, said: str, mine: Path) -> None:
    mine.write_text(source)
    with pytest.raises(PolicyError) as raised:
        runs.load_policy(f"{mine}:act", trust=False, env="point_goal")(np.zeros(7, np.float32))
    assert str(raised.value).startswith(str(mine))
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


PLANNER = """
ENV_ID = "acsar_gym/PointGoal-v0"
TOLD = []

class Planner:
    def bind(self, setting):
        TOLD.append(f"bound to {setting.task} at {setting.config.max_linear:g} m/s")

    def reset(self):
        TOLD.append("reset")

    def __call__(self, observation):
        TOLD.append("called")
        return 0.5, 0.0

made = Planner
"""
BASELINE = """
from acsar_gym.tools.baselines import BaselinePolicy

ENV_ID = "acsar_gym/PointGoal-v0"
TOLD = []

class Mine(BaselinePolicy):
    needs = ("goal_distance",)

    def equip(self, setting):
        super().equip(setting)
        TOLD.append(f"bound to {setting.task} at {setting.config.max_linear:g} m/s")

    def reset(self):
        super().reset()
        TOLD.append("reset")

    def act(self, seen):
        self.setting.rng("mine").uniform()
        TOLD.append("called")
        return 0.25 + 0.0 * seen.distance, 0.0
"""
CONTRACT = ["bound to acsar_gym/PointGoal-v0 at 0.5 m/s", *["reset", "called"] * 2]


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The name of a new, still empty module in the current folder, which isn't imported from yet.

    Imports keep lists of folders, as old as the folders' times, which are coarse.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place])
    name = f"mine_{uuid.uuid4().hex}"
    Path(f"{name}.py").touch()
    importlib.invalidate_caches()
    yield name
    sys.modules.pop(name, None)


@pytest.mark.parametrize("kind", ["module", "file", "object"])
@pytest.mark.parametrize(
    ("source", "name"), [(PLANNER, "Planner"), (PLANNER, "made"), (BASELINE, "Mine")]
)
def test_a_class_is_bound_once_and_reset_before_every_episode(
    source: str, name: str, kind: str, module: str
) -> None:
    Path(f"{module}.py").write_text(source)
    policy: Any = f"{module}:{name}" if kind == "module" else f"{module}.py:{name}"
    if kind == "object":
        sys.path.append("")
        made = getattr(importlib.import_module(module), name)
        policy = made("acsar_gym/PointGoal-v0") if source == BASELINE else made()
    loaded = runs.load_policy(policy, trust=False, env="point_goal")
    runs.evaluate_policy(loaded, "planar", None, range(2))
    imported = f"acsar_gym_policy_{module}" if kind == "file" else module
    calls = [key for key, _ in itertools.groupby(sys.modules[imported].TOLD)]
    assert calls == CONTRACT


@pytest.mark.parametrize(
    ("policy", "source", "said"),
    [
        ("{0}:Nothing", PLANNER, "Nothing"),
        ("no_such_module:act", PLANNER, "no_such_module"),
        (
            "{0}:Planner",
            PLANNER.replace("TOLD.append(f", "raise ValueError(f"),
            "line 7: bind failed",
        ),
        ("{0}:Planner", PLANNER.replace('append("reset")', "nothing"), "line 10: reset failed"),
        (
            "{0}:Planner",
            PLANNER.replace("class Planner:", "class Planner:\n    def __init__(self, x): pass\n"),
            "can't be made: TypeError",
        ),
        ("{0}:Mine", BASELINE.replace("goal_distance", "ahead_1"), "needs a goal"),
    ],
)
def test_what_is_wrong_with_a_class_is_one_line(
    policy: str, source: str, said: str, module: str
) -> None:
    Path(f"{module}.py").write_text(source)
    with pytest.raises((PolicyError, ConfigError)) as raised:
        loaded = runs.load_policy(policy.format(module), trust=False, env="point_goal")
        runs.evaluate_policy(loaded, "planar", None, range(1))
    assert said in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_missing_file_or_name_is_one_line(mine: Path) -> None:
    for policy, said in ((f"{mine}", "name a function"), ("missing.py:act", "no such file")):
        with pytest.raises(PolicyError, match=said):
            runs.load_policy(policy, trust=False, env="point_goal")


def test_the_command_line_drives_it_and_says_what_is_wrong(
    mine: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for command, code, said in (
        (("run", "1", "0"), 0, "mine.py:act"),
        (("evaluate", "--episodes", "2"), 0, "2/2"),
        (("evaluate", "--episodes", "1", "--env", "path_follow"), 2, "act"),
    ):
        arguments = ["acsar-gym", *command, "--link", "planar", "--policy", f"{mine}:act"]
        monkeypatch.setattr("sys.argv", arguments)
        if code:
            mine.write_text("def act(o): return 'nowhere'")
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, error = capsys.readouterr()
        assert ended.value.code == code, error
        assert said in out + error
        assert error.count("\n") == int(code > 0)
