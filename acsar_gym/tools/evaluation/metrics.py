"""Metrics over episodes: rates, path lengths and scores, with 95 % confidence intervals.

SPL is success weighted by path length (Anderson et al. 2018); SoftSPL replaces success by progress
(Datta et al. 2020). Both are relative to the shortest path for the robot's footprint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from acsar_gym.errors import require_extra
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.worlds.crowd import PERSON_HIT, ROBOT_HIT

CONFIDENCE_LEVEL = 0.95
BOOTSTRAP_SAMPLES = 2000
"""Number of bootstrap samples. Their seed is fixed, so equal results give equal intervals."""
MAX_RESAMPLED = 4_000_000  # values that are resampled at once, at most; limits the memory
TOLD_PREFIX = "told."
"""Begins the names of intervals of what the task tells, which may be named like other figures."""

Interval = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Summary:
    """Means over episodes; NaN if there is nothing to average."""

    episodes: int
    success_rate: float
    collision_rate: float  # touched an obstacle, or ran into somebody
    struck_rate: float  # somebody ran into the robot, which is no collision of its own
    timeout_rate: float
    """None of the others: time-out or out of bounds. These five rates add up to 1."""
    fault_rate: float  # ended by a fault of link, board or wheels
    person_collision_rate: float  # ran into somebody: the part of the collisions with people
    episode_return: float
    """Sum of rewards; comparable to the `reward_threshold` of a registered env."""
    length: float  # policy steps per episode
    time_to_goal: float  # over successful episodes [s]
    path: float  # length of the path driven, over successful episodes, by odometry [m]
    spl: float  # 0 to 1; NaN if shortest paths aren't known, as in path following
    soft_spl: float
    smoothness: float  # heading change per metre driven [rad/m]; smaller is smoother
    jerk: float  # mean absolute jerk of the speed driven, by odometry [m/s^3]; smaller is smoother
    clearance: float
    """Least distance of the footprint to an obstacle that stands in an episode, 0 where it touched
    one [m]."""
    closest_person: float
    """Least distance of the footprint to somebody who moves in an episode, 0 where they touched
    [m]; NaN where nobody moves, as the next two."""
    time_to_collision: float
    """Least time in an episode until the robot would touch somebody if all kept their velocities
    [s]; at most 10."""
    intrusion_rate: float
    """How often the robot entered somebody's personal space, of all episodes together [1/min]."""
    energy: float  # mechanical work of a simulated robot's motors, over successful episodes [J]
    odometry_error: float  # distance between odometry and ground truth at the end of an episode [m]
    odometry_drift: float  # odometry error divided by the length of the path driven
    cross_track: float  # mean cross-track error of path following [m]
    ticks: int
    late_ticks: int
    missed_ticks: int  # control periods that passed without a tick
    lateness_p99: float
    """Largest 99th percentile of lateness of any episode [s]; NaN in simulation."""
    worst_lateness: float  # largest lateness of any tick [s]
    worst_feedback_age: float  # largest age of the feedback at a tick [s]
    round_trip: float
    """Time from a command to its effect in the feedback, median over those of all episodes [s]."""
    round_trip_p95: float
    """95th percentile of the same [s]."""
    round_trips: int  # how many were measured: each time that standing wheels are commanded to turn
    invalid: int  # episodes that ended with a fault or had too many late ticks
    told: dict[str, float] = field(default_factory=dict)
    """What the task tells at an episode's end, by name; see `Task.told`."""
    intervals: dict[str, Interval] = field(default_factory=dict)
    """Confidence intervals (low, high) by name: Wilson (1927) for rates, percentile bootstrap for
    means."""

    def as_dict(self) -> dict[str, Any]:
        """Return the fields for JSON; NaN and infinity become None."""
        cleaned: dict[str, Any] = replace_nonfinite(asdict(self))
        return cleaned


def describe_episodes(episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Return the episodes for JSON, one dict per episode, timing included."""
    cleaned: list[dict[str, Any]] = replace_nonfinite([asdict(episode) for episode in episodes])
    return cleaned


def replace_nonfinite(value: Any) -> Any:
    """Replace NaN and infinity by None, recursively, for JSON."""
    if isinstance(value, dict):
        return {key: replace_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nonfinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


EPISODE_ENDS: dict[str, Callable[[Episode], bool]] = {
    "success_rate": lambda e: e.success,
    "collision_rate": lambda e: e.collision,
    "struck_rate": lambda e: e.person_contact == PERSON_HIT,
    "timeout_rate": lambda e: (
        not (e.success or e.collision or e.person_contact == PERSON_HIT or e.fault)
    ),
    "fault_rate": lambda e: bool(e.fault),
}
"""How an episode ended."""
EPISODE_RATES: dict[str, Callable[[Episode], bool]] = {
    **EPISODE_ENDS,
    "person_collision_rate": lambda e: e.person_contact == ROBOT_HIT,
}
"""What is true of an episode or not."""
EPISODE_FIGURES: dict[str, Callable[[Episode], float]] = {
    "episode_return": lambda e: e.episode_return,
    "length": lambda e: e.length,
    "time_to_goal": lambda e: e.time if e.success else math.nan,
    "path": lambda e: e.path if e.success else math.nan,
    "spl": lambda e: e.spl,
    "soft_spl": lambda e: e.soft_spl,
    "smoothness": lambda e: e.turning / max(e.path, 1e-9),
    "jerk": lambda e: e.jerk,
    "clearance": lambda e: e.clearance,
    "closest_person": lambda e: e.closest_person,
    "time_to_collision": lambda e: e.time_to_collision,
    "energy": lambda e: e.energy if e.success else math.nan,
    "odometry_error": lambda e: e.odometry_error,
    "odometry_drift": lambda e: (
        e.odometry_error / max(e.path if math.isnan(e.driven) else e.driven, 1e-9)
    ),
    "cross_track": lambda e: e.cross_track,
}
"""Figures of an episode whose means are given, see `Summary`; NaN where an episode has none."""


def average_figures(episodes: Sequence[Episode]) -> dict[str, float]:
    """Return the mean of every rate and figure over the episodes that have it; NaN for none."""
    figures: dict[str, Callable[[Episode], float]] = {**EPISODE_RATES, **EPISODE_FIGURES}
    means = {
        name: finite_mean(float(figure(episode)) for episode in episodes)
        for name, figure in figures.items()
    }
    intrusions, minutes = count_intrusions(episodes)
    means["intrusion_rate"] = math.fsum(intrusions) / math.fsum(minutes) if minutes else math.nan
    return means


def count_intrusions(episodes: Sequence[Episode]) -> tuple[list[float], list[float]]:
    """Return the intrusions and the duration [min] of each episode that knows its own."""
    known = [episode for episode in episodes if math.isfinite(episode.intrusions)]
    return [episode.intrusions for episode in known], [episode.time / 60.0 for episode in known]


def average_told(episodes: Sequence[Episode]) -> dict[str, float]:
    """Return the means of what the task told at the episodes' ends."""
    names = episodes[0].told if episodes else ()
    return {name: finite_mean(episode.told[name] for episode in episodes) for name in names}


def summarise_episodes(episodes: Sequence[Episode]) -> Summary:
    """Compute rates, means and confidence intervals over episodes."""
    intervals = {
        name: wilson_interval(sum(map(rate, episodes)), len(episodes))
        for name, rate in EPISODE_RATES.items()
    }
    for name, figure in EPISODE_FIGURES.items():
        intervals[name] = bootstrap_interval([float(figure(episode)) for episode in episodes])
    intervals["intrusion_rate"] = bootstrap_interval(*count_intrusions(episodes))
    told = average_told(episodes)
    for name in told:
        values = [episode.told[name] for episode in episodes]
        intervals[f"{TOLD_PREFIX}{name}"] = bootstrap_interval(values)
    means: dict[str, Any] = dict(average_figures(episodes))
    timings = [episode.timing for episode in episodes if episode.timing]
    latest = [timing.lateness for timing in timings]
    trips = [trip for timing in timings for trip in timing.round_trips]
    return Summary(
        episodes=len(episodes),
        **means,
        ticks=sum(episode.ticks for episode in episodes),
        late_ticks=sum(episode.late_ticks for episode in episodes),
        missed_ticks=sum(lateness.missed_ticks for lateness in latest),
        lateness_p99=_largest(lateness.p99 for lateness in latest),
        worst_lateness=_largest(lateness.worst for lateness in latest),
        worst_feedback_age=_largest(timing.worst_feedback_age for timing in timings),
        round_trip=float(np.median(trips)) if trips else math.nan,
        round_trip_p95=float(np.percentile(trips, 95.0)) if trips else math.nan,
        round_trips=len(trips),
        invalid=sum(not episode.valid for episode in episodes),
        told=told,
        intervals=intervals,
    )


def finite_mean(values: Iterable[float]) -> float:
    """Return the mean of the finite values, or NaN."""
    finite = [value for value in values if math.isfinite(value)]
    return math.fsum(finite) / len(finite) if finite else math.nan


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


def bootstrap_interval(
    values: Sequence[float], durations: Sequence[float] | None = None
) -> Interval:
    """Return the 95 % percentile bootstrap interval of a mean, or of a rate.

    Args:
        values: samples; those that aren't finite are left out.
        durations: of each sample; the interval is that of sum(values) / sum(durations).

    Returns:
        Low and high end; NaN if there are fewer than two samples.
    """
    with require_extra("an evaluation", "scipy"):
        from scipy.stats import bootstrap  # noqa: PLC0415 - slow to import

    rows = zip(values, durations or [1.0] * len(values), strict=True)
    finite = np.array([row for row in rows if math.isfinite(row[0])]).reshape(-1, 2)
    if len(finite) < 2:
        return (math.nan, math.nan)
    is_rate = durations is not None
    interval = bootstrap(
        (*finite.T,) if is_rate else (finite[:, 0],),
        _divide_means if is_rate else np.mean,
        paired=is_rate,
        confidence_level=CONFIDENCE_LEVEL,
        n_resamples=BOOTSTRAP_SAMPLES,
        batch=max(1, MAX_RESAMPLED // len(finite)),
        method="percentile",
        random_state=np.random.default_rng(0),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def _divide_means(values: Any, durations: Any, axis: int = -1) -> Any:
    return values.mean(axis=axis) / durations.mean(axis=axis)
