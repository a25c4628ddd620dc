"""Compares recordings of one task in simulation and on hardware, episodes paired by seed."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from acsar_gym.errors import ConfigError, require_extra
from acsar_gym.links.lateness import LATE_TICK
from acsar_gym.recording.replay import check_same_robot
from acsar_gym.recording.types import Episode, Recording
from acsar_gym.tools.evaluation.metrics import (
    Interval,
    bootstrap_interval,
    replace_nonfinite,
    wilson_interval,
)
from acsar_gym.tools.evaluation.report import escape_text
from acsar_gym.tools.sysid import tracks
from acsar_gym.tools.sysid.delays import (
    DelayComparison,
    compare_delays,
    explain_few_steps,
    format_lag,
)
from acsar_gym.tools.sysid.tracks import EpisodeTrack
from acsar_gym.tools.sysid.twin_gap import format_cell, format_interval
from acsar_gym.worlds.world import to_odometry

NO_INTERVAL = (math.nan, math.nan)
FEWEST_PAIRS = 2
"""Fewest pairs that have an interval."""


@dataclass(frozen=True, slots=True)
class MetricComparison:
    """One metric of two sides. NaN where a side has no value, as for the time of a failure."""

    values: tuple[float, float]
    """Mean or rate of each side."""
    intervals: tuple[Interval, Interval]
    """95 % intervals: Wilson for rates, bootstrap for means."""
    counts: tuple[int, int]
    """Episodes with a value."""
    difference: float
    """Mean difference of the pairs, second minus first."""
    interval: Interval
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


def compare_means(
    first: Sequence[float], second: Sequence[float], pairs: Sequence[tuple[float, float]]
) -> MetricComparison:
    """Compare means of values; those that are NaN are left out.

    Args:
        first: values of the first side.
        second: values of the second side.
        pairs: values of the paired episodes, (first, second).
    """
    known = [(a, b) for a, b in pairs if math.isfinite(a) and math.isfinite(b)]
    differences = [b - a for a, b in known]
    sides = [[value for value in side if math.isfinite(value)] for side in (first, second)]
    means = [_mean(side) for side in sides]
    return MetricComparison(
        (means[0], means[1]),
        (bootstrap_interval(sides[0]), bootstrap_interval(sides[1])),
        (len(sides[0]), len(sides[1])),
        _mean(differences),
        bootstrap_interval(differences),
        len(known),
    )


def compare_rates(
    first: Sequence[float], second: Sequence[float], pairs: Sequence[tuple[float, float]]
) -> MetricComparison:
    """Compare rates of values that are 0 or 1; arguments as for `of_means`."""
    known = [(a, b) for a, b in pairs if math.isfinite(a) and math.isfinite(b)]
    sides = [[value for value in side if math.isfinite(value)] for side in (first, second)]
    ends = [wilson_interval(round(sum(side)), len(side)) if side else NO_INTERVAL for side in sides]
    both = sum(a > 0.5 and b > 0.5 for a, b in known)
    only_first = sum(a > 0.5 > b for a, b in known)
    only_second = sum(b > 0.5 > a for a, b in known)
    neither = len(known) - both - only_first - only_second
    return MetricComparison(
        (_mean(sides[0]), _mean(sides[1])),
        (ends[0], ends[1]),
        (len(sides[0]), len(sides[1])),
        (only_second - only_first) / len(known) if known else math.nan,
        paired_rate_interval(both, only_first, only_second, neither),
        len(known),
    )


def paired_rate_interval(both: int, only_first: int, only_second: int, neither: int) -> Interval:
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
    (low2, high2), (low1, high1) = (wilson_interval(hit, count) for hit in hits)
    p2, p1 = (hit / count for hit in hits)
    phi = _correlation(both, only_first, only_second, neither)
    down, up = p2 - low2, high2 - p2
    own_down, own_up = p1 - low1, high1 - p1
    below = math.sqrt(max(0.0, down**2 - 2.0 * phi * down * own_up + own_up**2))
    above = math.sqrt(max(0.0, up**2 - 2.0 * phi * up * own_down + own_down**2))
    return p2 - p1 - below, p2 - p1 + above


def _correlation(both: int, only_first: int, only_second: int, neither: int) -> float:
    """Return the correlation of paired outcomes, corrected for continuity as Newcombe does."""
    margins = (both + only_first) * (only_second + neither)
    margins *= (both + only_second) * (only_first + neither)
    if margins == 0:
        return 0.0
    cross = both * neither - only_first * only_second
    count = both + only_first + only_second + neither
    corrected = max(cross - count / 2.0, 0.0) if cross > 0 else float(cross)
    return corrected / math.sqrt(margins)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan


NamedRecordings = Sequence[tuple[str, Recording]]
"""Recordings with the names of their files."""
SAME_GOAL_DISTANCE = 0.01
"""Goals that are nearer to each other are one [m]."""
LATE_SHARE = 0.01
"""An episode in which a larger share of the ticks is late isn't valid, as for `evaluate`."""
RECORDING_KINDS = {True: "a simulated robot", False: "a real robot"}


def _about(recording: Recording) -> Mapping[str, Any]:
    """Return what the program said about a recording."""
    about = recording.header.get("about")
    return about if isinstance(about, Mapping) else {}


def _task_of(recording: Recording) -> str:
    """Return the id of the env that was recorded; empty if there was none."""
    env = _about(recording).get("env")
    return str(env.get("id") or "") if isinstance(env, Mapping) else ""


def observation_labels(recording: Recording) -> tuple[str, ...]:
    """Return the names of the task's numbers in an observation; empty if they aren't known."""
    names = _about(recording).get("observation")
    return tuple(str(name)[:40] for name in names) if isinstance(names, list) else ()


def find_common_task(logs: NamedRecordings) -> str:
    """Return the task of all recordings; ConfigError if they have different ones."""
    first = _task_of(logs[0][1])
    for name, recording in logs[1:]:
        other = _task_of(recording)
        if other != first:
            raise ConfigError(
                f"{name}: is of {other or 'no task'}, but {logs[0][0]} of {first or 'no task'}"
            )
    return first


def was_simulated(recording: Recording) -> bool:
    """Whether the robot was simulated; only then, ticks have no lateness."""
    return all(bool(np.isnan(one.lateness).all()) for one in recording.episodes)


def check_kinds(
    first: NamedRecordings, second: NamedRecordings, names: tuple[str, str]
) -> list[str]:
    """Say which recordings aren't of the kind of their side.

    Args:
        first: of the simulation.
        second: of the robot.
        names: what the sides are called.

    Raises:
        ConfigError: the sides are swapped.
    """
    found = [[was_simulated(log) for _, log in side] for side in (first, second)]
    if not any(found[0]) and all(found[1]):
        raise ConfigError(
            f"{first[0][0]}: is of a real robot, and {second[0][0]} of a simulated one: name the "
            "simulation first"
        )
    return [
        f"{name}: is of {RECORDING_KINDS[kind]}, but named as {side}"
        for side, wanted, logs, own in zip(
            names, (True, False), (first, second), found, strict=True
        )
        for (name, _), kind in zip(logs, own, strict=True)
        if kind != wanted
    ]


def describe_policies(first: NamedRecordings, second: NamedRecordings) -> str:
    """Say that the policies differ; empty if they don't, as far as the recordings tell."""
    named = [{_policy(log) for _, log in side} for side in (first, second)]
    if len(named[0] | named[1]) < 2:
        return ""
    told = [", ".join(sorted(name for _, name in side)) for side in named]
    return f"policies differ: {told[0]} vs {told[1]}"


def _policy(recording: Recording) -> tuple[str, str]:
    """Hash and short name of the policy that drove."""
    policy = _about(recording).get("policy")
    if not isinstance(policy, Mapping):
        return "", str(policy or "none told")[:60]
    sha256 = str(policy.get("sha256") or "")
    name = Path(str(policy.get("file") or "unnamed")).name[:60]
    return sha256, f"{name} ({sha256[:8]})" if sha256 else name


def have_same_goal(one: Episode, other: Episode) -> bool:
    """Whether two episodes had the same goal, seen from their starts; true where it isn't told."""
    goals = [_goal(episode) for episode in (one, other)]
    if goals[0] is None or goals[1] is None:
        return True
    return float(np.hypot(*np.subtract(goals[0], goals[1]))) < SAME_GOAL_DISTANCE


def _goal(episode: Episode) -> tuple[float, float] | None:
    """The goal in the frame of the start [m]; None if it isn't told."""
    goal, start = episode.info.get("goal"), episode.info.get("start") or (0.0, 0.0, 0.0)
    if not goal:
        return None
    x, y, _ = to_odometry(tuple(start), (float(goal[0]), float(goal[1]), 0.0))
    return x, y


def note_lateness(name: str, episode: Episode) -> list[str]:
    """Say that an episode isn't valid because too many of its ticks were late."""
    known = episode.lateness[np.isfinite(episode.lateness)]
    share = float(np.mean(known > LATE_TICK)) if len(known) else 0.0
    if share <= LATE_SHARE:
        return []
    return [f"{name}: invalid, {share:.0%} of its ticks were late; it was compared all the same"]


EpisodeKey = tuple[int | None, int]
"""Seed, and which one of the episodes with this seed."""


@dataclass(frozen=True, eq=False)
class EpisodeOutcome:
    """One episode of a task."""

    log: str
    key: EpisodeKey
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


EpisodePairs = tuple[tuple[EpisodeOutcome, EpisodeOutcome], ...]


@dataclass(frozen=True)
class EpisodeMetric:
    """A metric of an episode."""

    label: str
    unit: str
    scale: float
    of: Callable[[EpisodeOutcome], float]


def _length(outcome: EpisodeOutcome) -> float:
    """Return the length of the path by odometry [m]."""
    return float(np.hypot(*np.diff(outcome.episode.poses[:, :2], axis=0).T).sum())


def _turning(outcome: EpisodeOutcome) -> float:
    """Return heading changes per metre [rad/m]."""
    headings = np.unwrap(outcome.episode.poses[:, 2])
    return float(np.abs(np.diff(headings)).sum()) / max(_length(outcome), 1e-9)


def _drift(outcome: EpisodeOutcome) -> float:
    """Return the distance between odometry and truth at the end [m]; NaN on hardware."""
    track = outcome.track
    if not track.known:
        return math.nan
    return float(np.hypot(*(track.odometry[-1] - track.truth[-1])[:2]))


def _reward(outcome: EpisodeOutcome) -> float:
    rewards = outcome.episode.rewards
    return float(rewards.sum()) if len(rewards) else math.nan


EPISODE_METRICS: dict[str, EpisodeMetric] = {
    "success_rate": EpisodeMetric("success", "%", 100.0, lambda outcome: outcome.success),
    "time_to_goal": EpisodeMetric(
        "time to the goal", "s", 1.0, lambda o: o.seconds if o.success == 1.0 else math.nan
    ),
    "episode_return": EpisodeMetric("return", "", 1.0, _reward),
    "length": EpisodeMetric("steps", "", 1.0, lambda o: float(len(o.episode.rewards) or math.nan)),
    "path": EpisodeMetric("path", "m", 1.0, _length),
    "smoothness": EpisodeMetric("turning", "rad/m", 1.0, _turning),
    "odometry_error": EpisodeMetric("odometry error", "cm", 100.0, _drift),
}
"""Metrics by name, the same as those of `evaluate`."""
RATE_METRICS = ("success_rate",)


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
        found = {name: self._compared(name) for name in EPISODE_METRICS}
        return {name: one for name, one in found.items() if min(one.counts)}

    def _compared(self, name: str) -> MetricComparison:
        value = EPISODE_METRICS[name].of
        sides = [[value(outcome) for outcome in side] for side in self.outcomes]
        pairs = [(value(a), value(b)) for a, b in self.pairs]
        return (compare_rates if name in RATE_METRICS else compare_means)(sides[0], sides[1], pairs)

    def delays(self) -> DelayComparison:
        """Test whether the delays of the two sides differ."""
        samples = [np.concatenate([o.track.delays for o in side]) for side in self.outcomes]
        return compare_delays(samples[0], samples[1])

    def observations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return all observations of both sides, (n, size); empty if there are none."""
        first, second = (_stacked(side, "observations") for side in self.outcomes)
        return first, second

    def actions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return all actions of both sides, (n, 2)."""
        first, second = (_stacked(side, "actions") for side in self.outcomes)
        return first, second


def _stacked(side: Sequence[EpisodeOutcome], name: str) -> NDArray[np.float64]:
    """Return the rows of all episodes of a side that have any."""
    rows = [np.asarray(getattr(outcome.episode, name), np.float64) for outcome in side]
    return np.concatenate([one for one in rows if one.size] or [np.zeros((0, 0))])


def distribution_distances(first: NDArray[np.float64], second: NDArray[np.float64]) -> list[float]:
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
    sides = tuple(_outcomes(first)), tuple(_outcomes(second))
    for side, recordings in zip(sides, (first, second), strict=True):
        if not side:
            raise ConfigError(f"{recordings[0][0]}: holds no episode that was driven")
    known = {outcome.key: outcome for outcome in sides[0]}
    common = tuple((known[o.key], o) for o in sides[1] if o.key in known)
    if not common:
        raise ConfigError(
            f"no episode in common: {names[0]} has {_seeds(sides[0])}, {names[1]} "
            f"{_seeds(sides[1])}; record both with the same seeds"
        )
    widths = {o.episode.observations.shape[1] for s in sides for o in s if o.episode.rewards.size}
    if len(widths) > 1:
        sizes = " and ".join(map(str, sorted(widths)))
        raise ConfigError(f"{second[0][0]}: another task: observations of {sizes} numbers")
    pairs, others = _of_one_goal(common)
    notes = [*odd, *_notes(logs, sides, common, names), *others]
    policies = describe_policies(first, second)
    return SideComparison(
        task, names, sides, pairs, tuple(notes), observation_labels(first[0][1]), policies
    )


def _of_one_goal(pairs: EpisodePairs) -> tuple[EpisodePairs, list[str]]:
    """Leave out pairs whose goals differ; returns the others, and lines about those left out.

    Raises:
        ConfigError: no pair is left.
    """
    same = tuple(pair for pair in pairs if have_same_goal(pair[0].episode, pair[1].episode))
    others = [one for one in pairs if one not in same]
    if not same:
        one, other = others[0]
        raise ConfigError(
            f"no pair has the same goal: {one.name} of {one.log} and of {other.log} differ; record "
            "both with the same seeds and goals"
        )
    return same, [f"{one.name} of {two.log}: left out, another goal" for one, two in others]


def _outcomes(logs: NamedRecordings) -> list[EpisodeOutcome]:
    """Return the episodes of one side; repeated seeds are counted."""
    seen: Counter[int | None] = Counter()
    outcomes = []
    for name, recording in logs:
        for episode in recording.episodes:
            if tracks.find_damage(episode):
                continue
            seed = episode.info.get("seed")
            key = (None if seed is None else int(seed), seen[seed])
            seen[seed] += 1
            outcomes.append(
                EpisodeOutcome(
                    name,
                    key,
                    math.nan if episode.success is None else float(episode.success),
                    float(episode.stamps[-1] - episode.stamps[0]) + recording.config.period,
                    tracks.make_recorded_track(episode, recording.config),
                    episode,
                )
            )
    return outcomes


def _seeds(side: Sequence[EpisodeOutcome]) -> str:
    """Describe the seeds of a side."""
    seeds = sorted({outcome.key[0] for outcome in side if outcome.key[0] is not None})
    if not seeds:
        return "none"
    if len(seeds) == 1:
        return f"seed {seeds[0]}"
    whole = len(seeds) == seeds[-1] - seeds[0] + 1
    return f"seeds {seeds[0]} to {seeds[-1]}" if whole else f"{len(seeds)} seeds, {seeds[0]}, ..."


def _notes(
    logs: NamedRecordings,
    sides: tuple[tuple[EpisodeOutcome, ...], tuple[EpisodeOutcome, ...]],
    pairs: Sequence[tuple[EpisodeOutcome, EpisodeOutcome]],
    names: tuple[str, str],
) -> list[str]:
    """Say what limits the comparison."""
    notes = [f"{name}: its end is missing; the rest was used" for name, log in logs if log.cut]
    notes += [f"{name}: {log.dropped:,} ticks are missing" for name, log in logs if log.dropped]
    for name, side in zip(names, sides, strict=True):
        alone = len(side) - len(pairs)
        if alone:
            notes.append(f"{name}: {alone} of {len(side)} episodes have no partner")
    for name, side in zip(names, sides, strict=True):
        for one in side:
            notes += note_lateness(f"{name}, {one.name} of {one.log}", one.episode)
    if any(pair[0].key[0] is None for pair in pairs):
        notes.append("episodes without a seed were paired in their order")
    return notes


def conclude_comparison(sides: SideComparison) -> list[str]:
    """Say in a few lines how far apart the sides are."""
    first, second = sides.names
    lines: list[str] = []
    for name, one in sides.comparisons().items():
        value = EPISODE_METRICS[name]
        if not one.differs or not one.enough:
            continue
        low, high = (end * value.scale for end in one.interval)
        more = "more" if one.difference > 0.0 else "less"
        size = abs(one.difference) * value.scale
        lines.append(
            f"{value.label}: {second} has {size:.3g} {value.unit} {more} than {first} "
            f"(95 % interval {low:.3g} to {high:.3g})".replace("  ", " ")
        )
    count = len(sides.pairs)
    if not any(one.enough for one in sides.comparisons().values()):
        lines.append(f"too few pairs ({count}) to tell whether {first} and {second} differ")
    elif not lines:
        lines.append(f"no metric differs measurably between {first} and {second}")
    said = [f"{count} pair{'s' * (count != 1)} of episodes", *lines, _conclude_delays(sides)]
    return [sides.policies, *said] if sides.policies else said


def _conclude_delays(sides: SideComparison) -> str:
    """Say whether the delays differ."""
    test, (first, second) = sides.delays(), sides.names
    if math.isnan(test.p_value):
        return explain_few_steps(test)
    by = format_lag(test.difference)
    differ = "differ" if test.differs else "don't differ measurably"
    return f"delays {differ}: {second} answers {by} than {first} (p = {test.p_value:.2g})"


def comparison_columns(sides: SideComparison) -> tuple[str, ...]:
    """Return the headings of `rows`."""
    first, second = sides.names
    around = "95 % interval"
    return ("metric", "unit", first, around, second, around, "difference", around, "pairs")


def comparison_rows(sides: SideComparison) -> list[tuple[str, ...]]:
    """Return a row for every metric that both sides have."""
    return [_row(name, one) for name, one in sides.comparisons().items()]


def _row(name: str, one: MetricComparison) -> tuple[str, ...]:
    """Format one metric."""
    value = EPISODE_METRICS[name]
    cells = [value.label, value.unit]
    for mean, interval in zip(one.values, one.intervals, strict=True):
        cells += [format_cell(mean, value.scale), format_interval(interval, value.scale)]
    mark = " *" if one.differs else ""
    cells.append(format_cell(one.difference, value.scale) + mark)
    return (*cells, format_interval(one.interval, value.scale), str(one.pairs))


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
    told: dict[str, Any] = replace_nonfinite(
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
