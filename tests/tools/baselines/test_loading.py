"""Baselines by name, and where they can't drive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from acsar_gym.errors import PolicyError
from acsar_gym.tools import baselines
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.runs import EvaluationRun


def evaluate(name: str, env: str, first: int = 0, count: int = 3) -> EvaluationRun:
    policy = runs.load_policy(name, trust=False, env=env)
    return runs.evaluate_policy(policy, "planar", None, range(first, first + count))


def test_a_baseline_is_evaluated_by_its_name() -> None:
    run = evaluate("turn_drive", "point_goal")
    assert run.summary.success_rate == 1.0
    assert run.header["policy"]["file"] == "turn_drive"
    assert len(run.header["policy"]["sha256"]) == 64


@pytest.mark.parametrize(
    ("name", "env", "said"),
    [
        ("nosuch", "", "come along: barn.*baselines: random"),
        ("dwa", "", "--policy dwa --env obstacle_goal"),
        ("follow_gap", "point_goal", "needs a LiDAR"),
        ("stanley", "point_goal", "needs a path"),
        ("smooth", "path_follow", "needs a goal"),
    ],
)
def test_what_it_cant_drive_is_told(name: str, env: str, said: str) -> None:
    with pytest.raises(PolicyError, match=said):
        evaluate(name, env)


def test_a_file_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert baselines.is_baseline("smooth")
    Path("smooth").write_text("not a policy")
    with pytest.raises(PolicyError, match="smooth"):
        runs.load_policy("smooth", trust=False, env="point_goal")


def test_random_actions_depend_on_the_episodes_seed_alone() -> None:
    """Whichever episodes were driven before."""
    three, one = evaluate("random", "point_goal"), evaluate("random", "point_goal", 2, 1)
    assert three.results[2].path == one.results[0].path


@pytest.mark.parametrize("name", list(baselines.BASELINES))
def test_every_name_has_a_class_of_that_name(name: str) -> None:
    assert baselines.load_baseline(name, "acsar_gym/Barn-v1").name == name


def test_actions_are_within_the_action_space() -> None:
    policy = runs.load_policy("turn_drive", trust=False, env="point_goal")
    env = runs.make_env(policy, "planar", None, {})
    observation, _ = env.reset(seed=0, options={"goal": (-1.0, 0.1)})
    action = policy(observation)
    assert env.action_space.contains(action)
    assert action.tolist() == [0.0, 1.0]
    assert action.dtype == np.float32
    env.close()
