"""Sums over episodes, with and without truth."""

from __future__ import annotations

import json
import math
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from acsar_gym.envs import PointGoalEnv
from acsar_gym.errors import ConfigError
from acsar_gym.evaluation import EpisodeResult, episodes, odometry_errors
from acsar_gym.metrics import summarise
from acsar_gym.report import write_json
from acsar_gym.worlds import Pose


def result(*, success: bool = True, pose: Pose = (1.0, 0.0, 0.0), late: int = 0) -> EpisodeResult:
    return EpisodeResult(
        success=success,
        collision=False,
        started=10.0,
        ended=14.0 if success else 30.0,
        path=1.5 if success else 9.0,
        pose=pose,
        odometry_error=0.02,
        ticks=400,
        late_ticks=late,
    )


def test_times_and_paths_are_means_over_successes() -> None:
    summary = summarise([result(), result(late=3), result(success=False)])
    assert summary.success_rate == pytest.approx(2.0 / 3.0)
    assert summary.time_to_goal == pytest.approx(4.0)
    assert summary.path == pytest.approx(1.5)
    assert (summary.ticks, summary.late_ticks) == (1200, 3)


def test_without_a_success_there_is_no_time_to_goal() -> None:
    summary = summarise([result(success=False)])
    assert math.isnan(summary.time_to_goal)
    assert summary.as_dict()["time_to_goal"] is None


def test_odometry_errors_come_from_the_emulators_log(tmp_path: Path) -> None:
    """The robot stood at (5, 5) looking along +y and ended 1 m ahead and 3 cm to the left."""
    log = tmp_path / "log.jsonl"
    events = [
        {"t": 9.9, "pose": [5.0, 5.0, math.pi / 2.0]},
        {"t": 10.5, "rx": "ap00.00\r\n"},
        {"t": 13.9, "pose": [4.97, 6.0, math.pi / 2.0]},
        {"t": 99.0, "pose": [0.0, 0.0, 0.0]},
    ]
    log.write_text("\n".join(map(json.dumps, events)))
    assert odometry_errors([result()], log) == pytest.approx([0.03])


def test_a_log_without_poses_is_an_error(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    log.write_text('{"t": 1.0, "rx": ""}\n')
    with pytest.raises(ConfigError, match="no true poses"):
        odometry_errors([result()], log)


def test_json_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="can't be written"):
        write_json(tmp_path / "no" / "folder.json", {})


def test_an_episode_that_runs_out_of_time_leaves_the_robot_stopping() -> None:
    env = gymnasium.make("acsar_gym/PointGoal-v0", link="planar", max_episode_steps=5)
    (episode,) = episodes(env, lambda _: np.array([1.0, 0.0], np.float32), 1, seed=0)
    assert not episode.success
    assert isinstance(env.unwrapped, PointGoalEnv)
    link = env.unwrapped.robot.link
    link.advance(0.4)  # less than the board's own command time-out
    assert link.truth is not None
    assert abs(link.truth.twist[0]) < 0.1
    env.close()
