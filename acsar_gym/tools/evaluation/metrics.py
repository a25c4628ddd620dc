"""Figures over episodes: rates, path lengths and scores, with 95 % confidence intervals.

SPL is success weighted by path length (Anderson et al. 2018). SoftSPL replaces success by progress
(Datta et al. 2020). Both are relative to the shortest path for the robot's footprint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, is_dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from acsar_gym.tools.evaluation.episode import Episode
from acsar_gym.worlds.crowd import PERSON_HIT, ROBOT_HIT

Interval = tuple[float, float]
Groups = Sequence[Sequence[Episode]]
"""Episodes in the same scenes, a group for each training seed of a policy."""
CONFIDENCE_LEVEL = 0.95
BOOTSTRAP_SAMPLES = 2000
"""Number of bootstrap samples. Their seed is fixed, so equal results have equal intervals."""
MAX_RESAMPLED = 4_000_000
"""Most values that are resampled at once, which limits the memory to 100 MB."""
TOLD_PREFIX = "told."
"""Prefix of the names of a task's own numbers, which may have the name of a figure."""


class Figure(NamedTuple):
    """A figure of an episode, whose mean over episodes is reported."""

    of: Callable[[Episode], float]
    """Computes it. NaN if an episode has none."""
    title: str
    unit: str = ""
    factor: float = 1.0
    """The unit in SI units is 1 / factor."""
    digits: int = 2
    is_rate: bool = False
    """Whether it is 0 or 1, so that its interval is Wilson's."""
    per: Callable[[Episode], float] = lambda _: 1.0
    """Weight of an episode: the mean is the sum of the values over the sum of the weights."""

    @property
    def heading(self) -> str:
        """Heading of a table, with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def measure(self, groups: Groups) -> tuple[float, Interval]:
        """Return mean and interval over the episodes that have this figure. NaN for none."""
        values, weights = (
            np.array([[of(episode) for episode in group] for group in groups], np.float64)
            for of in (self.of, self.per)
        )

        # Exact sums: the mean doesn't depend on the order of the episodes.
        is_known = np.isfinite(values)
        total = math.fsum(weights[is_known])
        mean = math.fsum(values[is_known]) / total if total else math.nan
        if self.is_rate and not math.isnan(mean):
            return mean, wilson_interval(int(values[is_known].sum()), int(is_known.sum()))
        return mean, bootstrap_interval(values, weights)


def _rate(holds: Callable[[Episode], float], title: str) -> Figure:
    return Figure(holds, title, "%", factor=100.0, digits=1, is_rate=True)


def _is_struck(episode: Episode) -> bool:
    return episode.person_contact == PERSON_HIT


def _timed_out(episode: Episode) -> bool:
    return not (episode.success or episode.collision or _is_struck(episode) or episode.fault)


def _hits_person(episode: Episode) -> float:
    contact = episode.person_contact
    return contact if math.isnan(contact) else contact == ROBOT_HIT


def _if_success(name: str) -> Callable[[Episode], float]:
    return lambda episode: getattr(episode, name) if episode.success else math.nan


EPISODE_ENDS = {
    "success_rate": _rate(lambda e: e.success, "success"),
    "collision_rate": _rate(lambda e: e.collision, "collision"),
    "struck_rate": _rate(_is_struck, "struck"),
    "timeout_rate": _rate(_timed_out, "time-out"),
    "fault_rate": _rate(lambda e: bool(e.fault), "fault"),
}
"""How an episode ended. These five add up to 1."""
FIGURES = {
    "score": Figure(lambda e: e.score, "score", digits=3),
    **EPISODE_ENDS,
    "person_collision_rate": _rate(_hits_person, "ran into people"),
    "episode_return": Figure(lambda e: e.episode_return, "return"),
    "length": Figure(lambda e: e.length, "steps", digits=1),
    "spl": Figure(lambda e: e.spl, "SPL"),
    "soft_spl": Figure(lambda e: e.soft_spl, "soft SPL"),
    "time_to_goal": Figure(_if_success("time"), "time to goal", "s"),
    "path": Figure(_if_success("path"), "path", "m"),
    "clearance": Figure(lambda e: e.clearance, "clearance", "cm", 100.0),
    "smoothness": Figure(lambda e: e.turning / max(e.path, 1e-9), "turning", "rad/m"),
    "jerk": Figure(lambda e: e.jerk, "jerk", "m/s³"),
    "energy": Figure(_if_success("energy"), "energy", "J"),
    "cross_track": Figure(lambda e: e.cross_track, "beside path", "cm", 100.0),
    "odometry_error": Figure(lambda e: e.odometry_error, "odometry error", "cm", 100.0),
    "odometry_drift": Figure(lambda e: e.odometry_error / max(e.driven, 1e-9), "drift", "%", 100.0),
    "closest_person": Figure(lambda e: e.closest_person, "closest person", "cm", 100.0),
    "time_to_collision": Figure(lambda e: e.time_to_collision, "time to collision", "s"),
    "intrusion_rate": Figure(
        lambda e: e.intrusions, "intrusions", "1/min", per=lambda e: e.time / 60.0
    ),
}
"""The figures by name, see `Summary`."""


def find_figure(name: str) -> Figure:
    """Return a figure by its name, which for a task's own numbers starts with TOLD_PREFIX."""
    title = name.removeprefix(TOLD_PREFIX)
    return FIGURES.get(name) or Figure(lambda episode: episode.told[title], title, digits=3)


def measure_figures(groups: Groups) -> dict[str, Any]:
    """Return means by name, those of the task's own numbers included, and their "intervals"."""
    # All episodes are those of one task.
    task_names = groups[0][0].told if groups[0] else ()
    names = [*FIGURES, *(f"{TOLD_PREFIX}{name}" for name in task_names)]
    measured = {name: find_figure(name).measure(groups) for name in names}
    means: dict[str, Any] = {name: mean for name, (mean, _) in measured.items()}
    return means | {"intervals": {name: interval for name, (_, interval) in measured.items()}}


class Summary(SimpleNamespace):
    """Means over episodes. NaN if there is nothing to average.

    Attributes:
        episodes: Number of episodes.
        score: In scenes of the benchmark, see `benchmark.plan.score_episode`. NaN elsewhere.
        success_rate: The goal was reached. This and the next four rates add up to 1.
        collision_rate: Touched an obstacle, or ran into a person.
        struck_rate: A person ran into the robot, which isn't a collision of the robot's own.
        timeout_rate: None of the others: time-out or out of bounds.
        fault_rate: Ended by a fault of link, board or wheels.
        person_collision_rate: Ran into a person: the part of the collisions with people.
        episode_return: Sum of rewards, comparable to the `reward_threshold` of a registered env.
        length: Policy steps per episode.
        spl: 0 to 1. NaN if shortest paths aren't known, as in path following.
        soft_spl: 0 to 1.
        time_to_goal: Duration of successful episodes [s].
        path: Length of the path driven in successful episodes, by odometry [m].
        clearance: Least distance of the footprint to a static obstacle in an episode, 0 after a
            contact [m].
        smoothness: Heading change per metre driven [rad/m]. Smaller is smoother.
        jerk: Mean absolute jerk of the speed driven, by odometry [m/s^3]. Smaller is smoother.
        energy: Mechanical work of a simulated robot's motors in successful episodes [J].
        cross_track: Mean cross-track error of path following [m].
        odometry_error: Distance between odometry and ground truth at the end of an episode [m].
        odometry_drift: Odometry error divided by the length of the path driven.
        closest_person: Least distance of the footprint to a person in an episode, 0 after a
            contact [m]. NaN without people, as the next two.
        time_to_collision: Least time in an episode until the robot would touch a person if all
            kept their velocities [s], at most 10.
        intrusion_rate: How often the robot entered a person's personal space, of all episodes
            together [1/min].
        ticks: Number of ticks.
        late_ticks: Ticks that ended over a millisecond late.
        worst_lateness: Largest lateness of any tick [s]. NaN in simulation.
        round_trip: Time from a command to its effect in the feedback, median over those of all
            episodes [s].
        round_trip_p95: 95th percentile of the same [s].
        round_trips: Number of round trips: each time that standing wheels are commanded to turn.
        invalid: Episodes that ended with a fault or had too many late ticks.
        told: Means of a task's own numbers at an episode's end, by name. See `Task.told`.
        intervals: Confidence intervals (low, high) by name: Wilson (1927) for rates, percentile
            bootstrap for means.
    """

    def as_row(self) -> dict[str, Any]:
        """Return the means by name for a table, like a row of the benchmark."""
        task_means = {f"{TOLD_PREFIX}{name}": mean for name, mean in self.told.items()}
        row: dict[str, Any] = replace_nonfinite(vars(self) | task_means)
        return row


def summarise_episodes(episodes: Sequence[Episode]) -> Summary:
    """Compute rates, means and confidence intervals over episodes."""
    means = measure_figures([episodes])
    names = [name for name in means if name.startswith(TOLD_PREFIX)]
    task_means = {name.removeprefix(TOLD_PREFIX): means.pop(name) for name in names}

    # Timing, which only links in real time have.
    timings = [episode.timing for episode in episodes if episode.timing]
    latenesses = [timing.lateness.worst for timing in timings]
    trips = [trip for timing in timings for trip in timing.round_trips]
    median, longest = np.percentile(trips or [math.nan], [50.0, 95.0]).tolist()
    return Summary(
        episodes=len(episodes),
        **means,
        ticks=sum(episode.ticks for episode in episodes),
        late_ticks=sum(episode.late_ticks for episode in episodes),
        worst_lateness=float(np.fmax.reduce(latenesses, initial=math.nan)),
        round_trip=median,
        round_trip_p95=longest,
        round_trips=len(trips),
        invalid=sum(not episode.valid for episode in episodes),
        told=task_means,
    )


def replace_nonfinite(value: Any) -> Any:
    """Replace NaN and infinity by None, and records by dicts, recursively, for JSON."""
    if is_dataclass(value):
        value = asdict(value)  # type: ignore[arg-type]
    if isinstance(value, dict):
        return {key: replace_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [replace_nonfinite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def wilson_interval(hits: int, count: int) -> Interval:
    """Return Wilson's 95 % interval of the rate hits / count."""
    from scipy.stats import binomtest  # noqa: PLC0415 - slow to import

    interval = binomtest(hits, count).proportion_ci(CONFIDENCE_LEVEL, method="wilson")
    return float(interval.low), float(interval.high)


def bootstrap_interval(values: ArrayLike, weights: ArrayLike = 1.0) -> Interval:
    """Return the 95 % percentile bootstrap interval of a mean.

    Of several training seeds, seeds and scenes are resampled (Agarwal et al. 2021, "Deep
    Reinforcement Learning at the Edge of the Statistical Precipice"). A drawn seed keeps its values
    in all drawn scenes: one trained policy drove them all, so they depend on each other.

    Args:
        values: Samples (scenes,) or (seeds, scenes). Scenes without finite values are left out.
        weights: Of each sample. The interval is that of sum(values) / sum(weights).

    Returns:
        Low and high end. NaN if there are fewer than two samples.
    """
    # Scenes in which no seed has a value don't count. A weight of 0 leaves out single values.
    matrix = np.atleast_2d(np.asarray(values, np.float64))
    is_known = np.isfinite(matrix)
    known_scenes = is_known.any(axis=0)
    shares = np.where(is_known, weights, 0.0)[:, known_scenes]
    matrix = np.where(is_known, matrix, 0.0)[:, known_scenes]
    if matrix.size < 2:
        return (math.nan, math.nan)

    # A generator of its own, so that equal results have equal intervals.
    rng = np.random.default_rng(0)
    means = []

    # In chunks, because all samples at once may not fit into the memory.
    chunk = max(1, MAX_RESAMPLED // matrix.size)
    for first in range(0, BOOTSTRAP_SAMPLES, chunk):
        count = min(chunk, BOOTSTRAP_SAMPLES - first)
        seeds, scenes = (rng.integers(size, size=(count, size)) for size in matrix.shape)
        drawn = (seeds[:, :, None], scenes[:, None, :])
        with np.errstate(invalid="ignore"):  # a sample of scenes that have no value
            means.append(matrix[drawn].sum(axis=(1, 2)) / shares[drawn].sum(axis=(1, 2)))
    tail = 50.0 * (1.0 - CONFIDENCE_LEVEL)
    low, high = np.nanpercentile(np.concatenate(means), [tail, 100.0 - tail])
    return float(low), float(high)
