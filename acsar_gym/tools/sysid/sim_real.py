"""Compares recordings of one task in simulation and on hardware, episodes paired by seed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.recording.pairs import SeedKey, check_same_robot, have_same_goal, number_seeds
from acsar_gym.recording.types import Episode, Recording
from acsar_gym.tools.evaluation import metrics
from acsar_gym.tools.evaluation.episodes import MAX_LATE_SHARE, total_turning
from acsar_gym.tools.evaluation.report import escape_text
from acsar_gym.tools.sysid.delays import (
    DelayComparison,
    Floats,
    compare_delays,
    explain_few_steps,
    format_lag,
)
from acsar_gym.tools.sysid.tracks import EpisodeTrack, find_damage, make_recorded_track
from acsar_gym.tools.sysid.twin_gap import format_cell, format_interval
from acsar_gym.worlds.search import path_length

NO_INTERVAL = (math.nan, math.nan)
FEWEST_PAIRS = 2
"""Fewest pairs that have an interval."""
NamedRecordings = Sequence[tuple[str, Recording]]
"""Recordings with the names of their files."""


@dataclass(frozen=True, slots=True)
class MetricComparison:
    """One metric of two sides. NaN where a side has no value, as for the time of a failure."""

    values: tuple[float, float]
    """Mean or rate of each side."""
    intervals: tuple[metrics.Interval, metrics.Interval]
    """95 % intervals: Wilson for rates, bootstrap for means."""
    counts: tuple[int, int]
    """Episodes with a value."""
    difference: float
    """Mean difference of the pairs, second minus first."""
    interval: metrics.Interval
    """Its 95 % interval."""
    pairs: int
    """Pairs in which both have a value."""

    @property
    def enough(self) -> bool:
        """Whether there are enough pairs to tell a difference."""
        return self.pairs >= FEWEST_PAIRS

    @property
    def differs(self) -> bool:
        """Whether the interval of the difference leaves out zero."""
        return self.interval[0] > 0.0 or self.interval[1] < 0.0


def compare_values(
    sides: tuple[Sequence[float], Sequence[float]],
    pairs: Sequence[tuple[float, float]],
    *,
    rates: bool = False,
) -> MetricComparison:
    """Compare means of values; those that are NaN are left out.

    Args:
        sides: values of both sides.
        pairs: values of the paired episodes, (first, second).
        rates: whether values are 0 or 1: rates have Wilson's intervals, and their paired
            difference Newcombe's.
    """
    known = [(a, b) for a, b in pairs if math.isfinite(a) and math.isfinite(b)]
    first, second = ([value for value in side if math.isfinite(value)] for side in sides)
    if rates:
        counts = Counter((a > 0.5, b > 0.5) for a, b in known)
        only_first, only_second = counts[True, False], counts[False, True]
        difference = (only_second - only_first) / len(known) if known else math.nan
        around = paired_rate_interval(
            counts[True, True], only_first, only_second, counts[False, False]
        )
        before, after = (
            metrics.wilson_interval(round(sum(side)), len(side)) if side else NO_INTERVAL
            for side in (first, second)
        )
    else:
        differences = [b - a for a, b in known]
        difference, around = _mean(differences), metrics.bootstrap_interval(differences)
        before, after = metrics.bootstrap_interval(first), metrics.bootstrap_interval(second)
    return MetricComparison(
        (_mean(first), _mean(second)),
        (before, after),
        (len(first), len(second)),
        difference,
        around,
        len(known),
    )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


def paired_rate_interval(
    both: int, only_first: int, only_second: int, neither: int
) -> metrics.Interval:
    """Return the 95 % interval of the difference of two paired rates, second minus first.

    Newcombe's square-and-add interval of Wilson's (Statistics in Medicine 17, 1998, method 10).
    NaN without pairs.

    Args:
        both: pairs in which both succeed.
        only_first: pairs in which only the first one does.
        only_second: pairs in which only the second one does.
        neither: pairs in which none does.
    """
    count = both + only_first + only_second + neither
    if count == 0:
        return NO_INTERVAL
    hits = both + only_second, both + only_first
    (low2, high2), (low1, high1) = (metrics.wilson_interval(hit, count) for hit in hits)
    p2, p1 = (hit / count for hit in hits)
    margins = (both + only_first) * (only_second + neither)
    margins *= (both + only_second) * (only_first + neither)
    phi = 0.0  # the correlation of the outcomes, corrected for continuity as Newcombe does
    if margins:
        cross = both * neither - only_first * only_second
        corrected = max(cross - count / 2.0, 0.0) if cross > 0 else float(cross)
        phi = corrected / math.sqrt(margins)
    down, up = p2 - low2, high2 - p2
    own_down, own_up = p1 - low1, high1 - p1
    below = math.sqrt(max(0.0, down**2 - 2.0 * phi * down * own_up + own_up**2))
    above = math.sqrt(max(0.0, up**2 - 2.0 * phi * up * own_down + own_down**2))
    return p2 - p1 - below, p2 - p1 + above


@dataclass(frozen=True, eq=False)
class EpisodeOutcome:
    """One episode of a task."""

    log: str
    key: SeedKey
    """Seed, and which one of the episodes with this seed."""
    success: float
    """1 or 0; NaN where the recording doesn't tell."""
    seconds: float
    track: EpisodeTrack
    episode: Episode

    @property
    def name(self) -> str:
        """The seed, and which one with this seed."""
        seed, again = self.key
        named = f"episode {again}" if seed is None else f"seed {seed}"
        return named if seed is None or not again else f"{named} ({again + 1})"

    @property
    def goal(self) -> Any:
        """The goal x, y in the odometry frame [m]; None where the recording doesn't tell."""
        return self.episode.info.get("goal")

    @property
    def path_length(self) -> float:
        """Length of the path by odometry [m]."""
        return path_length(self.episode.poses[:, :2])

    @property
    def turning_per_metre(self) -> float:
        """Heading changes per metre [rad/m]."""
        return total_turning(self.episode.poses) / max(self.path_length, 1e-9)

    @property
    def odometry_error(self) -> float:
        """Distance between odometry and truth at the end [m]; NaN on hardware."""
        if not self.track.known:
            return math.nan
        return float(np.hypot(*(self.track.odometry[-1] - self.track.truth[-1])[:2]))

    @property
    def episode_return(self) -> float:
        """Sum of the rewards; NaN without any."""
        return float(self.episode.rewards.sum()) if len(self.episode.rewards) else math.nan


EpisodePairs = tuple[tuple[EpisodeOutcome, EpisodeOutcome], ...]


@dataclass(frozen=True)
class EpisodeMetric:
    """A metric of an episode."""

    label: str
    unit: str
    scale: float
    of: Callable[[EpisodeOutcome], float]


EPISODE_METRICS: dict[str, EpisodeMetric] = {
    "success_rate": EpisodeMetric("success", "%", 100.0, lambda o: o.success),
    "time_to_goal": EpisodeMetric(
        "time to the goal", "s", 1.0, lambda o: o.seconds if o.success == 1.0 else math.nan
    ),
    "episode_return": EpisodeMetric("return", "", 1.0, lambda o: o.episode_return),
    "length": EpisodeMetric("steps", "", 1.0, lambda o: float(len(o.episode.rewards) or math.nan)),
    "path": EpisodeMetric("path", "m", 1.0, lambda o: o.path_length),
    "smoothness": EpisodeMetric("turning", "rad/m", 1.0, lambda o: o.turning_per_metre),
    "odometry_error": EpisodeMetric("odometry error", "cm", 100.0, lambda o: o.odometry_error),
}
"""Metrics by name, the same as those of `evaluate`; the success rate is the only rate."""


@dataclass(frozen=True, eq=False)
class SideComparison:
    """Two sides of a task, and their pairs."""

    task: str
    names: tuple[str, str]
    outcomes: tuple[tuple[EpisodeOutcome, ...], tuple[EpisodeOutcome, ...]]
    pairs: EpisodePairs
    notes: tuple[str, ...]
    labels: tuple[str, ...] = ()
    """Names of the task's numbers in an observation, as far as the recordings tell them."""
    policies: str = ""
    """Says that the policies differ; empty where they don't."""

    def comparisons(self) -> dict[str, MetricComparison]:
        """Compare every metric that both sides have."""
        found = {}
        for name, metric in EPISODE_METRICS.items():
            first, second = ([metric.of(one) for one in side] for side in self.outcomes)
            pairs = [(metric.of(a), metric.of(b)) for a, b in self.pairs]
            one = compare_values((first, second), pairs, rates=name == "success_rate")
            if min(one.counts):
                found[name] = one
        return found

    def delays(self) -> DelayComparison:
        """Test whether the delays of the two sides differ."""
        samples = [np.concatenate([o.track.delays for o in side]) for side in self.outcomes]
        return compare_delays(samples[0], samples[1])

    def observations(self) -> tuple[Floats, Floats]:
        """Return all observations of both sides, (n, size); empty if there are none."""
        return self._stack_rows("observations")

    def actions(self) -> tuple[Floats, Floats]:
        """Return all actions of both sides, (n, 2)."""
        return self._stack_rows("actions")

    def _stack_rows(self, name: str) -> tuple[Floats, Floats]:
        """The rows of all episodes of each side that have any."""
        stacked = []
        for side in self.outcomes:
            rows = [np.asarray(getattr(outcome.episode, name), np.float64) for outcome in side]
            stacked.append(np.concatenate([one for one in rows if one.size] or [np.zeros((0, 0))]))
        return stacked[0], stacked[1]


def distribution_distances(first: Floats, second: Floats) -> list[float]:
    """Return the Kolmogorov-Smirnov distance of each column, 0 (equal) to 1.

    It is a size, not a test: the rows of an episode aren't independent of each other.
    """
    with require_extra("a comparison", "scipy"):
        from scipy.stats import ks_2samp  # noqa: PLC0415 - slow to import

    if not (first.size and second.size):
        return []
    columns = range(first.shape[1])
    return [float(ks_2samp(first[:, i], second[:, i]).statistic) for i in columns]


def compare_sides(
    first: NamedRecordings, second: NamedRecordings, names: tuple[str, str] = ("sim", "real")
) -> SideComparison:
    """Pair the episodes of two sides by their seeds.

    Args:
        first: recordings of the first side, such as the simulation.
        second: recordings of the second side.
        names: what the sides are called.

    Raises:
        ConfigError: the recordings are of different robots or tasks, or have no seed in common.
    """
    logs = [*first, *second]
    odd = check_kinds(first, second, names)
    check_same_robot(logs, "compare", wire=False)
    task = find_common_task(logs)
    sides = tuple(_list_outcomes(first)), tuple(_list_outcomes(second))
    for side, recordings in zip(sides, (first, second), strict=True):
        if not side:
            raise ConfigError(f"{recordings[0][0]}: holds no episode that was driven")
    known = {outcome.key: outcome for outcome in sides[0]}
    common = [(known[o.key], o) for o in sides[1] if o.key in known]
    if not common:
        raise ConfigError(
            f"no episode in common: {names[0]} has {_describe_seeds(sides[0])}, {names[1]} "
            f"{_describe_seeds(sides[1])}; record both with the same seeds"
        )
    widths = {o.episode.observations.shape[1] for s in sides for o in s if o.episode.rewards.size}
    if len(widths) > 1:
        sizes = " and ".join(map(str, sorted(widths)))
        raise ConfigError(f"{second[0][0]}: another task: observations of {sizes} numbers")
    pairs = tuple((a, b) for a, b in common if have_same_goal(a.goal, b.goal))
    if not pairs:
        one, other = common[0]
        raise ConfigError(
            f"no pair has the same goal: {one.name} of {one.log} and of {other.log} differ; record "
            "both with the same seeds and goals"
        )
    notes = [*odd, *_note_sides(logs, sides, len(common), names)]
    if any(one.key[0] is None for one, _ in common):
        notes.append("episodes without a seed were paired in their order")
    others = [pair for pair in common if pair not in pairs]
    notes += [f"{one.name} of {other.log}: left out, another goal" for one, other in others]
    labels = _read_about(first[0][1]).get("observation")
    return SideComparison(
        task,
        names,
        sides,
        pairs,
        tuple(notes),
        tuple(str(name)[:40] for name in labels) if isinstance(labels, list) else (),
        describe_policies(first, second),
    )


def _list_outcomes(logs: NamedRecordings) -> list[EpisodeOutcome]:
    """The episodes of one side; repeated seeds are counted."""
    whole = [
        (name, log.config, one)
        for name, log in logs
        for one in log.episodes
        if not find_damage(one)
    ]
    seeds = (one.info.get("seed") for _, _, one in whole)
    keys = number_seeds(None if seed is None else int(seed) for seed in seeds)
    outcomes = []
    for key, (name, config, episode) in zip(keys, whole, strict=True):
        success = math.nan if episode.success is None else float(episode.success)
        seconds = float(episode.stamps[-1] - episode.stamps[0]) + config.period
        track = make_recorded_track(episode, config)
        outcomes.append(EpisodeOutcome(name, key, success, seconds, track, episode))
    return outcomes


def _describe_seeds(side: Sequence[EpisodeOutcome]) -> str:
    seeds = sorted({outcome.key[0] for outcome in side if outcome.key[0] is not None})
    if not seeds:
        return "none"
    if len(seeds) == 1:
        return f"seed {seeds[0]}"
    whole = len(seeds) == seeds[-1] - seeds[0] + 1
    return f"seeds {seeds[0]} to {seeds[-1]}" if whole else f"{len(seeds)} seeds, {seeds[0]}, ..."


def _note_sides(
    logs: NamedRecordings,
    sides: tuple[tuple[EpisodeOutcome, ...], tuple[EpisodeOutcome, ...]],
    pairs: int,
    names: tuple[str, str],
) -> list[str]:
    """Say what limits the comparison; episodes aren't valid with too many late ticks."""
    limits = {name: log.config.late_tick for name, log in logs}
    notes = [f"{name}: its end is missing; the rest was used" for name, log in logs if log.cut]
    notes += [f"{name}: {log.dropped:,} ticks are missing" for name, log in logs if log.dropped]
    for name, side in zip(names, sides, strict=True):
        if alone := len(side) - pairs:
            notes.append(f"{name}: {alone} of {len(side)} episodes have no partner")
    for name, side in zip(names, sides, strict=True):
        for one in side:
            known = one.episode.lateness[np.isfinite(one.episode.lateness)]
            share = float(np.mean(known > limits[one.log])) if len(known) else 0.0
            if share > MAX_LATE_SHARE:
                notes.append(
                    f"{name}, {one.name} of {one.log}: invalid, {share:.0%} of its ticks were "
                    "late; it was compared all the same"
                )
    return notes


def check_kinds(
    first: NamedRecordings, second: NamedRecordings, names: tuple[str, str]
) -> list[str]:
    """Say which recordings aren't of the kind of their side; only simulated ticks have no lateness.

    Args:
        first: of the simulation.
        second: of the robot.
        names: what the sides are called.

    Raises:
        ConfigError: the sides are swapped.
    """
    notes, simulated = [], []
    kinds = {True: "a simulated robot", False: "a real robot"}
    for side, wanted, logs in zip(names, (True, False), (first, second), strict=True):
        own = [all(np.isnan(one.lateness).all() for one in log.episodes) for _, log in logs]
        simulated.append(own)
        for (name, _), kind in zip(logs, own, strict=True):
            if kind != wanted:
                notes.append(f"{name}: is of {kinds[kind]}, but named as {side}")
    if not any(simulated[0]) and all(simulated[1]):
        raise ConfigError(
            f"{first[0][0]}: is of a real robot, and {second[0][0]} of a simulated one: name the "
            "simulation first"
        )
    return notes


def _read_about(recording: Recording) -> Mapping[str, Any]:
    """What the program said about a recording."""
    about = recording.header.get("about")
    return about if isinstance(about, Mapping) else {}


def find_common_task(logs: NamedRecordings) -> str:
    """Return the task of all recordings; ConfigError if they have different ones."""
    tasks = []
    for name, recording in logs:
        env = _read_about(recording).get("env")
        tasks.append(str(env.get("id") or "") if isinstance(env, Mapping) else "")
        if tasks[-1] != tasks[0]:
            what = f"is of {tasks[-1] or 'no task'}, but {logs[0][0]} of {tasks[0] or 'no task'}"
            raise ConfigError(f"{name}: {what}")
    return tasks[0]


def describe_policies(first: NamedRecordings, second: NamedRecordings) -> str:
    """Say that the policies differ; empty if they don't, as far as the recordings tell."""
    sides: list[set[tuple[str, str]]] = []
    for logs in (first, second):
        sides.append(set())
        for _, recording in logs:
            policy = _read_about(recording).get("policy")
            if not isinstance(policy, Mapping):
                sides[-1].add(("", str(policy or "none told")[:60]))
                continue
            sha256 = str(policy.get("sha256") or "")
            name = Path(str(policy.get("file") or "unnamed")).name[:60]
            sides[-1].add((sha256, f"{name} ({sha256[:8]})" if sha256 else name))
    if len(sides[0] | sides[1]) < 2:
        return ""
    told = [", ".join(sorted(name for _, name in side)) for side in sides]
    return f"policies differ: {told[0]} vs {told[1]}"


def conclude_comparison(sides: SideComparison) -> list[str]:
    """Say in a few lines how far apart the sides are."""
    (first, second), test, count = sides.names, sides.delays(), len(sides.pairs)
    comparisons = sides.comparisons()
    lines = [sides.policies] if sides.policies else []
    lines.append(f"{count} pair{'s' * (count != 1)} of episodes")
    known = [name for name, one in comparisons.items() if one.enough]
    different = [name for name in known if comparisons[name].differs]
    for name in different:
        value, one = EPISODE_METRICS[name], comparisons[name]
        low, high = (end * value.scale for end in one.interval)
        more = "more" if one.difference > 0.0 else "less"
        size = abs(one.difference) * value.scale
        lines.append(
            f"{value.label}: {second} has {size:.3g} {value.unit} {more} than {first} "
            f"(95 % interval {low:.3g} to {high:.3g})".replace("  ", " ")
        )
    if not known:
        lines.append(f"too few pairs ({count}) to tell whether {first} and {second} differ")
    elif not different:
        lines.append(f"no metric differs measurably between {first} and {second}")
    if math.isnan(test.p_value):
        return [*lines, explain_few_steps(test)]
    by, differ = (
        format_lag(test.difference),
        "differ" if test.differs else "don't differ measurably",
    )
    return [*lines, f"delays {differ}: {second} answers {by} than {first} (p = {test.p_value:.2g})"]


def comparison_columns(sides: SideComparison) -> tuple[str, ...]:
    """Return the headings of `comparison_rows`."""
    first, second = sides.names
    around = "95 % interval"
    return ("metric", "unit", first, around, second, around, "difference", around, "pairs")


def comparison_rows(sides: SideComparison) -> list[tuple[str, ...]]:
    """Return a row for every metric that both sides have."""
    rows = []
    for name, one in sides.comparisons().items():
        metric = EPISODE_METRICS[name]
        cells = [metric.label, metric.unit]
        for mean, interval in zip(one.values, one.intervals, strict=True):
            cells += [format_cell(mean, metric.scale), format_interval(interval, metric.scale)]
        cells.append(format_cell(one.difference, metric.scale) + (" *" if one.differs else ""))
        rows.append((*cells, format_interval(one.interval, metric.scale), str(one.pairs)))
    return rows


def comparison_table(sides: SideComparison) -> Table:
    """Make the table of a comparison."""
    task = sides.task or "recordings without an environment"
    title = f"{task}: {sides.names[0]} and {sides.names[1]}, episodes paired by seed"
    if sides.policies:
        title += f"; {sides.policies}"
    made = Table(title=escape_text(title), title_justify="left")
    for number, name in enumerate(comparison_columns(sides)):
        made.add_column(escape_text(name), justify="left" if number < 2 else "right")
    for row in comparison_rows(sides):
        made.add_row(*row)
    made.caption = "* the interval of the paired difference leaves out zero"
    return made


def format_comparison(sides: SideComparison) -> dict[str, Any]:
    """Return the comparison for JSON, in SI units; what isn't known is null."""
    pairs = [
        {
            "seed": first.key[0],
            "values": {n: [v.of(first), v.of(second)] for n, v in EPISODE_METRICS.items()},
        }
        for first, second in sides.pairs
    ]
    told: dict[str, Any] = metrics.replace_nonfinite(
        {
            "task": sides.task,
            "sides": list(sides.names),
            "episodes": [len(side) for side in sides.outcomes],
            "metrics": {name: asdict(one) for name, one in sides.comparisons().items()},
            "delays": asdict(sides.delays()),
            "observation_distances": distribution_distances(*sides.observations()),
            "action_distances": distribution_distances(*sides.actions()),
            "pairs": pairs,
            "notes": list(sides.notes),
            "conclusion": conclude_comparison(sides),
        }
    )
    return told


def difference_sizes(sides: SideComparison) -> dict[str, float]:
    """Return the differences by metric, for `--fail-over`; NaN where they aren't known."""
    known = {name: one.difference for name, one in sides.comparisons().items()}
    found = {name: known.get(name, float("nan")) for name in EPISODE_METRICS}
    return found | {"delay": sides.delays().difference}
