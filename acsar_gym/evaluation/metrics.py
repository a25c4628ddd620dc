"""What episodes add up to: rates, path lengths and scores, with their 95 % intervals.

SPL is success weighted by path length (Anderson et al. 2018), SoftSPL weighs progress instead of
success (Datta et al. 2020); both against shortest ways for the footprint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from acsar_gym.evaluation.episodes import EpisodeResult
from acsar_gym.links.lateness import EpisodeTiming
from acsar_gym.tasks.barn import SCORES

CONFIDENCE = 0.95
RESAMPLES = 2000
"""Of a bootstrap; its generator is seeded, so the same results have the same intervals."""

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Summary:
    """Means over episodes; NaN where there is nothing to average."""

    episodes: int
    success_rate: float
    collision_rate: float
    timeout_rate: float
    """Neither success nor collision: out of time, or out of bounds. The three add up to 1."""
    episode_return: float
    """Sum of an episode's rewards; the `reward_threshold` of an id is one."""
    length: float
    """Steps of an episode."""
    time_to_goal: float
    """Over successes [s]."""
    path: float
    """Over successes, by odometry [m]."""
    spl: float
    """0 to 1; NaN where shortest ways aren't known, as on a path to follow."""
    soft_spl: float
    smoothness: float
    """Heading changes of a metre driven [rad/m]; less is smoother."""
    odometry_error: float
    """At the end of an episode [m]."""
    odometry_drift: float
    """The same as a share of the way driven."""
    cross_track: float
    """Mean distance beside the path to follow [m]."""
    ticks: int
    late_ticks: int
    missed_ticks: int
    """Whole periods without a tick."""
    lateness_p99: float
    """Of all episodes' 99th percentiles of lateness the largest [s]; NaN in simulation."""
    worst_lateness: float
    """[s]"""
    worst_feedback_age: float
    """[s]"""
    round_trip: float
    """From a command to its first effect in feedback, the mean of medians [s]."""
    invalid: int
    """Episodes that a fault ended, or of which too many ticks were late."""
    scores: dict[str, float] = field(default_factory=dict)
    """BARN's, by name; empty for other tasks."""
    intervals: dict[str, Interval] = field(default_factory=dict)
    """Low and high end for rates (Wilson 1927) and means (percentile bootstrap), by name."""

    def as_dict(self) -> dict[str, Any]:
        """For JSON: NaN and infinity become None."""
        cleaned: dict[str, Any] = _finite(asdict(self))
        return cleaned


def per_episode(results: Sequence[EpisodeResult]) -> list[dict[str, Any]]:
    """Every episode for JSON, its timing included."""
    return [_finite(asdict(result)) for result in results]


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def summarise(results: Sequence[EpisodeResult]) -> Summary:
    """Rates and means of a list of episodes, with intervals."""
    samples = _samples(results)
    rates = {
        "success_rate": [result.success for result in results],
        "collision_rate": [result.collision for result in results],
        "timeout_rate": [not (result.success or result.collision) for result in results],
    }
    intervals = {name: wilson(sum(hits), len(hits)) for name, hits in rates.items()}
    intervals |= {name: bootstrap(values) for name, values in samples.items()}
    names = [name for name in SCORES if name in samples]
    means: dict[str, Any] = {name: _mean([float(hit) for hit in rates[name]]) for name in rates}
    means |= {name: _mean(values) for name, values in samples.items() if name not in names}
    return Summary(
        episodes=len(results),
        **means,
        ticks=sum(result.ticks for result in results),
        late_ticks=sum(result.late_ticks for result in results),
        **_timing([result.timing for result in results if result.timing]),
        invalid=sum(not result.valid for result in results),
        scores={name: _mean(samples[name]) for name in names},
        intervals=intervals,
    )


def _samples(results: Sequence[EpisodeResult]) -> dict[str, list[float]]:
    """One number an episode for every mean; NaN where an episode has none."""
    wins = [result for result in results if result.success]
    drifts = [result.odometry_error / max(_driven(result), 1e-9) for result in results]
    samples = {
        "episode_return": [result.episode_return for result in results],
        "length": [float(result.length) for result in results],
        "time_to_goal": [result.ended - result.started for result in wins],
        "path": [result.path for result in wins],
        "spl": [spl(result) for result in results],
        "soft_spl": [soft_spl(result) for result in results],
        "smoothness": [result.turning / max(result.path, 1e-9) for result in results],
        "odometry_error": [result.odometry_error for result in results],
        "odometry_drift": drifts,
        "cross_track": [result.cross_track for result in results],
    }
    if results and all(result.scores for result in results):
        for number, name in enumerate(SCORES):
            samples[name] = [result.scores[number] for result in results]
    return samples


def _timing(timings: Sequence[EpisodeTiming]) -> dict[str, Any]:
    latest = [timing.lateness for timing in timings]
    return {
        "missed_ticks": sum(lateness.missed_ticks for lateness in latest),
        "lateness_p99": _largest([lateness.p99 for lateness in latest]),
        "worst_lateness": _largest([lateness.worst for lateness in latest]),
        "worst_feedback_age": _largest([timing.feedback_age.worst for timing in timings]),
        "round_trip": _mean([timing.round_trip.p50 for timing in timings]),
    }


def _largest(values: Sequence[float]) -> float:
    return max((value for value in values if math.isfinite(value)), default=math.nan)


def _driven(result: EpisodeResult) -> float:
    return result.path if math.isnan(result.driven) else result.driven


def spl(result: EpisodeResult) -> float:
    """Success weighted by path length of one episode."""
    longest = max(_driven(result), result.shortest)
    return float(result.success) * _share(result.shortest, longest)


def soft_spl(result: EpisodeResult) -> float:
    """Progress towards the goal weighted by path length of one episode."""
    progress = max(0.0, 1.0 - _share(result.left, result.shortest))
    return progress * _share(result.shortest, max(_driven(result), result.shortest))


def _share(part: float, whole: float) -> float:
    return part / whole if whole > 0.0 else 1.0


def wilson(hits: int, count: int) -> Interval:
    """Wilson's interval of a rate; (0, 1) where nothing was counted."""
    from scipy.stats import binomtest  # noqa: PLC0415 - slow to import

    if count == 0:
        return (0.0, 1.0)
    interval = binomtest(hits, count).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def bootstrap(values: Sequence[float]) -> Interval:
    """Percentile bootstrap of a mean; NaN for fewer than two numbers."""
    from scipy.stats import bootstrap as resample  # noqa: PLC0415 - slow to import

    known = [value for value in values if math.isfinite(value)]
    if len(known) < 2:
        return (math.nan, math.nan)
    interval = resample(
        (known,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else math.nan
