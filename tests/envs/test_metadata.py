"""A picture a step: videos run as fast as the robot did."""

from __future__ import annotations

import copy
from pathlib import Path

import gymnasium
import pytest
from gymnasium.wrappers import RecordVideo

from acsar_gym.envs import PointGoalEnv

ENV_ID = "acsar_gym/PointGoal-v0"


@pytest.mark.parametrize("rate", [5.0, 10.0, 20.0])
def test_pictures_a_second_are_those_of_the_policy(rate: float) -> None:
    env = gymnasium.make(ENV_ID, link="planar", policy_rate=rate)
    assert env.metadata["render_fps"] == rate
    assert copy.deepcopy(env.unwrapped).metadata["render_fps"] == rate
    assert PointGoalEnv.metadata["render_fps"] == 10  # a class is no robot
    env.close()


def test_a_video_runs_at_the_policys_rate(tmp_path: Path) -> None:
    pytest.importorskip("moviepy")
    env = gymnasium.make(ENV_ID, link="planar", policy_rate=25.0, render_mode="rgb_array")
    recorder = RecordVideo(env, str(tmp_path / "videos"), disable_logger=True)
    assert recorder.frames_per_sec == 25.0
    env.close()
