"""Baselines by name: over the command line, and where they can't drive."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_tools import assert_one_line

from acsar_gym.errors import PolicyError
from acsar_gym.tools import baselines, cli
from acsar_gym.tools.evaluation import runs


def called(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str
) -> tuple[int, str, str]:
    """Exit code, output and errors of `acsar-gym ARGUMENTS` in this process."""
    monkeypatch.setattr(sys, "argv", ["acsar-gym", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert isinstance(ended.value.code, int)
    return ended.value.code, *capsys.readouterr()


def test_evaluate_takes_a_baseline_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.json"
    options = ("--env", "point_goal", "--link", "planar", "--episodes", "3", "--json", str(out))
    code, said, _ = called(monkeypatch, capsys, "evaluate", "--policy", "turn_drive", *options)
    assert (code, "3/3" in said) == (0, True)
    header = json.loads(out.read_text())["header"]
    assert header["policy"]["file"] == "turn_drive"
    assert len(header["policy"]["sha256"]) == 64


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--policy", "nosuch"), "baselines: random, turn_drive, smooth, pure_pursuit, stanley"),
        (("--policy", "nosuch"), "policies that come along: barn"),
        (("--policy", "dwa"), "--policy dwa --env obstacle_goal"),
        (("--policy", "follow_gap", "--env", "point_goal"), "needs a LiDAR, which acsar_gym/Point"),
        (("--policy", "stanley", "--env", "point_goal"), "needs a path, which acsar_gym/PointGoal"),
        (("--policy", "smooth", "--env", "path_follow"), "needs a goal, which acsar_gym/PathFollo"),
    ],
)
def test_what_it_cant_drive_is_one_line(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    said: str,
) -> None:
    options = ("--link", "planar", "--episodes", "1")
    code, _, error = called(monkeypatch, capsys, "evaluate", *arguments, *options)
    assert code == 2
    assert_one_line(error, said)


def test_a_file_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert baselines.is_baseline("smooth")
    Path("smooth").write_text("not a policy")
    with pytest.raises(PolicyError, match="smooth"):
        runs.load_policy("smooth", trust=False, env="point_goal")


def test_random_actions_depend_on_the_episodes_seed_alone() -> None:
    """Whichever episodes were driven before."""

    def driven(first: int, count: int) -> list[float]:
        policy = runs.load_policy("random", trust=False, env="point_goal")
        done = runs.evaluate_policy(policy, "planar", None, range(first, first + count))
        return [result.path for result in done.results]

    assert driven(0, 3)[2] == driven(2, 1)[0]


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
