"""What the tables say."""

from __future__ import annotations

import dataclasses

from rich.console import Console

from acsar_gym.envs import PointGoalEnv
from acsar_gym.evaluation import episodes as evaluation
from acsar_gym.evaluation import metrics, report
from acsar_gym.evaluation.results import track
from acsar_gym.policies import OnnxPolicy


def caption(robot: str | None, multiplier: float) -> str:
    env = PointGoalEnv("planar", robot=robot)
    config = env.robot.config.with_(wheel_separation_multiplier=multiplier)
    env = PointGoalEnv("planar", robot=config)
    found = list(track("test", evaluation.episodes(env, OnnxPolicy("point_goal"), 3, 0), 3))
    env.close()
    table = report.summary_table("test", [("planar", metrics.summarise(found))])
    return str(table.caption or "")


def test_a_robot_whose_odometry_is_far_off_is_pointed_out() -> None:
    assert "calibrate" in caption(None, 1.0)
    assert caption(None, 1.5378) == ""


def test_the_table_of_a_simulated_barn_run_fits_in_160_columns() -> None:
    env = PointGoalEnv("planar")
    found = list(evaluation.episodes(env, OnnxPolicy("point_goal"), 1, 0))
    env.close()
    summary = dataclasses.replace(
        metrics.summarise(found), timeout_rate=0.5, clearance=0.1, scores={"barn_score": 0.45}
    )
    table = report.summary_table("test", [("planar", summary)])
    assert "clearance" in {column.header for column in table.columns}
    assert Console(width=1000).measure(table).maximum <= 160
