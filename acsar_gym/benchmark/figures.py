"""The figures of an episode and of many: what each id is scored by, and means over episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from acsar_gym.benchmark.store import Episode
from acsar_gym.evaluation import metrics
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.tasks.barn import SCORES

WORST_ERROR = 0.1
"""Mean cross-track error at which following a path scores nothing [m]."""


@dataclass(frozen=True, slots=True)
class Scoring:
    """What the score of an episode depends on besides its result."""

    id: str
    """Id of the env, without its namespace."""
    top_speed: float
    """Of the robot [m/s]."""
    tolerance: float
    """Distance to the goal that is a success [m]."""


def episode_of(result: EpisodeResult, scene: int, scoring: Scoring) -> Episode:
    """Flatten a result.

    Args:
        result: of the episode.
        scene: its number.
        scoring: how it is scored.
    """
    scores = dict(zip(SCORES, result.scores, strict=False))
    return Episode(
        scene=scene,
        seed=result.seed or 0,
        success=bool(result.success),
        collision=bool(result.collision),
        score=score(result, scoring),
        spl=metrics.spl(result),
        soft_spl=metrics.soft_spl(result),
        time=result.ended - result.started,
        steps=result.length,
        path=result.path,
        driven=result.driven,
        shortest=result.shortest,
        turning=result.turning,
        jerk=result.jerk,
        clearance=result.clearance,
        energy=result.energy,
        odometry_error=result.odometry_error,
        cross_track=result.cross_track,
        barn_score=scores.get("barn_score", math.nan),
        barn_score_own=scores.get("barn_score_own", math.nan),
        episode_return=result.episode_return,
        late_ticks=result.late_ticks,
        fault=result.fault,
    )


def score(result: EpisodeResult, scoring: Scoring) -> float:
    """Return the score of an episode, 0 to 1, 0 without success.

    For path following 1 - mean cross-track error / 10 cm. Otherwise success weighted by completion
    time (Yokoyama, Ha & Batra 2021): T* / max(T, T*), where T is the time that it took, and T* that
    of the shortest path, up to the goal's tolerance, at the robot's top speed.
    """
    if not result.success:
        return 0.0
    if scoring.id.startswith("PathFollow-"):
        return max(0.0, 1.0 - result.cross_track / WORST_ERROR)
    fastest = max(result.shortest - scoring.tolerance, 0.0) / scoring.top_speed
    return fastest / max(result.ended - result.started, fastest, 1e-9)


def _won(value: Callable[[Episode], float]) -> Callable[[Episode], float]:
    """Count successful episodes only."""
    return lambda episode: value(episode) if episode.success else math.nan


FIGURES: dict[str, Callable[[Episode], float]] = {
    "success_rate": lambda e: float(e.success),
    "collision_rate": lambda e: float(e.collision),
    "fault_rate": lambda e: float(bool(e.fault)),
    "score": lambda e: e.score,
    "spl": lambda e: e.spl,
    "soft_spl": lambda e: e.soft_spl,
    "barn_score": lambda e: e.barn_score,
    "barn_score_own": lambda e: e.barn_score_own,
    "time_to_goal": _won(lambda e: e.time),
    "path": _won(lambda e: e.path),
    "clearance": lambda e: e.clearance,
    "smoothness": lambda e: e.turning / max(e.path, 1e-9),
    "jerk": lambda e: e.jerk,
    "energy": _won(lambda e: e.energy),
    "odometry_error": lambda e: e.odometry_error,
    "odometry_drift": lambda e: e.odometry_error / max(_longer(e), 1e-9),
    "cross_track": lambda e: e.cross_track,
    "episode_return": lambda e: e.episode_return,
    "late_ticks": lambda e: float(e.late_ticks),
}
"""Values whose means over episodes are given; NaN where an episode has none. Units as in `Episode`;
smoothness is the heading change per metre [rad/m], odometry_drift the error per metre driven."""


def _longer(episode: Episode) -> float:
    """Length driven [m], by ground truth if known."""
    return episode.path if math.isnan(episode.driven) else episode.driven


def summary(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Return the mean of every figure over the episodes that have it, None where none has.

    `success_interval` is Wilson's.
    """
    means = {name: _mean([value(each) for each in episodes]) for name, value in FIGURES.items()}
    wins = sum(each.success for each in episodes)
    interval = metrics.wilson(wins, len(episodes))
    told = {"episodes": len(episodes), **means, "success_interval": interval}
    cleaned: dict[str, Any] = metrics.finite(told)
    return cleaned


def _mean(values: Sequence[float]) -> float:
    """Mean of the finite values, or NaN."""
    known = [value for value in values if math.isfinite(value)]
    return math.fsum(known) / len(known) if known else math.nan
