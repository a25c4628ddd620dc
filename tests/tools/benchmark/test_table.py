"""Scores, figures and comparisons of made-up cells, and all forms of the table."""

from __future__ import annotations

import csv
import json
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_tools import SCENES, cell, driven, episode, result_of
from rich.console import Console

from acsar_gym.reading import check_replaceable
from acsar_gym.tools.benchmark import report
from acsar_gym.tools.benchmark.plan import score_episode
from acsar_gym.tools.benchmark.report import CellResult
from acsar_gym.tools.evaluation import metrics
from acsar_gym.tools.evaluation.episode import Episode

SEED_SCORES = ((0.9, 0.8, 0.95, 0.9), (0.9, 0.85, 0.0, 0.9))
BAD = (0.5, 0.0, 0.4, 0.0)
CELLS = {
    **{cell("ours", seed=seed): driven(scores) for seed, scores in enumerate(SEED_SCORES)},
    cell("floor", "baseline"): driven(BAD),
    cell("ours", seed=0, condition="dropped-5"): driven(BAD),
    cell("other", "baseline"): CellResult(refused="other: needs a LiDAR"),
}


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    return result_of(CELLS)


def test_make_result_joins_training_seeds(result: dict[str, Any]) -> None:
    ours = result["rows"][0]
    assert (ours["training_seeds"], ours["episodes"]) == ([0, 1], 8)
    assert (ours["success_rate"], ours["seed_success"]) == (7 / 8, [1.0, 0.75])
    assert ours["score"] == pytest.approx(np.mean(SEED_SCORES))
    assert ours["intervals"]["success_rate"] == list(metrics.wilson_interval(7, 8))
    assert ours["intervals"]["score"] == list(metrics.bootstrap_interval(SEED_SCORES))
    assert set(metrics.FIGURES) == set(ours["intervals"])
    assert ours["differences"]["score"]["difference"] == pytest.approx(6.2 / 8 - 0.225)
    assert report.list_refusals(result) == ["other: needs a LiDAR"]
    assert json.loads(json.dumps(result, allow_nan=False)) == result


def test_bootstrap_interval_contains_the_spread_of_seeds() -> None:
    """Two seeds, of which one always succeeds and the other never."""
    scores = np.array([[1.0] * 50, [0.0] * 50])
    assert metrics.bootstrap_interval(scores) == (0.0, 1.0)
    low, high = metrics.bootstrap_interval(scores.reshape(1, -1))
    assert 0.3 < low < high < 0.7
    assert metrics.bootstrap_interval([[1.0, math.nan], [math.nan, math.nan]]) == (1.0, 1.0)


def test_make_result_compares_with_the_best_baseline_of_each_figure() -> None:
    """A baseline is slow, another is fast but fails once. A privileged agent is none."""
    agents = {
        ("ours", "learned"): (0.8, 0.8, 0.8, 0.0),
        ("slow", "baseline"): (0.2, 0.2, 0.2, 0.2),
        ("fast", "baseline"): (0.7, 0.7, 0.7, 0.0),
        ("seer", "privileged"): (1.0, 1.0, 1.0, 1.0),
    }
    compared = result_of({cell(*agent): driven(scores) for agent, scores in agents.items()})
    rows = {row["agent"]: row["differences"] for row in compared["rows"]}
    assert list(rows) == ["seer", "ours", "fast", "slow"]
    assert {name: (d["over"], round(d["difference"], 6)) for name, d in rows["ours"].items()} == {
        "score": ("fast", 0.075),
        "success": ("slow", -0.25),
    }
    assert rows["fast"]["score"] is None


@pytest.mark.parametrize(
    ("name", "changes", "score"),
    [
        ("completion_time", {}, 0.5),  # 1 m in 4 s instead of 2 s
        ("completion_time", {"ended": 2.0}, 1.0),
        ("completion_time", {"shortest": math.nan}, 1.0),
        ("completion_time", {"success": False}, 0.0),
        ("cross_track", {"cross_track": 0.01}, 0.9),
        ("laps", {"told": {"laps": 3.0}}, 3.0),
    ],
)
def test_score_episode(name: str, changes: dict[str, Any], score: float) -> None:
    ended = Episode(success=True, collision=False, started=1.0, ended=5.0, shortest=1.15)
    measured = score_episode(replace(ended, **changes), name, top_speed=0.5, tolerance=0.15)
    assert measured == pytest.approx(score)


def test_result_table(result: dict[str, Any]) -> None:
    console = Console(width=300)
    with console.capture() as capture:
        console.print(report.result_table(result))
    text = capture.get()
    for words in ("87.5 (52.9 to 97.8)", "+37.5 (-37.5 to +100.0) over floor", "dropped-5"):
        assert words in text
    assert "nan" not in text.lower()
    assert "ran into people" not in text  # nobody moves


def test_main_cells_have_collisions_with_people() -> None:
    """The robot runs into a person, and a person into the robot, which is no collision."""
    episodes = [episode(number, person_contact=2.0 - number) for number in range(2)]
    (row,) = result_of({cell("ours"): CellResult(episodes)})["rows"]
    assert report.main_cells(row)["ran into people [%]"] == "50.0 (9.5 to 90.5)"


def test_write_csv_latex_and_figure(result: dict[str, Any], tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    report.write_csv(table, result)
    with table.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    check_replaceable(table, report.CSV_MARK)
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
        check_replaceable(tmp_path / name, report.FIGURE_MARKS[name[-4:]])
        assert (tmp_path / name).stat().st_size > 5000


def test_write_csv_and_figure_of_no_rows_or_unknown_scores(tmp_path: Path) -> None:
    refused = result_of({cell("other", "baseline"): CellResult(refused="needs a LiDAR")})
    report.write_csv(tmp_path / "table.csv", refused)
    check_replaceable(tmp_path / "table.csv", report.CSV_MARK)

    # A score that the task doesn't know at the end.
    unknown = result_of({cell("ours"): driven((math.nan, math.nan))})
    pytest.importorskip("matplotlib")
    for result in (refused, unknown):
        with warnings.catch_warnings(action="error"):
            report.write_figure(tmp_path / "scores.svg", result)


def test_write_benchmark_page(result: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("plotly")
    path = tmp_path / "page.html"
    report.write_benchmark_page(path, result)
    html = path.read_text(encoding="utf-8")
    sha256 = result["header"]["scenes"][f"{SCENES.id} {SCENES.name}"]["sha256"]
    for words in ("soft SPL", "other: needs a LiDAR", f"sha256 {sha256}"):
        assert words in html
