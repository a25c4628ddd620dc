"""Scores of episodes, figures of an agent over few training seeds, and comparisons of agents.

The mean score comes first: it counts failures, as the interquartile mean doesn't, which drops the
worst quarter. Agents are compared with the best baseline in pairs of episodes, of the same scene
and seed.

Intervals are after Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical
Precipice", NeurIPS 2021. Scores are matrices (training seeds, scenes); an agent without training
has one row. In the bootstrap seeds are resampled, and scenes too (their `task_bootstrap`), because
the scenes are a sample of what a generator makes. A drawn seed keeps its scores in all drawn
scenes: one trained policy drove them all, so its scores aren't independent of each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, require_extra, show_value, suggest_name
from acsar_gym.tasks import Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.task import info_names, says_shortest_path
from acsar_gym.tools.benchmark.cells import BENCHMARK_SCHEMA, CellResult
from acsar_gym.tools.benchmark.plan import BASELINE, NOMINAL
from acsar_gym.tools.evaluation import metrics, provenance
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.tools.evaluation.metrics import Interval

Floats = NDArray[np.float64]
Statistic = Callable[[Floats], Floats]
"""Maps rows of values (..., n) to one figure a row (...)."""
MAX_RESAMPLED = 4_000_000  # values that are resampled at once, at most; limits the memory
WORST_CROSS_TRACK = 0.1  # mean cross-track error at which following a path scores nothing [m]
COMPLETION_TIME, CROSS_TRACK, SUCCESS = "completion_time", "cross_track", "success"
"""Names of scores that every task has; others are names of what a task tells."""
COMPARED_FIGURES = ("score", "success")  # fields of `Episode` by whose means agents are compared
PLACE = ("id", "scenes", "link", "condition")  # what rows that are compared share


@dataclass(frozen=True, slots=True)
class Scoring:
    """What the score of an episode depends on besides its result."""

    name: str  # COMPLETION_TIME, CROSS_TRACK, SUCCESS, or one of the numbers that the task tells
    top_speed: float  # of the robot [m/s]
    tolerance: float  # distance to the goal that is a success [m]

    def check(self, task: Task) -> None:
        """Raise ConfigError where a task doesn't tell the number that is to be the score."""
        if self.name == COMPLETION_TIME and not says_shortest_path(task):
            raise ConfigError(
                f"{task_name(task)}: score {COMPLETION_TIME!r}: the task has no method "
                "shortest_path(): write one, or score 'success'"
            )
        scores = (COMPLETION_TIME, CROSS_TRACK, SUCCESS, *info_names(task))
        if self.name not in scores:
            raise ConfigError(
                f"{task_name(task)}: score {show_value(self.name)}{suggest_name(self.name, scores)}"
            )


def score_episode(episode: Episode, scoring: Scoring) -> float:
    """Return the score of an episode, 0 without success.

    COMPLETION_TIME is success weighted by completion time (Yokoyama, Ha & Batra 2021): T* / max(T,
    T*), where T is the time that it took, and T* that of the shortest path, up to the goal's
    tolerance, at the robot's top speed; 1 where the shortest path isn't known. CROSS_TRACK is 1 -
    mean cross-track error / 10 cm, SUCCESS 1. Any other name is that of a number which the task
    tells at the end, such as "barn_score".
    """
    if not episode.success:
        return 0.0
    if scoring.name == CROSS_TRACK:
        return max(0.0, 1.0 - episode.cross_track / WORST_CROSS_TRACK)
    if scoring.name not in (COMPLETION_TIME, SUCCESS):
        return episode.told[scoring.name]
    if scoring.name == SUCCESS or math.isnan(episode.shortest):
        return 1.0
    fastest = max(episode.shortest - scoring.tolerance, 0.0) / scoring.top_speed
    return fastest / max(episode.time, fastest, 1e-9)


def summarise_cells(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return the mean of every figure over the episodes that have it, NaN where none has."""
    wins = sum(episode.success for episode in episodes)
    return {
        "episodes": len(episodes),
        **metrics.average_figures(episodes),
        "score": metrics.finite_mean(episode.score for episode in episodes),
        "late_ticks": metrics.finite_mean(episode.late_ticks for episode in episodes),
        "told": metrics.average_told(episodes),
        "success_interval": metrics.wilson_interval(wins, len(episodes)),
    }


@dataclass
class AgentRow:
    """A row of the table: an agent's figures at a place, over all its training seeds."""

    agent: str
    kind: str
    place: tuple[str, ...]  # the values of PLACE
    cells: list[CellResult] = field(default_factory=list)

    @property
    def driven(self) -> list[CellResult]:
        """The training seeds that drove."""
        return [cell for cell in self.cells if cell.episodes]

    def matrix(self, figure: str) -> Floats:
        """(training seeds, scenes) of a field of `Episode`."""
        return np.array(
            [[float(getattr(episode, figure)) for episode in cell.episodes] for cell in self.driven]
        )

    def as_dict(self) -> dict[str, Any]:
        """Return the figures with their intervals, for JSON."""
        about = {
            "agent": self.agent,
            "kind": self.kind,
            **dict(zip(PLACE, self.place, strict=True)),
            "refused": "" if self.driven else self.cells[0].refused,
        }
        if not self.driven:
            return about
        score, rates = self.matrix("score"), self.matrix("success").mean(axis=1)
        statistics = {"score": row_means, "score_iqm": interquartile_mean}
        return about | {
            "training_seeds": [cell.cell.training_seed for cell in self.driven],
            **summarise_cells([episode for cell in self.driven for episode in cell.episodes]),
            "success_worst_seed": float(rates.min()),
            "success_median_seed": float(np.median(rates)),
            "score_iqm": float(interquartile_mean(score.ravel())),
            "intervals": {
                name: percentile_interval(resample(score, statistic))
                for name, statistic in statistics.items()
            },
        }


def make_result(plan: Mapping[str, Any], cells: Sequence[CellResult]) -> dict[str, Any]:
    """Compute the content of `benchmark.json`.

    Args:
        plan: as `BenchmarkPlan.as_dict`.
        cells: the finished ones.

    Returns:
        | key | content |
        |---|---|
        | `schema` | `BENCHMARK_SCHEMA` |
        | `header` | `versions`, and the plan: `scenes`, by id and set (`robot`, `score`, |
        | | `sha256`, ...); `agents`, by name; `conditions`, by name; `links`; `port_scenes` |
        | `cells` | a list: the fields of `Cell`, `refused` (why it couldn't be run, else ""), |
        | | `seconds`, `episodes`: for each field of `Episode` a list, null for NaN |
        | `rows` | figures over all training seeds of an agent at a place, with `intervals` |
        | `paired` | for each agent but the best baseline of a place: how much more it scores, |
        | | and succeeds, than that baseline in the same scenes; see `compare_pair` |
    """
    kinds = {name: seeds[0]["kind"] for name, seeds in plan["agents"].items()}
    grouped: dict[tuple[str, tuple[str, ...]], AgentRow] = {}
    for cell in cells:
        place = tuple(getattr(cell.cell, name) for name in PLACE)
        row = AgentRow(cell.cell.agent, kinds[cell.cell.agent], place)
        grouped.setdefault((row.agent, place), row).cells.append(cell)
    rows = list(grouped.values())
    header = {
        "versions": provenance.library_versions(*provenance.DRIVING_LIBRARIES),
        **{name: plan[name] for name in ("agents", "scenes", "conditions", "links", "port_scenes")},
    }
    result: dict[str, Any] = metrics.replace_nonfinite(
        {
            "schema": BENCHMARK_SCHEMA,
            "header": header,
            "cells": [cell.as_dict() for cell in cells],
            "rows": [row.as_dict() for row in rows],
            "paired": compare_with_best(rows),
        }
    )
    return result


def row_means(rows: Floats) -> Floats:
    """Return the mean of each row (..., n)."""
    means: Floats = rows.mean(axis=-1)
    return means


def interquartile_mean(rows: Floats) -> Floats:
    """Return the mean of the middle half of each row (..., n)."""
    with require_extra("a benchmark", "scipy"):
        from scipy.stats import trim_mean  # noqa: PLC0415 - slow to import

    return np.asarray(trim_mean(rows, 0.25, axis=-1))


def resample(
    values: Floats, statistic: Statistic, *, resamples: int = metrics.BOOTSTRAP_SAMPLES
) -> Floats:
    """Return a statistic of bootstrap samples, (resamples,).

    Rows and columns are resampled with replacement, which scipy's `bootstrap` doesn't know. A drawn
    row keeps its values in all drawn columns.

    Args:
        values: (rows, columns).
        statistic: of all resampled values together.
        resamples: bootstrap samples.
    """
    rng, samples = np.random.default_rng(0), []
    chunk = max(1, MAX_RESAMPLED // values.size)
    for first in range(0, resamples, chunk):
        count = min(chunk, resamples - first)
        rows, columns = (rng.integers(size, size=(count, size)) for size in values.shape)
        drawn = values[rows[:, :, None], columns[:, None, :]]
        samples.append(statistic(drawn.reshape(count, -1)))
    return np.concatenate(samples)


def percentile_interval(values: Floats) -> Interval:
    """Return the middle 95 % of resampled values."""
    tail = 50.0 * (1.0 - metrics.CONFIDENCE_LEVEL)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)


def compare_with_best(rows: Iterable[AgentRow]) -> list[dict[str, Any]]:
    """Compare the agents of each nominal place with its best baseline, in pairs of episodes.

    Each figure has its own best baseline: the one with the highest score may not be the one that
    succeeds most often. Of those that succeed equally often it is the one with the highest score.
    """
    places: dict[tuple[str, ...], list[AgentRow]] = {}
    for row in rows:
        if row.driven and row.place[3] == NOMINAL:
            places.setdefault(row.place, []).append(row)
    comparisons = []
    for place, group in places.items():
        group.sort(key=lambda row: -row.matrix("score").mean())
        baselines = [row for row in group if row.kind == BASELINE]
        for figure in COMPARED_FIGURES if baselines else ():
            best = max(baselines, key=lambda row: row.matrix(figure).mean())
            comparisons += [
                {
                    **dict(zip(PLACE, place, strict=True)),
                    "agent": row.agent,
                    "kind": row.kind,
                    "over": best.agent,
                    "figure": figure,
                    **compare_pair(row, best, figure),
                }
                for row in group
                if row is not best
            ]
    return comparisons


def compare_pair(row: AgentRow, other: AgentRow, figure: str) -> dict[str, Any]:
    """Return the mean difference of two agents in the scenes that both drove.

    Args:
        row: an agent, of one or several training seeds.
        other: a baseline, which has one row of episodes.
        figure: "score" or "success".

    Returns:
        `values` of both, `difference`, its `interval` of 95 % by the paired bootstrap over scenes
        and training seeds, and `p`, the probability of a difference as large if there were none:
        of the score from the same bootstrap, of success by McNemar's exact test.
    """
    ours, others = row.matrix(figure), other.matrix(figure)
    differences = ours - others[:1]
    drawn = resample(differences, row_means)
    scenes = differences.shape[1]
    return {
        "scene_count": scenes,
        "values": [float(ours.mean()), float(others.mean())],
        "difference": float(differences.mean()),
        "interval": percentile_interval(drawn),
        "p": mcnemar_p(differences) if figure == "success" else bootstrap_p(drawn, scenes),
    }


def bootstrap_p(drawn: Floats, scenes: int) -> float:
    """Return the two-sided p of no difference: twice the share of draws on the rarer side of 0.

    Neither share is below 1 / (draws + 1) (Davison & Hinkley 1997, section 4.2.3), and p not below
    2 / 2^scenes, that of scenes which all differ in one direction: few scenes prove nothing.
    """
    shares = [(1.0 + side.sum()) / (1.0 + drawn.size) for side in (drawn <= 0.0, drawn >= 0.0)]
    return float(min(1.0, max(2.0 * min(shares), 2.0 ** (1 - scenes))))


def mcnemar_p(differences: Floats) -> float:
    """Return the two-sided p of McNemar's exact test of `differences` (seeds, scenes).

    They are 1 where the first alone succeeded, -1 where the other one did. Episodes of several
    training seeds in one scene aren't independent, so each seed is tested on its own, and on either
    side the largest of their p counts.
    """
    with require_extra("a benchmark", "scipy"):
        from scipy.stats import binomtest  # noqa: PLC0415 - slow to import

    sides = []
    for side in ("greater", "less"):
        seeds = []
        for row in differences:
            won, lost = int((row > 0.0).sum()), int((row < 0.0).sum())
            seeds.append(binomtest(won, won + lost, alternative=side).pvalue if won + lost else 1.0)
        sides.append(max(seeds))
    return float(min(1.0, 2.0 * min(sides)))
