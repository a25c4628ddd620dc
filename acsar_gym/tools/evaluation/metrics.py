"""Metrics over episodes: rates, path lengths and scores, with 95 % confidence intervals.

SPL is success weighted by path length (Anderson et al. 2018); SoftSPL replaces success by progress
(Datta et al. 2020). Both are relative to the shortest path for the robot's footprint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from acsar_gym.errors import require_extra
from acsar_gym.links.lateness import EpisodeTiming
from acsar_gym.tasks.navigation import BARN_SCORES
from acsar_gym.tools.evaluation.episodes import EpisodeResult

CONFIDENCE_LEVEL = 0.95
BOOTSTRAP_SAMPLES = 2000
"""Number of bootstrap samples. Their seed is fixed, so equal results give equal intervals."""

TOLD_PREFIX = "told."
"""Begins the names of intervals of what the task tells, which may be named like other figures."""

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Summary:
    """Means over episodes; NaN if there is nothing to average."""

    episodes: int
    success_rate: float
    collision_rate: float
    timeout_rate: float
    """None of the others: time-out or out of bounds. The four rates add up to 1."""
    fault_rate: float
    """Ended by a fault of link, board or wheels."""
    episode_return: float
    """Sum of rewards; comparable to the `reward_threshold` of a registered env."""
    length: float
    """Policy steps per episode."""
    time_to_goal: float
    """Over successful episodes [s]."""
    path: float
    """Length of the path driven, over successful episodes, by odometry [m]."""
    spl: float
    """0 to 1; NaN if shortest paths aren't known, as in path following."""
    soft_spl: float
    smoothness: float
    """Heading change per metre driven [rad/m]; smaller is smoother."""
    jerk: float
    """Mean absolute jerk of the speed driven, by odometry [m/s^3]; smaller is smoother."""
    clearance: float
    """Least distance of the footprint to an obstacle in an episode, 0 in a collision [m]."""
    energy: float
    """Mechanical work of a simulated robot's motors, over successful episodes [J]."""
    odometry_error: float
    """Distance between odometry and ground truth at the end of an episode [m]."""
    odometry_drift: float
    """Odometry error divided by the length of the path driven."""
    cross_track: float
    """Mean cross-track error of path following [m]."""
    ticks: int
    late_ticks: int
    missed_ticks: int
    """Control periods that passed without a tick."""
    lateness_p99: float
    """Largest 99th percentile of lateness of any episode [s]; NaN in simulation."""
    worst_lateness: float
    """Largest lateness of any tick [s]."""
    worst_feedback_age: float
    """Largest age of the feedback at a tick [s]."""
    round_trip: float
    """Time from a command to its effect in the feedback, mean of the episodes' medians [s]."""
    invalid: int
    """Episodes that ended with a fault or had too many late ticks."""
    scores: dict[str, float] = field(default_factory=dict)
    """BARN scores by name; empty for other tasks."""
    told: dict[str, float] = field(default_factory=dict)
    """What the task tells at an episode's end, by name; see `Task.told`."""
    intervals: dict[str, Interval] = field(default_factory=dict)
    """Confidence intervals (low, high) by name: Wilson (1927) for rates, percentile bootstrap for
    means."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON; NaN and infinity become None."""
        cleaned: dict[str, Any] = replace_nonfinite(asdict(self))
        return cleaned


def describe_episodes(results: Sequence[EpisodeResult]) -> list[dict[str, Any]]:
    """Return the results for JSON, one dict per episode, timing included, tracks left out."""
    told = [asdict(replace(result, track=None)) for result in results]
    return [
        {name: replace_nonfinite(value) for name, value in one.items() if name != "track"}
        for one in told
    ]


def replace_nonfinite(value: Any) -> Any:
    """Replace NaN and infinity by None, recursively, for JSON."""
    if isinstance(value, dict):
        return {key: replace_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nonfinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def summarise_episodes(results: Sequence[EpisodeResult]) -> Summary:
    """Compute rates, means and confidence intervals over episodes."""
    samples = _samples(results)
    rates = {
        "success_rate": [result.success for result in results],
        "collision_rate": [result.collision for result in results],
        "timeout_rate": [
            not (result.success or result.collision or result.fault) for result in results
        ],
        "fault_rate": [bool(result.fault) for result in results],
    }
    intervals = {name: wilson_interval(sum(hits), len(hits)) for name, hits in rates.items()}
    intervals |= {name: bootstrap_interval(values) for name, values in samples.items()}
    names = [name for name in BARN_SCORES if name in samples]
    told = {f"{TOLD_PREFIX}{name}": name for name in (results[0].told if results else ())}
    means: dict[str, Any] = {name: _mean([float(hit) for hit in rates[name]]) for name in rates}
    own = {*names, *told}
    means |= {name: _mean(values) for name, values in samples.items() if name not in own}
    return Summary(
        episodes=len(results),
        **means,
        ticks=sum(result.ticks for result in results),
        late_ticks=sum(result.late_ticks for result in results),
        **_timing([result.timing for result in results if result.timing]),
        invalid=sum(not result.valid for result in results),
        scores={name: _mean(samples[name]) for name in names},
        told={name: _mean(samples[key]) for key, name in told.items()},
        intervals=intervals,
    )


def _samples(results: Sequence[EpisodeResult]) -> dict[str, list[float]]:
    """Return the values that are averaged, by name; NaN if an episode has none."""
    wins = [result for result in results if result.success]
    drifts = [result.odometry_error / max(_driven(result), 1e-9) for result in results]
    samples = {
        "episode_return": [result.episode_return for result in results],
        "length": [float(result.length) for result in results],
        "time_to_goal": [result.ended - result.started for result in wins],
        "path": [result.path for result in wins],
        "spl": [episode_spl(result) for result in results],
        "soft_spl": [episode_soft_spl(result) for result in results],
        "smoothness": [result.turning / max(result.path, 1e-9) for result in results],
        "jerk": [result.jerk for result in results],
        "clearance": [result.clearance for result in results],
        "energy": [result.energy for result in wins],
        "odometry_error": [result.odometry_error for result in results],
        "odometry_drift": drifts,
        "cross_track": [result.cross_track for result in results],
    }
    if results and all(result.scores for result in results):
        for number, name in enumerate(BARN_SCORES):
            samples[name] = [result.scores[number] for result in results]
    for name in results[0].told if results else ():
        samples[f"{TOLD_PREFIX}{name}"] = [result.told[name] for result in results]
    return samples


def _timing(timings: Sequence[EpisodeTiming]) -> dict[str, Any]:
    """Compute the timing metrics of all episodes."""
    latest = [timing.lateness for timing in timings]
    return {
        "missed_ticks": sum(lateness.missed_ticks for lateness in latest),
        "lateness_p99": _largest([lateness.p99 for lateness in latest]),
        "worst_lateness": _largest([lateness.worst for lateness in latest]),
        "worst_feedback_age": _largest([timing.feedback_age.worst for timing in timings]),
        "round_trip": _mean([timing.round_trip.p50 for timing in timings]),
    }


def _largest(values: Sequence[float]) -> float:
    """Return the largest finite value, or NaN."""
    return max((value for value in values if math.isfinite(value)), default=math.nan)


def _driven(result: EpisodeResult) -> float:
    """Return the length of the path driven [m], by ground truth if known."""
    return result.path if math.isnan(result.driven) else result.driven


def episode_spl(result: EpisodeResult) -> float:
    """Return SPL of one episode, 0 to 1: success * shortest / max(driven, shortest)."""
    longest = max(_driven(result), result.shortest)
    return float(result.success) * _share(result.shortest, longest)


def episode_soft_spl(result: EpisodeResult) -> float:
    """Return SoftSPL of one episode, 0 to 1.

    SPL with the progress max(0, 1 - left / shortest) in place of success.
    """
    progress = max(0.0, 1.0 - _share(result.left, result.shortest))
    return progress * _share(result.shortest, max(_driven(result), result.shortest))


def _share(part: float, whole: float) -> float:
    """Divide; 1 if `whole` isn't positive."""
    return part / whole if whole > 0.0 else 1.0


def wilson_interval(hits: int, count: int) -> Interval:
    """Return Wilson's 95 % interval of the rate hits / count; (0, 1) if `count` is 0."""
    with require_extra("an evaluation", "scipy"):
        from scipy.stats import binomtest  # noqa: PLC0415 - slow to import

    if count == 0:
        return (0.0, 1.0)
    interval = binomtest(hits, count).proportion_ci(CONFIDENCE_LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def bootstrap_interval(values: Sequence[float]) -> Interval:
    """Return the 95 % percentile bootstrap interval of a mean.

    Args:
        values: samples; those that aren't finite are left out.

    Returns:
        Low and high end; NaN if there are fewer than two samples.
    """
    with require_extra("an evaluation", "scipy"):
        from scipy.stats import bootstrap as resample  # noqa: PLC0415 - slow to import

    known = [value for value in values if math.isfinite(value)]
    if len(known) < 2:
        return (math.nan, math.nan)
    interval = resample(
        (known,),
        np.mean,
        n_resamples=BOOTSTRAP_SAMPLES,
        confidence_level=CONFIDENCE_LEVEL,
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def _mean(values: Sequence[float]) -> float:
    """Return the mean of the finite values, or NaN."""
    known = [value for value in values if math.isfinite(value)]
    return sum(known) / len(known) if known else math.nan
