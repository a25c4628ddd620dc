"""The figures of episodes, of an agent's rows over few training seeds, and comparisons of agents.

After Agarwal et al. 2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice",
NeurIPS 2021. Scores are matrices (seeds, scenes): a row for each trained policy of an agent, a
column for each scene. An agent without training has one row.

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

from acsar_gym.tasks.navigation import BARN_SCORES
from acsar_gym.tools.benchmark.plan import BASELINE, LEARNED, NOMINAL
from acsar_gym.tools.benchmark.store import Cell, EpisodeRecord, Part
from acsar_gym.tools.evaluation import metrics
from acsar_gym.tools.evaluation.episodes import EpisodeResult
from acsar_gym.tools.evaluation.metrics import Floats, Interval, row_means, stratified_interval

TAUS = tuple(np.linspace(0.0, 1.0, 21).round(2).tolist())
"""Thresholds of performance profiles."""
WORST_CROSS_TRACK = 0.1
"""Mean cross-track error at which following a path scores nothing [m]."""
Place = tuple[str, str, str, str]
"""Id, set of scenes, link and condition, which the rows to be compared share."""


@dataclass(frozen=True, slots=True)
class Scoring:
    """What the score of an episode depends on besides its result."""

    id: str
    """Id of the env, without its namespace."""
    top_speed: float
    """Of the robot [m/s]."""
    tolerance: float
    """Distance to the goal that is a success [m]."""


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
    """Return the score of an episode, 0 to 1, 0 without success.

    For path following 1 - mean cross-track error / 10 cm. Otherwise success weighted by completion
    time (Yokoyama, Ha & Batra 2021): T* / max(T, T*), where T is the time that it took, and T* that
    of the shortest path, up to the goal's tolerance, at the robot's top speed.
    """
    if not result.success:
        return 0.0
    if scoring.id.startswith("PathFollow-"):
        return max(0.0, 1.0 - result.cross_track / WORST_CROSS_TRACK)
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

    def matrix(self, figure: str) -> Floats:
        """(seeds, scenes) of a field of `EpisodeRecord`; as many scenes as all seeds have."""
        every = [[float(getattr(e, figure)) for e in each.episodes] for each in self.driven]
        common = min(map(len, every), default=0)
        return np.array([row[:common] for row in every]).reshape(len(every), common)

    def overall_figure(self, name: str) -> float:
        """A figure of COMPARED_FIGURES over all seeds and scenes."""
        figure, statistic = COMPARED_FIGURES[name]
        return float(statistic(self.matrix(figure).ravel()))

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
        intervals = {"score_iqm": stratified_interval(score, interquartile_mean)}
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
            "score_iqm": self.overall_figure("score_iqm"),
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


COMPARED_FIGURES = {
    "success_rate": ("success", row_means),
    "score_iqm": ("score", interquartile_mean),
}
"""The figures that the best are compared by: a field of `EpisodeRecord`, and its statistic."""


def compare_best(some: Iterable[AgentRow]) -> list[dict[str, Any]]:
    """Compare the best learned agent with the best baseline of each nominal place.

    Each figure has its own best agents: the baseline with the highest score may not be the one that
    succeeds most often.
    """
    found = []
    for place, group in _group_by_place(some).items():
        for name, (figure, statistic) in COMPARED_FIGURES.items():
            told: dict[str, Any] = _describe_place(place) | {"figure": name}
            for kind in (LEARNED, BASELINE):
                own = [row for row in group if row.kind == kind]
                if own:
                    best = max(own, key=lambda row: row.overall_figure(name))
                    told[kind] = best.agent
                    told[f"{kind}_value"] = best.overall_figure(name)
                    ends = stratified_interval(best.matrix(figure), statistic)
                    told[f"{kind}_interval"] = ends
            if LEARNED in told and BASELINE in told:
                ours, other = told[f"{LEARNED}_interval"], told[f"{BASELINE}_interval"]
                better = told[f"{LEARNED}_value"] > told[f"{BASELINE}_value"]
                apart = ours[1] < other[0] or other[1] < ours[0]
                found.append(told | {"better": better, "apart": apart})
    return found


def compare_pairs(some: Iterable[AgentRow]) -> list[dict[str, Any]]:
    """Return the probability that each learned agent improves on each other agent, by score."""
    found = []
    for place, group in _group_by_place(some).items():
        for ours in (row for row in group if row.kind == LEARNED):
            for other in (row for row in group if row is not ours):
                x, y = ours.matrix("score"), other.matrix("score")
                common = min(x.shape[1], y.shape[1])
                x, y = x[:, :common], y[:, :common]
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
        if row.driven and row.place[3] == NOMINAL:
            found.setdefault(row.place, []).append(row)
    for group in found.values():
        group.sort(key=lambda row: -row.overall_figure("score_iqm"))
    return found
