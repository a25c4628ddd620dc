"""Functions of Python files as policies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from acsar_gym.errors import PolicyError
from acsar_gym.tools import cli
from acsar_gym.tools.evaluation import episodes as evaluation
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

CLASSES = """
from __future__ import annotations
import pickle
from dataclasses import dataclass

ENV_ID = "acsar_gym/PointGoal-v0"

@dataclass
class Drive:
    speed: float = 0.5

KEPT = pickle.dumps(Drive())

def act(observation):
    return [pickle.loads(KEPT).speed, 0.0]
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    (tmp_path / "beside.py").write_text("GAIN = 0.8\n")
    path = tmp_path / "mine.py"
    path.write_text(AHEAD)
    return path


def test_a_function_drives_to_its_goal(mine: Path) -> None:
    policy = runs.load_policy(f"{mine}:act", trust=False)
    env = runs.make_env(policy, "planar", None, {})
    results = list(evaluation.run_episodes(env, policy, 5, seed=0))
    env.close()
    assert sum(result.success for result in results) == 5


def test_the_environment_may_be_named(mine: Path) -> None:
    mine.write_text("def act(observation):\n    return [0.5, 0.0]\n")
    with pytest.raises(PolicyError, match="--env point_goal"):
        runs.load_policy(f"{mine}:act", trust=False)
    policy = runs.load_policy(f"{mine}:act", trust=False, env="path_follow")
    env = runs.make_env(policy, "planar", None, {})
    assert env.spec is not None
    assert env.spec.id == "acsar_gym/PathFollow-v0"
    env.close()


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


def test_its_classes_know_their_module(mine: Path) -> None:
    """As dataclasses with postponed annotations, and pickle, need it."""
    mine.write_text(CLASSES)
    action = runs.load_policy(f"{mine}:act", trust=False)(np.zeros(7, np.float32))
    assert action.tolist() == [0.5, 0.0]


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
