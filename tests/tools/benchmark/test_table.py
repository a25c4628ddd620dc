"""Scores, figures and comparisons of made-up cells, and all forms of the table."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_tools import SCENES, cell, driven, episode, result_of
from rich.console import Console

from acsar_gym.tools.benchmark import report
from acsar_gym.tools.benchmark.figures import Scoring, score_episode
from acsar_gym.tools.benchmark.table import CellResult
from acsar_gym.tools.evaluation import metrics
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.report import format_figure

GOOD = (0.9, 0.8, 0.95, 0.9)
OTHER_SEED = (0.9, 0.85, 0.0, 0.9)
BAD = (0.5, 0.0, 0.4, 0.0)
CELLS = {
    cell("ours", seed=0): driven(GOOD),
    cell("ours", seed=1): driven(OTHER_SEED),
    cell("floor", "baseline"): driven(BAD),
    cell("ours", seed=0, condition="dropped-5"): driven(BAD),
    cell("other", "baseline"): CellResult(refused="other: needs a LiDAR"),
}


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return result_of(CELLS)


def find_row(result: dict[str, Any], agent: str, condition: str = "nominal") -> dict[str, Any]:
    (row,) = (
        row for row in result["rows"] if (row["agent"], row["condition"]) == (agent, condition)
    )
    return dict(row)


def test_make_result_joins_training_seeds(result: dict[str, Any]) -> None:
    ours = find_row(result, "ours")
    scores = np.array([GOOD, OTHER_SEED])
    assert (ours["training_seeds"], ours["episodes"]) == ([0, 1], 8)
    assert ours["success_rate"] == 7 / 8
    assert ours["seed_success"] == [1.0, 0.75]
    assert ours["score"] == pytest.approx(scores.mean())
    assert ours["intervals"]["success_rate"] == list(metrics.wilson_interval(7, 8))
    assert ours["intervals"]["score"] == list(metrics.bootstrap_interval(scores))
    assert set(metrics.FIGURES) == set(ours["intervals"])
    assert report.list_refusals(result) == ["other: needs a LiDAR"]


def test_bootstrap_interval_contains_the_spread_of_seeds() -> None:
    """Two seeds of which one always succeeds, and the other never."""
    apart = np.array([[1.0] * 50, [0.0] * 50])
    assert metrics.bootstrap_interval(apart) == (0.0, 1.0)
    low, high = metrics.bootstrap_interval(apart.T.reshape(1, -1))
    assert 0.3 < low < high < 0.7
    assert metrics.bootstrap_interval([[1.0, math.nan], [math.nan, math.nan]]) == (1.0, 1.0)


def test_make_result_compares_with_the_best_baseline_of_each_figure(result: dict[str, Any]) -> None:
    """One succeeds always but slowly, one is fast but fails once; a privileged agent is none."""
    compared = result_of(
        {
            cell("ours"): driven((0.8, 0.8, 0.8, 0.0)),
            cell("slow", "baseline"): driven((0.2, 0.2, 0.2, 0.2)),
            cell("fast", "baseline"): driven((0.7, 0.7, 0.7, 0.0)),
            cell("seer", "privileged"): driven((1.0, 1.0, 1.0, 1.0)),
        }
    )
    differences = find_row(compared, "ours")["differences"]
    assert differences["success"]["over"] == "slow"
    assert differences["success"]["difference"] == -0.25
    assert differences["score"]["over"] == "fast"
    assert differences["score"]["difference"] == pytest.approx(0.075)
    assert find_row(compared, "fast")["differences"]["score"] is None
    score = find_row(result, "ours")["differences"]["score"]
    assert score["difference"] == pytest.approx(6.2 / 8 - 0.225)


def test_score_episode() -> None:
    ended = Episode(success=True, collision=False, started=1.0, ended=5.0, shortest=1.15)
    goal = Scoring("completion_time", 0.5, 0.15)
    assert score_episode(ended, goal) == pytest.approx(0.5)  # 1 m in 4 s instead of 2 s
    assert score_episode(replace(ended, ended=2.0), goal) == 1.0
    assert score_episode(replace(ended, shortest=0.1), goal) == 0.0
    assert score_episode(replace(ended, success=False), goal) == 0.0
    assert score_episode(replace(ended, shortest=math.nan), goal) == 1.0
    assert score_episode(ended, replace(goal, name="success")) == 1.0
    follow = replace(goal, name="cross_track")
    assert score_episode(replace(ended, cross_track=0.01), follow) == pytest.approx(0.9)
    assert score_episode(replace(ended, cross_track=0.3), follow) == 0.0
    reported = replace(ended, told={"laps": 3.0})
    assert score_episode(reported, replace(goal, name="laps")) == 3.0
    assert score_episode(replace(reported, success=False), replace(goal, name="laps")) == 0.0


def test_result_table(result: dict[str, Any]) -> None:
    console = Console(width=300)
    with console.capture() as capture:
        console.print(report.result_table(result))
    text = capture.get()
    for words in ("87.5 (52.9 to 97.8)", "+37.5 (-37.5 to +100.0) over floor", "dropped-5"):
        assert words in text
    assert "nan" not in text.lower()


def test_main_cells_have_collisions_with_people_if_somebody_moves(result: dict[str, Any]) -> None:
    ends = [
        episode(0, person_contact=0.0, closest_person=0.4, time_to_collision=2.0, intrusions=1.0),
        episode(1, 0.0, person_contact=1.0, collision=True, closest_person=0.0),
        episode(2, 0.0, person_contact=2.0, closest_person=0.0),
        episode(3, person_contact=2.0, success=False, closest_person=0.2),
    ]
    ours = find_row(result_of({cell("ours"): CellResult(ends)}), "ours")
    assert (ours["collision_rate"], ours["person_collision_rate"]) == (0.25, 0.25)
    assert (ours["struck_rate"], ours["timeout_rate"]) == (0.5, 0.0)
    assert ours["intrusion_rate"] == pytest.approx(15.0)  # once in 4 s, of the one that knows it
    column = "ran into people [%]"
    assert report.main_cells(ours)[column] == "25.0 (4.6 to 69.9)"
    assert format_figure(ours, "closest_person") == "15.00 (0.00 to 30.00)"
    nobody = find_row(result_of({cell("ours"): CellResult([*ends[:1], ends[3]])}), "ours")
    assert report.main_cells(nobody)[column] == "0.0 (0.0 to 65.8)"
    assert not report.main_cells(find_row(result, "ours"))[column]


def test_write_csv_latex_and_figure(result: dict[str, Any], tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    report.write_csv(table, result)
    with table.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["agent"] for row in rows] == ["ours", "floor", "ours"]
    assert float(rows[0]["score_low"]) < float(rows[0]["score"]) < float(rows[0]["score_high"])
    assert (rows[0]["score_over"], rows[1]["score_over"], rows[0]["clearance"]) == ("floor", "", "")

    latex = tmp_path / "table.tex"
    report.write_latex(latex, result)
    lines = latex.read_text(encoding="utf-8").splitlines()
    assert lines[1:3] == ["\\begin{tabular}{llllrrrrrr}", "\\toprule"]
    assert "success [\\%]" in lines[3]
    assert len({line.count(" & ") for line in lines if line.endswith("\\\\")}) == 1

    pytest.importorskip("matplotlib")
    for name in ("scores.svg", "scores.pdf"):
        report.write_figure(tmp_path / name, result)
        assert (tmp_path / name).stat().st_size > 5000


def test_write_benchmark_page(result: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    path = tmp_path / "page.html"
    report.write_benchmark_page(path, result)
    html = path.read_text(encoding="utf-8")
    sha256 = result["header"]["scenes"][f"{SCENES.id} {SCENES.name}"]["sha256"]
    for words in ("soft SPL", "other: needs a LiDAR", f"sha256 {sha256}"):
        assert words in html
    assert json.loads(json.dumps(result, allow_nan=False)) == result
