"""The figures of an episode and of many: what each id is scored by, and means over episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from acsar_gym.benchmark.store import Episode
from acsar_gym.evaluation import metrics
from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.tasks.barn import SCORES

BEST_BARN = 0.5
"""Largest BARN score with k = 2."""
WORST_ERROR = 0.1
"""Mean cross-track error at which following a path scores nothing [m]."""


def episode_of(result: EpisodeResult, scene: int, env_id: str) -> Episode:
    """Flatten a result.

    Args:
        result: of the episode.
        scene: its number.
        env_id: id without its namespace, which decides the score.
    """
    scores = dict(zip(SCORES, result.scores, strict=False))
    return Episode(
        scene=scene,
        seed=result.seed or 0,
        success=bool(result.success),
        collision=bool(result.collision),
        score=score(result, env_id),
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


def score(result: EpisodeResult, env_id: str) -> float:
    """Return the score of an episode, 0 to 1, 0 without success.

    BARN's score (k = 2, the robot's own top speed) over its largest value; for path following
    1 - mean cross-track error / 10 cm; SPL for the other ids.
    """
    if not result.success:
        return 0.0
    if env_id.startswith("Barn-") and result.scores:
        return result.scores[SCORES.index("barn_score_own")] / BEST_BARN
    if env_id.startswith("PathFollow-"):
        return max(0.0, 1.0 - result.cross_track / WORST_ERROR)
    return metrics.spl(result)


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
