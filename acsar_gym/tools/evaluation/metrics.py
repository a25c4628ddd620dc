"""Figures over episodes: rates, path lengths and scores, with 95 % confidence intervals.

SPL is success weighted by path length (Anderson et al. 2018). SoftSPL replaces success by progress
(Datta et al. 2020). Both are relative to the shortest path for the robot's footprint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acsar_gym.errors import require_extra
from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.worlds.crowd import PERSON_HIT, ROBOT_HIT

Floats = NDArray[np.float64]
Interval = tuple[float, float]
CONFIDENCE_LEVEL = 0.95
BOOTSTRAP_SAMPLES = 2000
"""Number of bootstrap samples. Their seed is fixed, so equal results have equal intervals."""
MAX_RESAMPLED = 4_000_000
"""Most values that are resampled at once, which limits the memory to 100 MB."""
TOLD_PREFIX = "told."
"""Prefix of the intervals of a task's own numbers, which may have the name of a figure."""


class Figure(NamedTuple):
    """A figure of an episode, whose mean over episodes is reported."""

    of: Callable[[Episode], float]
    """Computes it; NaN if an episode has none."""
    title: str
    unit: str = ""
    factor: float = 1.0
    """The unit in SI units is 1 / factor."""
    digits: int = 2
    table: str = "main"
    """Table of the terminal: "main", "people", or "" for none."""

    def format(self, value: float) -> str:
        """Format a mean for a table, without the unit; empty for NaN."""
        return "" if math.isnan(value) else f"{value * self.factor:.{self.digits}f}"

    @property
    def heading(self) -> str:
        """Heading with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


def _rate(holds: Callable[[Episode], bool], title: str, table: str = "main") -> Figure:
    return Figure(holds, title, "%", 100.0, digits=1, table=table)


def _is_struck(episode: Episode) -> bool:
    return episode.person_contact == PERSON_HIT


def _timed_out(episode: Episode) -> bool:
    return not (episode.success or episode.collision or _is_struck(episode) or episode.fault)


def _if_success(episode: Episode, value: float) -> float:
    return value if episode.success else math.nan


EPISODE_ENDS = {
    "success_rate": _rate(lambda e: e.success, "success"),
    "collision_rate": _rate(lambda e: e.collision, "collision"),
    "struck_rate": _rate(_is_struck, "struck"),
    "timeout_rate": _rate(_timed_out, "time-out"),
    "fault_rate": _rate(lambda e: bool(e.fault), "fault"),
}
"""How an episode ended; these five add up to 1."""
RATES = EPISODE_ENDS | {
    "person_collision_rate": _rate(
        lambda e: e.person_contact == ROBOT_HIT, "ran into people", table="people"
    ),
}
FIGURES = RATES | {
    "episode_return": Figure(lambda e: e.episode_return, "return", table=""),
    "length": Figure(lambda e: e.length, "steps", digits=1, table=""),
    "spl": Figure(lambda e: e.spl, "SPL"),
    "soft_spl": Figure(lambda e: e.soft_spl, "soft SPL", table=""),
    "time_to_goal": Figure(lambda e: _if_success(e, e.time), "time to goal", "s"),
    "path": Figure(lambda e: _if_success(e, e.path), "path", "m"),
    "clearance": Figure(lambda e: e.clearance, "clearance", "cm", 100.0),
    "smoothness": Figure(lambda e: e.turning / max(e.path, 1e-9), "turning", "rad/m", table=""),
    "jerk": Figure(lambda e: e.jerk, "jerk", "m/s³", table=""),
    "energy": Figure(lambda e: _if_success(e, e.energy), "energy", "J"),
    "cross_track": Figure(lambda e: e.cross_track, "beside path", "cm", 100.0),
    "odometry_error": Figure(lambda e: e.odometry_error, "odometry error", "cm", 100.0),
    "odometry_drift": Figure(
        lambda e: e.odometry_error / max(e.driven_path, 1e-9), "drift", "%", 100.0, table=""
    ),
    "closest_person": Figure(
        lambda e: e.closest_person, "closest person", "cm", 100.0, table="people"
    ),
    "time_to_collision": Figure(
        lambda e: e.time_to_collision, "time to collision", "s", table="people"
    ),
    "intrusion_rate": Figure(lambda e: e.intrusions, "intrusions", "1/min", table="people"),
}
"""The figures by name, see `Summary`."""


@dataclass(frozen=True, slots=True)
class Summary:
    """Means over episodes; NaN if there is nothing to average."""

    episodes: int
    success_rate: float
    collision_rate: float
    """Touched an obstacle, or ran into somebody."""
    struck_rate: float
    """Somebody ran into the robot, which isn't a collision of the robot's own."""
    timeout_rate: float
    """None of the others: time-out or out of bounds. These five rates add up to 1."""
    fault_rate: float
    """Ended by a fault of link, board or wheels."""
    person_collision_rate: float
    """Ran into somebody: the part of the collisions with people."""
    episode_return: float
    """Sum of rewards; comparable to the `reward_threshold` of a registered env."""
    length: float
    """Policy steps per episode."""
    time_to_goal: float
    """Duration of successful episodes [s]."""
    path: float
    """Length of the path driven in successful episodes, by odometry [m]."""
    spl: float
    """0 to 1; NaN if shortest paths aren't known, as in path following."""
    soft_spl: float
    smoothness: float
    """Heading change per metre driven [rad/m]; smaller is smoother."""
    jerk: float
    """Mean absolute jerk of the speed driven, by odometry [m/s^3]; smaller is smoother."""
    clearance: float
    """Least distance of the footprint to a static obstacle in an episode, 0 after a contact [m]."""
    closest_person: float
    """Least distance of the footprint to a person in an episode, 0 after a contact [m]; NaN if
    nobody moves, as the next two."""
    time_to_collision: float
    """Least time in an episode until the robot would touch somebody if all kept their velocities
    [s]; at most 10."""
    intrusion_rate: float
    """How often the robot entered somebody's personal space, of all episodes together [1/min]."""
    energy: float
    """Mechanical work of a simulated robot's motors in successful episodes [J]."""
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
    """Number of round trips: each time that standing wheels are commanded to turn."""
    invalid: int
    """Episodes that ended with a fault or had too many late ticks."""
    told: dict[str, float] = field(default_factory=dict)
    """Means of a task's own numbers at an episode's end, by name; see `Task.told`."""
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


def average(episodes: Sequence[Episode]) -> dict[str, float]:
    """Return the mean of every figure over the episodes that have it; NaN for none."""
    means = {
        name: finite_mean(float(figure.of(episode)) for episode in episodes)
        for name, figure in FIGURES.items()
    }
    minutes = [episode.minutes for episode in episodes if math.isfinite(episode.intrusions)]
    if minutes:
        intrusions = [episode.intrusions for episode in episodes]
        means["intrusion_rate"] = math.fsum(filter(math.isfinite, intrusions)) / math.fsum(minutes)
    return means


def average_told(episodes: Sequence[Episode]) -> dict[str, float]:
    """Return the means of a task's own numbers at the episodes' ends."""
    names = episodes[0].told if episodes else ()
    return {name: finite_mean(episode.told[name] for episode in episodes) for name in names}


def find_intervals(groups: Sequence[Sequence[Episode]]) -> dict[str, Interval]:
    """Return the interval of every figure and of every number of the task.

    Args:
        groups: Episodes in the same scenes, a group for each training seed of a policy.
    """
    episodes = [episode for group in groups for episode in group]

    def values(of: Callable[[Episode], float]) -> list[list[float]]:
        return [[float(of(episode)) for episode in group] for group in groups]

    intervals: dict[str, Interval] = {}
    for name, figure in FIGURES.items():
        if name in RATES:
            hits = sum(bool(figure.of(episode)) for episode in episodes)
            intervals[name] = wilson_interval(hits, len(episodes))
        elif name == "intrusion_rate":
            intervals[name] = bootstrap_interval(values(figure.of), values(lambda e: e.minutes))
        else:
            intervals[name] = bootstrap_interval(values(figure.of))
    for name in episodes[0].told if episodes else ():
        numbers = values(lambda episode, name=name: episode.told[name])  # type: ignore[misc]
        intervals[f"{TOLD_PREFIX}{name}"] = bootstrap_interval(numbers)
    return intervals


def summarise_episodes(episodes: Sequence[Episode]) -> Summary:
    """Compute rates, means and confidence intervals over episodes."""
    means: dict[str, Any] = dict(average(episodes))
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
        told=average_told(episodes),
        intervals=find_intervals([episodes]),
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
    values: ArrayLike, durations: ArrayLike | None = None, trim: float = 0.0
) -> Interval:
    """Return the 95 % percentile bootstrap interval of a mean, or of a rate.

    Of several training seeds, seeds and scenes are resampled (Agarwal et al. 2021, "Deep
    Reinforcement Learning at the Edge of the Statistical Precipice"). A drawn seed keeps its values
    in all drawn scenes: one trained policy drove them all, so they depend on each other.

    Args:
        values: Samples (scenes,) or (seeds, scenes). Scenes without finite values are left out.
        durations: Duration of each sample; the interval is that of sum(values) / sum(durations).
        trim: Share of the samples that the mean leaves out on each side.

    Returns:
        Low and high end; NaN if there are fewer than two samples.
    """
    matrix = np.atleast_2d(np.asarray(values, np.float64))
    is_known = np.isfinite(matrix)
    known_scenes = is_known.any(axis=0)
    weights = np.ones_like(matrix) if durations is None else np.atleast_2d(durations)
    weights = np.where(is_known, weights, 0.0)[:, known_scenes]
    matrix = np.where(is_known, matrix, 0.0)[:, known_scenes]
    if matrix.size < 2:
        return (math.nan, math.nan)

    rng = np.random.default_rng(0)
    means: list[Floats] = []
    chunk = max(1, MAX_RESAMPLED // matrix.size)
    for first in range(0, BOOTSTRAP_SAMPLES, chunk):
        count = min(chunk, BOOTSTRAP_SAMPLES - first)
        seeds, scenes = (rng.integers(size, size=(count, size)) for size in matrix.shape)
        drawn = (seeds[:, :, None], scenes[:, None, :])
        means.append(
            _mean(matrix[drawn].reshape(count, -1), weights[drawn].reshape(count, -1), trim)
        )
    tail = (1.0 - CONFIDENCE_LEVEL) / 2.0
    low, high = np.nanpercentile(np.concatenate(means), [100.0 * tail, 100.0 * (1.0 - tail)])
    return float(low), float(high)


def _mean(values: Floats, weights: Floats, trim: float = 0.0) -> Floats:
    """Return the mean of each row."""
    if trim:
        from scipy.stats import trim_mean  # noqa: PLC0415 - slow to import

        return np.asarray(trim_mean(values, trim, axis=-1))
    with np.errstate(invalid="ignore"):  # a sample of scenes that have no value
        means: Floats = values.mean(axis=-1) / weights.mean(axis=-1)
    return means
