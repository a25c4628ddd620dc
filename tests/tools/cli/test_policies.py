"""Evaluations that end early, and episodes that a fault ends: results, messages and exit codes."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from boards import FailingLink

from acsar_gym import open_link
from acsar_gym.errors import EmergencyStopError
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation import runs
from acsar_gym.tools.evaluation.episode import Episode

EVALUATE = "evaluate --link planar --episodes 5"
RUN = "run 1 0 --link planar"


@pytest.fixture
def end_early(monkeypatch: pytest.MonkeyPatch) -> Any:
    """`end_early(error, after)` ends every evaluation after some episodes."""
    run_resets = evaluation.run_resets

    def install(error: BaseException, after: int) -> None:
        def run(env: Any, policy: Any, resets: Any, late_share: float) -> Iterator[Any]:
            yield from run_resets(env, policy, resets[:after], late_share)
            raise error

        monkeypatch.setattr(evaluation, "run_resets", run)

    return install


@pytest.mark.parametrize(
    ("command", "error", "code", "message", "finished"),
    [
        (EVALUATE, EmergencyStopError(), 3, "emergency stop", 2),
        (EVALUATE, KeyboardInterrupt(), 130, "interrupted", 2),
        (RUN, EmergencyStopError(), 3, "emergency stop", 0),
    ],
    ids=["estop", "Ctrl-C", "run"],
)
def test_results_contain_the_finished_episodes(
    command: str,
    error: BaseException,
    code: int,
    message: str,
    finished: int,
    end_early: Any,
    call: Any,
    tmp_path: Path,
) -> None:
    end_early(error, finished)
    file = tmp_path / "figures.json"
    status, out, errors = call(f"{command} --json {file}")
    assert status == code
    assert message in errors
    ended = f"Ended after {finished} of 5 episodes: {message}"
    assert (ended in " ".join(out.split())) == (finished > 0)
    data = json.loads(file.read_text())
    assert (data["episodes"], len(data["per_episode"])) == (finished, finished)
    assert message in data["ended_early"]


def test_evaluate_counts_a_fault_and_no_time_out(
    call: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    make_env = runs.make_env

    def make_failing(policy: Any, link: Any, robot: Any, options: Any) -> Any:
        return make_env(policy, FailingLink(open_link(link, robot), 0.2), robot, options)

    monkeypatch.setattr(runs, "make_env", make_failing)
    file = tmp_path / "figures.json"
    out = call.refuse("unplugged", f"{EVALUATE} --json {file}", code=3)
    assert re.search(r"fault \[%\] +│ +100\.0 ", out)
    assert re.search(r"time-out \[%\] +│ +0\.0 ", out)
    assert "Faults: " in out
    data = json.loads(file.read_text())
    assert (data["fault_rate"], data["timeout_rate"]) == (1.0, 0.0)


@pytest.mark.parametrize(
    ("command", "success", "code", "message"),
    [
        (EVALUATE, True, 4, "too many late ticks in 5 of 5 episodes: stop other programs"),
        (RUN, True, 4, "in 1 of 1 episodes"),
        (RUN, False, 1, ""),
    ],
    ids=["evaluate", "run", "not there"],
)
def test_invalid_episodes_have_an_exit_code(
    command: str,
    success: bool,
    code: int,
    message: str,
    call: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run_resets = evaluation.run_resets

    def run_late(*arguments: Any, **options: Any) -> Iterator[Episode]:
        for result in run_resets(*arguments, **options):
            yield dataclasses.replace(result, valid=False, success=success)

    monkeypatch.setattr(evaluation, "run_resets", run_late)
    status, out, error = call(command)
    assert status == code
    assert message in error
    assert "invalid" in out


def test_run_drives_to_goals_beyond_the_training_with_goal_distance(
    tmp_path: Path, call: Any
) -> None:
    file = tmp_path / "figures.json"
    run = "run 6.5 -1 --link planar"
    call.succeed(f"{run} --goal-distance 0.2 8 --json {file}")
    assert json.loads(file.read_text())["success_rate"] == 1.0
    call.refuse("3 m from the start: give the env another goal_distance, run --goal-distance", run)
