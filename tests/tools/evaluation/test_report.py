"""Tables and pages of evaluations."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsar_gym.envs import PointGoalEnv
from acsar_gym.tools.evaluation import report
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.episodes import run_episodes
from acsar_gym.tools.evaluation.metrics import summarise_episodes
from acsar_gym.tools.policies import OnnxPolicy


def drive(**changes: float) -> list[Episode]:
    env = PointGoalEnv("planar", robot=changes)
    episodes = list(run_episodes(env, OnnxPolicy("point_goal"), 3, 0))
    env.close()
    return episodes


@pytest.mark.parametrize(("multiplier", "is_off"), [(1.0, True), (1.5378, False)])
def test_summary_table_warns_if_odometry_is_off(multiplier: float, is_off: bool) -> None:
    summary = summarise_episodes(drive(wheel_separation_multiplier=multiplier))
    table = report.summary_table("test", [("planar", summary)], ["A note."])
    assert ("calibrate" in str(table.caption)) == is_off
    assert str(table.caption).startswith("A note.")


def test_summary_table_has_a_line_for_each_figure() -> None:
    rows = [("first", summarise_episodes(drive())), ("second", summarise_episodes(drive()[:1]))]
    figure, first, second = (
        list(column.cells) for column in report.summary_table("", rows).columns
    )
    assert (first[0], second[0]) == ("3/3 (100.0%)", "1/1 (100.0%)")
    place = figure.index("success [%]")
    assert (first[place], second[place]) == ("100.0 (43.9 to 100.0)", "100.0 (20.7 to 100.0)")
    assert {"SPL", "struck [%]", "goal_distance"} < {*figure}
    assert "ran into people [%]" not in figure


def test_write_evaluation_page(tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    path = tmp_path / "page.html"
    episodes = drive()
    report.write_evaluation_page(path, "episodes", summarise_episodes(episodes), episodes)
    html = path.read_text(encoding="utf-8")
    assert "<td>success [%]</td><td>100.0 (43.9 to 100.0)</td>" in html
