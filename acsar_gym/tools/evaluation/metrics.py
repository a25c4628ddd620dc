"""Metrics over episodes: rates, path lengths and scores, with 95 % confidence intervals.

SPL is success weighted by path length (Anderson et al. 2018); SoftSPL replaces success by progress
(Datta et al. 2020). Both are relative to the shortest path for the robot's footprint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import require_extra
from acsar_gym.tasks.navigation import BARN_SCORES
from acsar_gym.tools.evaluation.episodes import EpisodeResult

CONFIDENCE_LEVEL = 0.95
BOOTSTRAP_SAMPLES = 2000
"""Number of bootstrap samples. Their seed is fixed, so equal results give equal intervals."""
MAX_RESAMPLED = 4_000_000
"""Values that are resampled at once, at most; limits the memory."""
TOLD_PREFIX = "told."
"""Begins the names of intervals of what the task tells, which may be named like other figures."""

Floats = NDArray[np.float64]
Interval = tuple[float, float]
Statistic = Callable[[Floats], Floats]
"""Maps rows of values (..., n) to one figure a row (...)."""


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
    """Time from a command to its effect in the feedback, median over those of all episodes [s]."""
    round_trip_p95: float
    """95th percentile of the same [s]."""
    round_trips: int
    """How many were measured: each time that standing wheels are commanded to turn."""
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
    for one in told:
        del one["track"]
    cleaned: list[dict[str, Any]] = replace_nonfinite(told)
    return cleaned


def replace_nonfinite(value: Any) -> Any:
    """Replace NaN and infinity by None, recursively, for JSON."""
    if isinstance(value, dict):
        return {key: replace_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nonfinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


EPISODE_RATES: dict[str, Callable[[Any], bool]] = {
    "success_rate": lambda e: e.success,
    "collision_rate": lambda e: e.collision,
    "timeout_rate": lambda e: not (e.success or e.collision or e.fault),
    "fault_rate": lambda e: bool(e.fault),
}
"""How an `EpisodeResult`, or a benchmark's record of it, ended."""
EPISODE_FIGURES: dict[str, Callable[[Any], float]] = {
    "episode_return": lambda e: e.episode_return,
    "length": lambda e: e.length,
    "time_to_goal": lambda e: e.time if e.success else math.nan,
    "path": lambda e: e.path if e.success else math.nan,
    "spl": lambda e: e.spl,
    "soft_spl": lambda e: e.soft_spl,
    "smoothness": lambda e: e.turning / max(e.path, 1e-9),
    "jerk": lambda e: e.jerk,
    "clearance": lambda e: e.clearance,
    "energy": lambda e: e.energy if e.success else math.nan,
    "odometry_error": lambda e: e.odometry_error,
    "odometry_drift": lambda e: (
        e.odometry_error / max(e.path if math.isnan(e.driven) else e.driven, 1e-9)
    ),
    "cross_track": lambda e: e.cross_track,
}
"""Figures of an episode whose means are given, see `Summary`; NaN where an episode has none."""


def summarise_episodes(results: Sequence[EpisodeResult]) -> Summary:
    """Compute rates, means and confidence intervals over episodes."""
    rates = {name: [each(result) for result in results] for name, each in EPISODE_RATES.items()}
    samples = {
        name: [float(each(result)) for result in results] for name, each in EPISODE_FIGURES.items()
    }
    scores: dict[str, list[float]] = {}
    if results and all(result.scores for result in results):
        for number, name in enumerate(BARN_SCORES):
            scores[name] = [result.scores[number] for result in results]
    names = results[0].told if results else ()
    told = {name: [result.told[name] for result in results] for name in names}
    intervals = {name: wilson_interval(sum(hits), len(hits)) for name, hits in rates.items()}
    prefixed = {f"{TOLD_PREFIX}{name}": values for name, values in told.items()}
    for name, values in (samples | scores | prefixed).items():
        intervals[name] = bootstrap_interval(values)
    means: dict[str, Any] = {
        name: finite_mean(map(float, values)) for name, values in (rates | samples).items()
    }
    timings = [result.timing for result in results if result.timing]
    latest = [timing.lateness for timing in timings]
    trips = [trip for timing in timings for trip in timing.round_trips]
    return Summary(
        episodes=len(results),
        **means,
        ticks=sum(result.ticks for result in results),
        late_ticks=sum(result.late_ticks for result in results),
        missed_ticks=sum(lateness.missed_ticks for lateness in latest),
        lateness_p99=_largest(lateness.p99 for lateness in latest),
        worst_lateness=_largest(lateness.worst for lateness in latest),
        worst_feedback_age=_largest(timing.feedback_age.worst for timing in timings),
        round_trip=float(np.median(trips)) if trips else math.nan,
        round_trip_p95=float(np.percentile(trips, 95.0)) if trips else math.nan,
        round_trips=len(trips),
        invalid=sum(not result.valid for result in results),
        scores={name: finite_mean(values) for name, values in scores.items()},
        told={name: finite_mean(values) for name, values in told.items()},
        intervals=intervals,
    )


def finite_mean(values: Iterable[float]) -> float:
    """Return the mean of the finite values, or NaN."""
    known = [value for value in values if math.isfinite(value)]
    return math.fsum(known) / len(known) if known else math.nan


def _largest(values: Iterable[float]) -> float:
    return max(filter(math.isfinite, values), default=math.nan)


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
    known = [value for value in values if math.isfinite(value)]
    if len(known) < 2:
        return (math.nan, math.nan)
    return stratified_interval(np.array([known]), row_means)


def row_means(rows: Floats) -> Floats:
    """Return the mean of each row (..., n)."""
    means: Floats = rows.mean(axis=-1)
    return means


def stratified_interval(
    values: Floats, statistic: Statistic, *, resamples: int = BOOTSTRAP_SAMPLES
) -> Interval:
    """Return the 95 % percentile interval of a statistic, by the stratified bootstrap.

    Arguments are those of `resample`.

    Returns:
        Low and high end.
    """
    return percentile_interval(resample(values, statistic, resamples=resamples))


def resample(values: Floats, statistic: Statistic, *, resamples: int = BOOTSTRAP_SAMPLES) -> Floats:
    """Return a statistic of bootstrap samples, stratified by rows.

    Rows and columns are resampled with replacement. A drawn row keeps its values in all drawn
    columns.

    Args:
        values: (rows, columns).
        statistic: of all resampled values together.
        resamples: bootstrap samples.

    Returns:
        (resamples,): the statistic of each.
    """
    rng, found = np.random.default_rng(0), []
    chunk = max(1, MAX_RESAMPLED // values.size)
    for first in range(0, resamples, chunk):
        count = min(chunk, resamples - first)
        rows, columns = (rng.integers(size, size=(count, size)) for size in values.shape)
        drawn = values[rows[:, :, None], columns[:, None, :]]
        found.append(statistic(drawn.reshape(count, -1)))
    return np.concatenate(found)


def percentile_interval(values: Floats) -> Interval:
    """Return the middle 95 % of resampled values."""
    tail = 50.0 * (1.0 - CONFIDENCE_LEVEL)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)
