"""Figures, comparisons, tables and submissions of made-up cells."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmark_tools import ENV_ID, SET, cell, part, plan

from acsar_gym.errors import ConfigError
from acsar_gym.tools.benchmark import figures, result
from acsar_gym.tools.benchmark.figures import (
    Scoring,
    record_episode,
    score_episode,
    summarise_records,
)
from acsar_gym.tools.benchmark.store import Part, Store
from acsar_gym.tools.benchmark.table import format_tables
from acsar_gym.tools.evaluation import metrics
from acsar_gym.tools.evaluation.episodes import EpisodeResult

KINDS = {"ours": "learned", "floor": "baseline", "other": "baseline"}
GOOD, BAD = (0.9, 0.8, 0.95, 0.9), (0.5, 0.0, 0.4, 0.0)
PARTS = [
    part(cell("ours", 0), GOOD),
    part(cell("ours", 1), (0.9, 0.85, 0.0, 0.9)),
    part(cell("floor"), BAD[:2]),
    part(cell("floor"), BAD[2:], first=2),
    part(cell("ours", 0, condition="dropped-5"), BAD),
    Part(cell("other"), 0, refused="other: needs a LiDAR"),
]


@pytest.fixture(scope="module")
def told() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(json.dumps(result.make_result(plan(**KINDS), PARTS)))
    return found


def row(told: dict[str, Any], agent: str, condition: str = "nominal") -> dict[str, Any]:
    (found,) = (
        row for row in told["rows"] if (row["agent"], row["condition"]) == (agent, condition)
    )
    return dict(found)


def test_a_row_holds_all_training_seeds(told: dict[str, Any]) -> None:
    ours = row(told, "ours")
    assert (ours["training_seeds"], ours["episodes"], ours["scene_count"]) == ([0, 1], 8, 4)
    assert ours["success_rate"] == 7 / 8
    assert (ours["success_worst_seed"], ours["success_median_seed"]) == (0.75, 0.875)
    assert ours["success_interval"] == list(metrics.wilson_interval(7, 8))
    scores = np.array([GOOD, (0.9, 0.85, 0.0, 0.9)])
    assert ours["score"] == pytest.approx(scores.mean())
    assert ours["intervals"]["score"] == pytest.approx(
        metrics.stratified_interval(scores, metrics.row_means)
    )
    assert ours["score_iqm"] == pytest.approx(figures.interquartile_mean(scores.ravel()))
    assert ours["intervals"]["score_iqm"] == pytest.approx(
        metrics.stratified_interval(scores, figures.interquartile_mean)
    )


def test_the_best_are_compared_and_a_refused_agent_has_no_figures(told: dict[str, Any]) -> None:
    score, success = told["paired"]
    assert (score["figure"], success["figure"]) == ("score", "success")
    assert (score["agent"], score["over"], score["scene_count"]) == ("ours", "floor", 4)
    assert score["values"] == pytest.approx([6.2 / 8, 0.225])
    assert score["difference"] == pytest.approx(6.2 / 8 - 0.225)
    (improved,) = told["improvements"]
    assert improved["probability"] == pytest.approx(7 / 8)
    assert row(told, "other")["refused"] == "other: needs a LiDAR"
    assert "success_rate" not in row(told, "other")


def test_each_figure_has_its_own_best_baseline() -> None:
    """One succeeds always but slowly, one is fast but fails once."""
    parts = [
        part(cell("ours"), (0.8, 0.8, 0.8, 0.0)),
        part(cell("slow"), (0.2, 0.2, 0.2, 0.2)),
        part(cell("fast"), (0.7, 0.7, 0.7, 0.0)),
    ]
    told = result.make_result(plan(ours="learned", slow="baseline", fast="baseline"), parts)
    ours = {one["figure"]: one for one in told["paired"] if one["agent"] == "ours"}
    assert (ours["success"]["over"], ours["success"]["difference"]) == ("slow", -0.25)
    assert ours["score"]["over"] == "fast"
    assert ours["score"]["difference"] == pytest.approx(0.075)


def test_figures_are_those_of_an_evaluation() -> None:
    results = [
        EpisodeResult(True, False, 0.0, 4.0, 1.5, (1, 0, 0), 0.02, 400, 0, 1.4, 0.0, 1.5, 0.3),
        EpisodeResult(False, True, 0.0, 9.0, 2.0, (1, 0, 0), 0.04, 900, 0, 1.9, 0.5, 2.0, 0.5),
    ]
    scoring = Scoring("completion_time", 0.5, 0.15)
    ours = summarise_records([record_episode(each, 0, scoring) for each in results])
    theirs = metrics.summarise_episodes(results)
    names = ["success_rate", "collision_rate", "spl", "soft_spl", "time_to_goal", "path"]
    for name in (*names, "smoothness", "odometry_error", "odometry_drift"):
        assert ours[name] == pytest.approx(getattr(theirs, name)), name
    assert ours["success_interval"] == list(theirs.intervals["success_rate"])


def test_scores_of_the_ids() -> None:
    ended = EpisodeResult(True, False, 1.0, 5.0, 1.5, (1, 0, 0), 0.0, 400, 0, 1.15, 0.0, 2.8)
    goal = Scoring("completion_time", 0.5, 0.15)
    assert score_episode(ended, goal) == pytest.approx(0.5)  # 1 m in 4 s instead of 2 s
    assert score_episode(replace(ended, ended=2.0), goal) == 1.0
    assert score_episode(replace(ended, shortest=0.1), goal) == 0.0
    assert score_episode(replace(ended, success=False), goal) == 0.0
    assert score_episode(replace(ended, shortest=math.nan), goal) == 1.0
    assert score_episode(ended, replace(goal, name="success")) == 1.0
    assert score_episode(replace(ended, success=False), replace(goal, name="success")) == 0.0
    follow = replace(goal, name="cross_track")
    assert score_episode(replace(ended, cross_track=0.01), follow) == pytest.approx(0.9)
    assert score_episode(replace(ended, cross_track=0.3), follow) == 0.0
    told = replace(ended, told={"laps": 3.0})
    assert score_episode(told, replace(goal, name="laps")) == 3.0
    assert score_episode(replace(told, success=False), replace(goal, name="laps")) == 0.0


def test_the_page_says_it_all(told: dict[str, Any]) -> None:
    page = format_tables(told)
    for words in (
        "| 87.5% (52.9 to 97.8), worst seed 75.0%, median 87.5% |",
        "| success | ours | 87.5% : 50.0% | +37.5 points (-37.5 to +100.0) over floor, p 1.000 |",
        "| 5 % of the lines lost | 50.0% (0.571) |",
        "- other: needs a LiDAR",
    ):
        assert words in page
    assert "nan" not in page.lower().replace("nanmean", "")


def test_folders_are_combined(tmp_path: Path) -> None:
    folders = [tmp_path / name for name in ("one", "two")]
    kinds = [{"ours": "learned"}, {"floor": "baseline"}]
    for folder, own, parts in zip(folders, kinds, (PARTS[:2], PARTS[2:4]), strict=True):
        folder.mkdir()
        store = Store(folder)
        store.open(plan(**own))
        for each in parts:
            store.add(each)
    found, parts = result.combine_folders(folders)
    assert list(found["agents"]) == ["ours", "floor"]
    assert repr(parts) == repr(PARTS[:4])
    assert result.make_result(found, parts)["paired"][0]["over"] == "floor"


def combine_with(tmp_path: Path, change: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
    """Combine the folder of a plan with that of the plan after a change."""
    folders = [tmp_path / name for name in ("one", "two")]
    for number, folder in enumerate(folders):
        folder.mkdir()
        told = plan()
        if number:
            change(told)
        Store(folder).open(told)
    return dict(result.combine_folders(folders)[0])


def test_the_largest_number_of_scenes_counts(tmp_path: Path) -> None:
    found = combine_with(tmp_path, lambda told: told["scenes"][ENV_ID][SET].update(count=4))
    assert found["scenes"][ENV_ID][SET]["count"] == 4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda told: told["scenes"][ENV_ID][SET].update(sha256="0" * 64),
            f"{ENV_ID} {SET}",
        ),
        (
            lambda told: told["agents"]["packaged"][0].update(sha256="0" * 64),
            f"packaged on {ENV_ID}",
        ),
    ],
)
def test_other_scenes_and_policies_are_not_combined(
    change: Callable[[dict[str, Any]], object], said: str, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=said):
        combine_with(tmp_path, change)


def test_links_are_compared_in_the_scenes_that_all_drove() -> None:
    parts = [
        part(cell("ours"), (0.9, 0.0, 0.0, 0.9)),
        part(cell("ours", link="port"), (0.9, 0.8)),
        part(cell("floor"), (0.5, 0.5)),
    ]
    page = format_tables(result.make_result(plan(ours="learned", floor="baseline"), parts))
    _, _, compared = page.partition("## The same agents behind other links")
    assert "| PointGoal-v0 | open/acsar | ours | 2 | 50.0% | 100.0% |" in compared
    assert "floor" not in compared
