"""Evaluations that end early, and episodes that a fault ends: what is kept, said and returned."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from boards import FailingLink
from cli_tools import Call, assert_one_line

from acsar_gym import open_link
from acsar_gym.errors import BoardSilentError, EmergencyStopError
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episode import Episode

EVALUATE = ("evaluate", "--link", "planar", "--episodes", "5")


@pytest.fixture
def ending(monkeypatch: pytest.MonkeyPatch) -> Any:
    """`ending(error, after=2)` ends every evaluation so."""
    whole = evaluation.run_resets

    def install(error: BaseException, after: int = 2) -> None:
        def episodes(env: Any, policy: Any, resets: Any, late_share: float) -> Iterator[Any]:
            yield from whole(env, policy, resets[:after], late_share)
            raise error

        monkeypatch.setattr(evaluation, "run_resets", episodes)

    return install


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (EmergencyStopError(), 3, "emergency stop"),
        (BoardSilentError("no feedback for 0.51 s", "check the cable"), 3, "no feedback for 0.51"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
    ids=["estop", "lost", "Ctrl-C"],
)
def test_finished_episodes_are_kept(
    error: BaseException, code: int, said: str, ending: Any, call: Call, tmp_path: Path
) -> None:
    ending(error)
    file = tmp_path / "figures.json"
    status, output, message = call(*EVALUATE, "--json", file)
    assert status == code
    assert said in message
    assert "2/2" in output
    assert f"Ended after 2 of 5 episodes: {said}" in " ".join(output.split())
    data = json.loads(file.read_text())
    assert (data["episodes"], len(data["per_episode"])) == (2, 2)
    assert said in data["ended_early"]


def test_a_stopped_run_writes_its_json(ending: Any, call: Call, tmp_path: Path) -> None:
    ending(EmergencyStopError(), after=0)
    file = tmp_path / "figures.json"
    status, output, message = call("run", "1", "0", "--link", "planar", "--json", file)
    assert (status, output) == (3, "")
    assert_one_line(message, "emergency stop")
    data = json.loads(file.read_text())
    assert (data["episodes"], data["per_episode"], data["success_rate"]) == (0, [], None)
    assert "emergency stop" in data["ended_early"]


def test_a_fault_is_a_column_and_no_time_out(call: Call, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = runs.make_env

    def made(policy: Any, link: Any, robot: Any, options: Any) -> Any:
        return whole(policy, FailingLink(open_link(link, robot), 0.2), robot, options)

    monkeypatch.setattr(runs, "make_env", made)
    status, output, message = call(*EVALUATE)
    assert status == 3
    assert_one_line(message, "unplugged")
    assert re.search(r"fault \[%\] +│ +100\.0 ", output)
    assert re.search(r"time-out \[%\] +│ +0\.0 ", output)
    assert "Faults: " in output


@pytest.mark.parametrize(
    ("command", "success", "code", "said"),
    [
        (EVALUATE, True, 4, "too many late ticks in 5 of 5 episodes: stop other programs"),
        (("run", "1", "0", "--link", "planar"), True, 4, "in 1 of 1 episodes"),
        (("run", "1", "0", "--link", "planar"), False, 1, ""),
    ],
    ids=["evaluate", "run", "not there"],
)
def test_invalid_episodes_have_an_exit_code(
    command: tuple[str, ...],
    success: bool,
    code: int,
    said: str,
    call: Call,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    whole = evaluation.run_resets

    def episodes(*arguments: Any, **options: Any) -> Iterator[Episode]:
        for result in whole(*arguments, **options):
            yield dataclasses.replace(result, valid=False, success=success)

    monkeypatch.setattr(evaluation, "run_resets", episodes)
    status, output, message = call(*command)
    assert status == code
    assert said in message
    assert "invalid" in output


@pytest.mark.parametrize("goal", [("6.5", "-1"), ("0.3", "0")], ids=["far", "near"])
def test_a_run_takes_goals_beyond_those_of_the_training(
    goal: tuple[str, str], call: Call, tmp_path: Path
) -> None:
    file = tmp_path / "figures.json"
    bounds = ("--goal-distance", "0.2", "8")
    drive = ("run", *goal, "--link", "planar")
    assert call(*drive, *bounds, "--json", file)[::2] == (0, "")
    assert json.loads(file.read_text())["success_rate"] == 1.0
    code, _, error = call(*drive)
    assert code == 2
    assert_one_line(error, "must lie 0.5 to 3 m from the start")
    assert "--goal-distance" in error
