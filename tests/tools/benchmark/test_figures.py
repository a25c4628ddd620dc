"""Scores, figures and comparisons of made-up cells, the table and the page."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_tools import SET, cell, driven, episode, plan
from rich.console import Console
from scipy import stats

from acsar_gym.tools.benchmark import figures, report
from acsar_gym.tools.benchmark.cells import CellResult
from acsar_gym.tools.benchmark.figures import (
    Scoring,
    interquartile_mean,
    percentile_interval,
    resample,
    row_means,
    score_episode,
)
from acsar_gym.tools.evaluation import metrics
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.report import fill_columns


def test_the_interquartile_mean_as_rliable_has_it() -> None:
    assert interquartile_mean(np.array([1.0, 2.0, 2.0, 2.0, 1.0, 1.0, 2.0, 1.0])) == 1.5
    assert interquartile_mean(np.array([1.0, 1.0, 2.0, 2.0, 3.0, 3.0])) == 2.0


@pytest.mark.parametrize(
    ("rows", "p"),
    [
        ([[0, 0, 0]], 1.0),
        ([[1] * 6], 2 / 64),
        ([[-1] * 6], 2 / 64),
        ([[1, 1, 1, -1, 0, 0]], 2 * 5 / 16),
        ([[1, -1]], 1.0),
        ([[1] * 6, [1] * 4 + [0] * 2], 2 / 16),  # the less significant seed
        ([[1] * 6, [-1] * 6], 1.0),  # seeds that contradict each other
        ([[1] * 6, [0] * 6], 1.0),
    ],
)
def test_mcnemars_exact_test(rows: list[list[int]], p: float) -> None:
    assert figures.mcnemar_p(np.array(rows, float)) == pytest.approx(p)


def test_the_paired_p_is_that_of_a_paired_t_test_where_there_are_many_scenes() -> None:
    """And few scenes prove nothing, whichever way they all point."""
    rng = np.random.default_rng(3)
    one = rng.normal(0.5, 0.1, 200)
    other = one - rng.normal(0.01, 0.08, 200)
    expected = stats.ttest_rel(one, other).pvalue
    drawn = resample((one - other)[None], row_means)
    assert 0.01 < expected < 0.5
    assert figures.bootstrap_p(drawn, 200) == pytest.approx(expected, abs=0.03)
    assert figures.bootstrap_p(np.ones(2000), 3) == 0.25
    assert figures.bootstrap_p(np.ones(2000), 200) == pytest.approx(2 / 2001)


KINDS = {"ours": "learned", "floor": "baseline", "other": "baseline"}
GOOD, BAD = (0.9, 0.8, 0.95, 0.9), (0.5, 0.0, 0.4, 0.0)
CELLS = [
    driven(cell("ours", 0), GOOD),
    driven(cell("ours", 1), (0.9, 0.85, 0.0, 0.9)),
    driven(cell("floor"), BAD),
    driven(cell("ours", 0, condition="dropped-5"), BAD),
    CellResult(cell("other"), refused="other: needs a LiDAR"),
]


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    made: dict[str, Any] = json.loads(json.dumps(figures.make_result(plan(**KINDS), CELLS)))
    return made


def row(result: dict[str, Any], agent: str, condition: str = "nominal") -> dict[str, Any]:
    (own,) = (
        row for row in result["rows"] if (row["agent"], row["condition"]) == (agent, condition)
    )
    return dict(own)


def test_a_row_holds_all_training_seeds(result: dict[str, Any]) -> None:
    ours = row(result, "ours")
    assert (ours["training_seeds"], ours["episodes"]) == ([0, 1], 8)
    assert ours["success_rate"] == 7 / 8
    assert (ours["success_worst_seed"], ours["success_median_seed"]) == (0.75, 0.875)
    assert ours["success_interval"] == list(metrics.wilson_interval(7, 8))
    scores = np.array([GOOD, (0.9, 0.85, 0.0, 0.9)])
    assert ours["score"] == pytest.approx(scores.mean())
    assert ours["score_iqm"] == pytest.approx(interquartile_mean(scores.ravel()))
    for name, statistic in (("score", row_means), ("score_iqm", interquartile_mean)):
        interval = percentile_interval(resample(scores, statistic))
        assert ours["intervals"][name] == pytest.approx(interval)


def test_the_best_are_compared_and_a_refused_agent_has_no_figures(result: dict[str, Any]) -> None:
    score, success = result["paired"]
    assert (score["figure"], success["figure"]) == ("score", "success")
    assert (score["agent"], score["over"], score["scene_count"]) == ("ours", "floor", 4)
    assert score["values"] == pytest.approx([6.2 / 8, 0.225])
    assert score["difference"] == pytest.approx(6.2 / 8 - 0.225)
    assert row(result, "other")["refused"] == "other: needs a LiDAR"
    assert "success_rate" not in row(result, "other")


def test_each_figure_has_its_own_best_baseline() -> None:
    """One succeeds always but slowly, one is fast but fails once; a privileged agent is none."""
    cells = [
        driven(cell("ours"), (0.8, 0.8, 0.8, 0.0)),
        driven(cell("slow"), (0.2, 0.2, 0.2, 0.2)),
        driven(cell("fast"), (0.7, 0.7, 0.7, 0.0)),
    ]
    cells.append(driven(cell("seer"), (1.0, 1.0, 1.0, 1.0)))
    kinds = {"ours": "learned", "slow": "baseline", "fast": "baseline", "seer": "privileged"}
    made = figures.make_result(plan(**kinds), cells)
    ours = {pair["figure"]: pair for pair in made["paired"] if pair["agent"] == "ours"}
    assert (ours["success"]["over"], ours["success"]["difference"]) == ("slow", -0.25)
    assert ours["score"]["over"] == "fast"
    assert ours["score"]["difference"] == pytest.approx(0.075)


def test_scores_of_the_ids() -> None:
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
    told = replace(ended, told={"laps": 3.0})
    assert score_episode(told, replace(goal, name="laps")) == 3.0
    assert score_episode(replace(told, success=False), replace(goal, name="laps")) == 0.0


def test_the_table_says_it_all(result: dict[str, Any]) -> None:
    console = Console(width=300)
    with console.capture() as capture:
        console.print(report.result_table(result))
    text = capture.get()
    for words in (
        "87.5% (52.9 to 97.8), worst seed 75.0%",
        "+37.5 points (-37.5 to +100.0) over floor, p 1.000",
        "dropped-5",
    ):
        assert words in text
    assert "nan" not in text.lower()
    assert report.list_refusals(result) == ["other: needs a LiDAR"]


def test_who_ran_into_whom_is_told_apart_where_somebody_moves(result: dict[str, Any]) -> None:
    ends = [
        episode(0, person_contact=0.0, closest_person=0.4, time_to_collision=2.0, intrusions=1.0),
        episode(1, 0.0, person_contact=1.0, collision=True, closest_person=0.0),
        episode(2, 0.0, person_contact=2.0, closest_person=0.0),
        episode(3, person_contact=2.0, success=False, closest_person=0.2),
    ]
    crowded = figures.make_result(plan(ours="learned"), [CellResult(cell("ours"), ends)])
    ours = row(crowded, "ours")
    assert (ours["collision_rate"], ours["person_collision_rate"]) == (0.25, 0.25)
    assert (ours["struck_rate"], ours["timeout_rate"]) == (0.5, 0.0)
    assert ours["closest_person"] == pytest.approx(0.15)
    assert ours["intrusion_rate"] == pytest.approx(15.0)  # once in 4 s, of the one that knows it
    ((_, (shown,)),) = report.group_rows(crowded).items()
    assert report.MAIN_COLUMNS["into people"](shown) == "25.0%"
    assert report.MAIN_COLUMNS["struck"](shown) == "50.0%"
    assert report.PAGE_COLUMNS["closest person [cm]"](shown) == "15.0"
    ((_, standing),) = report.group_rows(result).items()
    names = fill_columns(standing, report.PAGE_COLUMNS)
    assert not {"into people", "struck", "closest person [cm]", "intrusions [1/min]"} & set(names)


def test_the_page_has_tables_plots_and_where_it_comes_from(
    result: dict[str, Any], tmp_path: Path
) -> None:
    pytest.importorskip("plotly")
    path = tmp_path / "page.html"
    report.write_benchmark_page(path, result)
    html = path.read_text(encoding="utf-8")
    sha256 = result["header"]["scenes"]["PointGoal-v0"][SET]["sha256"]
    for words in ("score IQM", "other: needs a LiDAR", f"sha256 {sha256}", "Plotly.newPlot"):
        assert words in html
