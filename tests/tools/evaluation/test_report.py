"""What the tables say."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsar_gym.envs import PointGoalEnv
from acsar_gym.tools.evaluation import episodes as evaluation
from acsar_gym.tools.evaluation import metrics, report
from acsar_gym.tools.policies import OnnxPolicy


def caption(robot: str | None, multiplier: float) -> str:
    env = PointGoalEnv("planar", robot=robot)
    config = env.robot.config.with_(wheel_separation_multiplier=multiplier)
    env = PointGoalEnv("planar", robot=config)
    found = list(evaluation.run_episodes(env, OnnxPolicy("point_goal"), 3, 0))
    env.close()
    table = report.summary_table("test", [("planar", metrics.summarise_episodes(found))])
    return str(table.caption or "")


def test_a_robot_whose_odometry_is_far_off_is_pointed_out() -> None:
    assert "calibrate" in caption(None, 1.0)
    assert caption(None, 1.5378) == ""


def test_the_page_of_an_evaluation(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    env = PointGoalEnv("planar")
    driven = list(evaluation.run_episodes(env, OnnxPolicy("point_goal"), 2, 0))
    env.close()
    path = tmp_path / "page.html"
    summary = metrics.summarise_episodes(driven)
    report.write_evaluation_page(path, "two episodes", summary, driven)
    html = path.read_text(encoding="utf-8")
    assert "<td>success [%]</td><td>100.0 (34.2 to 100.0)</td>" in html
