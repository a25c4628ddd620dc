"""The figures of episodes, of an agent's rows over few training seeds, and comparisons of agents.

The mean score comes first: it counts failures, as the interquartile mean doesn't, which drops the
worst quarter. Agents are compared with the best baseline in pairs of episodes, of the same scene
and seed.

Intervals and probabilities are after Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge
of the Statistical Precipice", NeurIPS 2021. Scores are matrices (seeds, scenes): a row for each
trained policy of an agent, a column for each scene. An agent without training has one row.

In the bootstrap seeds are resampled, and scenes too (their `task_bootstrap`), because the scenes
are a sample of what a generator makes. A drawn seed keeps its scores in all drawn scenes: one
trained policy drove them all, so its scores aren't independent of each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from acsar_gym.errors import ConfigError, require_extra, show_value, suggest_name
from acsar_gym.tasks import Task
from acsar_gym.tasks.factory import task_name
from acsar_gym.tasks.navigation import BARN_SCORES
from acsar_gym.tasks.task import info_names, says_shortest_path
from acsar_gym.tools.benchmark.plan import BASELINE, LEARNED, NOMINAL
from acsar_gym.tools.benchmark.store import Cell, EpisodeRecord, Part
from acsar_gym.tools.evaluation import metrics
from acsar_gym.tools.evaluation.episodes import EpisodeResult
from acsar_gym.tools.evaluation.metrics import (
    Floats,
    Interval,
    percentile_interval,
    resample,
    row_means,
    stratified_interval,
)

TAUS = tuple(np.linspace(0.0, 1.0, 21).round(2).tolist())
"""Thresholds of performance profiles."""
WORST_CROSS_TRACK = 0.1
"""Mean cross-track error at which following a path scores nothing [m]."""
Place = tuple[str, str, str, str]
"""Id, set of scenes, link and condition, which the rows to be compared share."""


COMPLETION_TIME, CROSS_TRACK, SUCCESS = "completion_time", "cross_track", "success"
"""Names of scores that every task has; others are names of what a task tells."""


@dataclass(frozen=True, slots=True)
class Scoring:
    """What the score of an episode depends on besides its result."""

    name: str
    """COMPLETION_TIME, CROSS_TRACK, SUCCESS, or one of the numbers that the task tells."""
    top_speed: float
    """Of the robot [m/s]."""
    tolerance: float
    """Distance to the goal that is a success [m]."""

    def check(self, task: Task) -> None:
        """Raise ConfigError where a task doesn't tell the number that is to be the score."""
        if self.name == COMPLETION_TIME and not says_shortest_path(task):
            raise ConfigError(
                f"{task_name(task)}: score {COMPLETION_TIME!r}: the task has no method "
                "shortest_path(): write one, or score 'success'"
            )
        known = (COMPLETION_TIME, CROSS_TRACK, SUCCESS, *info_names(task))
        if self.name not in known:
            raise ConfigError(
                f"{task_name(task)}: score {show_value(self.name)}{suggest_name(self.name, known)}"
            )


def record_episode(result: EpisodeResult, scene: int, scoring: Scoring) -> EpisodeRecord:
    """Flatten a result.

    Args:
        result: of the episode.
        scene: its number.
        scoring: how it is scored.
    """
    scores = dict(zip(BARN_SCORES, result.scores, strict=False))
    own: dict[str, Any] = {
        "scene": scene,
        "seed": result.seed or 0,
        "score": score_episode(result, scoring),
        "steps": result.length,
        "barn_score": scores.get("barn_score", math.nan),
        "barn_score_own": scores.get("barn_score_own", math.nan),
    }
    same = (each.name for each in fields(EpisodeRecord) if each.name not in own)
    return EpisodeRecord(**own, **{name: getattr(result, name) for name in same})


def score_episode(result: EpisodeResult, scoring: Scoring) -> float:
    """Return the score of an episode, 0 without success.

    COMPLETION_TIME is success weighted by completion time (Yokoyama, Ha & Batra 2021): T* / max(T,
    T*), where T is the time that it took, and T* that of the shortest path, up to the goal's
    tolerance, at the robot's top speed; 1 where the shortest path isn't known. CROSS_TRACK is 1 -
    mean cross-track error / 10 cm, SUCCESS 1. Any other name is that of a number which the task
    tells at the end, such as "barn_score".
    """
    if not result.success:
        return 0.0
    if scoring.name == CROSS_TRACK:
        return max(0.0, 1.0 - result.cross_track / WORST_CROSS_TRACK)
    if scoring.name not in (COMPLETION_TIME, SUCCESS):
        return result.told[scoring.name]
    if scoring.name == SUCCESS or math.isnan(result.shortest):
        return 1.0
    fastest = max(result.shortest - scoring.tolerance, 0.0) / scoring.top_speed
    return fastest / max(result.time, fastest, 1e-9)


RECORD_FIGURES: dict[str, Callable[[Any], float]] = {
    **{
        name: metrics.EPISODE_RATES[name]
        for name in ("success_rate", "collision_rate", "fault_rate")
    },
    **{name: each for name, each in metrics.EPISODE_FIGURES.items() if name != "length"},
    "score": lambda e: e.score,
    "barn_score": lambda e: e.barn_score,
    "barn_score_own": lambda e: e.barn_score_own,
    "late_ticks": lambda e: e.late_ticks,
}
"""Values of an `EpisodeRecord` whose means over episodes are given, units as in `metrics.Summary`;
NaN where it has none."""


def summarise_records(episodes: Sequence[EpisodeRecord]) -> dict[str, Any]:
    """Return the mean of every figure over the episodes that have it, None where none has.

    `success_interval` is Wilson's.
    """
    means = {
        name: metrics.finite_mean(float(value(each)) for each in episodes)
        for name, value in RECORD_FIGURES.items()
    }
    wins = sum(each.success for each in episodes)
    interval = metrics.wilson_interval(wins, len(episodes))
    told = {"episodes": len(episodes), **means, "success_interval": interval}
    cleaned: dict[str, Any] = metrics.replace_nonfinite(told)
    return cleaned


@dataclass
class CellResult:
    """All finished episodes of a cell, in the order of the scenes."""

    cell: Cell
    episodes: list[EpisodeRecord] = field(default_factory=list)
    seconds: float = 0.0
    refused: str = ""


@dataclass
class AgentRow:
    """A row of the table: an agent's figures at a place, over all its training seeds."""

    agent: str
    kind: str
    place: Place
    seeds: list[CellResult] = field(default_factory=list)

    @property
    def driven(self) -> list[CellResult]:
        """The seeds that drove."""
        return [each for each in self.seeds if each.episodes]

    @property
    def scenes(self) -> list[int]:
        """Numbers of the scenes that all seeds drove."""
        driven = [{episode.scene for episode in each.episodes} for each in self.driven]
        return sorted(set.intersection(*driven)) if driven else []

    def matrix(self, figure: str, scenes: Sequence[int] | None = None) -> Floats:
        """(seeds, scenes) of a field of `EpisodeRecord`, by default of all common scenes."""
        columns = self.scenes if scenes is None else scenes
        rows = []
        for each in self.driven:
            values = {one.scene: float(getattr(one, figure)) for one in each.episodes}
            rows.append([values[scene] for scene in columns])
        return np.array(rows).reshape(len(rows), len(columns))

    def mean(self, figure: str) -> float:
        """Mean of a field of `EpisodeRecord` over all seeds and scenes."""
        return float(self.matrix(figure).mean())

    def as_dict(self) -> dict[str, Any]:
        """Return the figures with their intervals, for JSON.

        Stratified bootstrap intervals; of all but the score under nominal conditions only.
        """
        env_id, scenes, link, condition = self.place
        told: dict[str, Any] = {
            "agent": self.agent,
            "kind": self.kind,
            "id": env_id,
            "scenes": scenes,
            "link": link,
            "condition": condition,
            "refused": "" if self.driven else self.seeds[0].refused,
        }
        if not self.driven:
            return told
        score, rates = self.matrix("score"), self.matrix("success").mean(axis=1)
        intervals = {
            "score": stratified_interval(score, row_means),
            "score_iqm": stratified_interval(score, interquartile_mean),
        }
        fields = {"success_rate": "success", "spl": "spl", "barn_score_own": "barn_score_own"}
        for name, figure in fields.items():
            values = self.matrix(figure)
            if condition == NOMINAL and np.isfinite(values).all():
                intervals[name] = stratified_interval(values, row_means)
        return told | {
            "training_seeds": [each.cell.training_seed for each in self.driven],
            "scene_count": score.shape[1],
            **summarise_records([episode for each in self.driven for episode in each.episodes]),
            "success_worst_seed": float(rates.min()),
            "success_median_seed": float(np.median(rates)),
            "score_iqm": float(interquartile_mean(score.ravel())),
            "intervals": intervals,
            "profile": performance_profile(score),
        }


def group_cells(parts: Iterable[Part]) -> list[CellResult]:
    """Put the parts of each cell together."""
    found: dict[Cell, CellResult] = {}
    for part in sorted(parts, key=lambda part: part.first):
        cell = found.setdefault(part.cell, CellResult(part.cell))
        cell.episodes += part.episodes
        cell.seconds += part.seconds
        cell.refused = cell.refused or part.refused
    return list(found.values())


def group_rows(found: Sequence[CellResult], kinds: Mapping[str, str]) -> list[AgentRow]:
    """Group cells by agent and place; `kinds` is "learned" or "baseline" by agent."""
    grouped: dict[tuple[str, Place], AgentRow] = {}
    for each in found:
        cell = each.cell
        place = cell.id, cell.scenes, cell.link, cell.condition
        row = AgentRow(cell.agent, kinds.get(cell.agent, LEARNED), place)
        grouped.setdefault((cell.agent, place), row).seeds.append(each)
    return list(grouped.values())


def interquartile_mean(rows: Floats) -> Floats:
    """Return the mean of the middle half of each row (..., n), a 25 % trimmed mean."""
    count = rows.shape[-1]
    cut = count // 4
    trimmed: Floats = np.sort(rows, axis=-1)[..., cut : count - cut].mean(axis=-1)
    return trimmed


def performance_profile(scores: ArrayLike, taus: Sequence[float] = TAUS) -> list[float]:
    """Return the share of runs, over seeds and scenes, whose score is above each threshold."""
    flat = np.asarray(scores, np.float64).ravel()
    return [float((flat > tau).mean()) for tau in taus]


def probability_of_improvement(x: ArrayLike, y: ArrayLike) -> float:
    """Return the probability that a run of X scores more than a run of Y in the same scene.

    The mean over scenes of the Mann-Whitney U statistic divided by the number of pairs; equal
    scores count half.

    Args:
        x: (seeds of X, scenes).
        y: (seeds of Y, scenes), of the same scenes.
    """
    return float(_compare_scores(x, y).mean())


def _compare_scores(x: ArrayLike, y: ArrayLike) -> Floats:
    """(seeds of X, seeds of Y, scenes): 1 where X scores more, 0.5 where both are equal."""
    ours, others = np.asarray(x, np.float64)[:, None], np.asarray(y, np.float64)[None]
    better: Floats = (ours > others) + 0.5 * (ours == others)
    return better


def improvement_interval(x: Floats, y: Floats) -> Interval:
    """Return the 95 % interval of `probability_of_improvement`.

    Seeds of X and Y are resampled apart, the scenes together, as both drove the same ones.
    """
    rng = np.random.default_rng(0)
    better = _compare_scores(x, y)
    ours, others, scenes = (
        rng.multinomial(size, np.full(size, 1.0 / size), metrics.BOOTSTRAP_SAMPLES) / size
        for size in better.shape
    )  # how often each was drawn, as shares
    drawn = np.einsum("ri,rj,rk,ijk->r", ours, others, scenes, better, optimize=True)
    return metrics.percentile_interval(drawn)


COMPARED_FIGURES = ("score", "success")
"""Fields of `EpisodeRecord` by whose means agents are compared."""


def compare_with_best(some: Iterable[AgentRow]) -> list[dict[str, Any]]:
    """Compare the agents of each nominal place with its best baseline, in pairs of episodes.

    Each figure has its own best baseline: the one with the highest score may not be the one that
    succeeds most often. Of those that succeed equally often it is the one with the highest score.
    """
    found = []
    for place, group in _group_by_place(some).items():
        baselines = [row for row in group if row.kind == BASELINE]
        for figure in COMPARED_FIGURES if baselines else ():
            best = max(baselines, key=lambda row: row.mean(figure))
            for row in group:
                pair = compare_pair(row, best, figure)
                if row is not best and pair:
                    told = {"agent": row.agent, "kind": row.kind, "over": best.agent}
                    found.append({**_describe_place(place), **told, "figure": figure, **pair})
    return found


def compare_pair(row: AgentRow, other: AgentRow, figure: str) -> dict[str, Any]:
    """Return the mean difference of two agents in the scenes that both drove.

    Args:
        row: an agent, of one or several training seeds.
        other: a baseline, which has one row of episodes.
        figure: "score" or "success".

    Returns:
        `values` of both, `difference`, its `interval` of 95 % by the paired bootstrap over scenes
        and training seeds, and `p`, the probability of a difference as large if there were none:
        of the score from the same bootstrap, of success by McNemar's exact test. Nothing where they
        drove no scene in common, as in a benchmark that isn't finished.
    """
    common = sorted({*row.scenes} & {*other.scenes})
    if not common:
        return {}
    ours, others = (each.matrix(figure, common) for each in (row, other))
    differences = ours - others[:1]
    drawn = resample(differences, row_means)
    return {
        "scene_count": len(common),
        "values": [float(ours.mean()), float(others.mean())],
        "difference": float(differences.mean()),
        "interval": percentile_interval(drawn),
        "p": mcnemar_p(differences) if figure == "success" else bootstrap_p(drawn, len(common)),
    }


def bootstrap_p(drawn: Floats, scenes: int) -> float:
    """Return the two-sided p of no difference: twice the share of draws on the rarer side of 0.

    Neither share is below 1 / (draws + 1) (Davison & Hinkley 1997, section 4.2.3), and p not below
    2 / 2^scenes, that of scenes which all differ in one direction: few scenes prove nothing.
    """
    shares = [(1.0 + side.sum()) / (1.0 + drawn.size) for side in (drawn <= 0.0, drawn >= 0.0)]
    return float(min(1.0, max(2.0 * min(shares), 2.0 ** (1 - scenes))))


def mcnemar_p(differences: Floats) -> float:
    """Return the p of McNemar's exact test, which counts the scenes where one alone succeeded.

    Args:
        differences: (seeds, scenes): 1 where the first alone succeeded, -1 where the other one did.

    Returns:
        Two-sided p. Episodes of several training seeds in one scene aren't independent, so each
        seed is tested on its own, and on either side the largest of their p counts.
    """
    with require_extra("a benchmark", "scipy"):
        from scipy.stats import binomtest  # noqa: PLC0415 - slow to import

    sides = []
    for side in ("greater", "less"):
        each = []
        for row in differences:
            won, lost = int((row > 0.0).sum()), int((row < 0.0).sum())
            each.append(binomtest(won, won + lost, alternative=side).pvalue if won + lost else 1.0)
        sides.append(max(each))
    return float(min(1.0, 2.0 * min(sides)))


def compare_pairs(some: Iterable[AgentRow]) -> list[dict[str, Any]]:
    """Return the probability that each learned agent improves on each other agent, by score."""
    found = []
    for place, group in _group_by_place(some).items():
        for ours in (row for row in group if row.kind == LEARNED):
            for other in (row for row in group if row is not ours):
                common = sorted({*ours.scenes} & {*other.scenes})
                if not common:
                    continue
                x, y = ours.matrix("score", common), other.matrix("score", common)
                found.append(
                    {
                        **_describe_place(place),
                        "agent": ours.agent,
                        "over": other.agent,
                        "probability": probability_of_improvement(x, y),
                        "interval": improvement_interval(x, y),
                    }
                )
    return found


def _describe_place(place: Place) -> dict[str, Any]:
    return dict(zip(("id", "scenes", "link"), place, strict=False))


def _group_by_place(some: Iterable[AgentRow]) -> dict[Place, list[AgentRow]]:
    """Group the rows that drove under nominal conditions by place, the best score first."""
    found: dict[Place, list[AgentRow]] = {}
    for row in some:
        if row.scenes and row.place[3] == NOMINAL:
            found.setdefault(row.place, []).append(row)
    for group in found.values():
        group.sort(key=lambda row: -row.mean("score"))
    return found
