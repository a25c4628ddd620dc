"""Compares recordings of one task on two sides, such as simulation and hardware."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError, optional
from acsar_gym.gap import tracks, unlike
from acsar_gym.gap.delays import TwoSample, lag, too_few_steps, two_sample
from acsar_gym.gap.paired import Comparison, of_means, of_rates
from acsar_gym.gap.tracks import Track
from acsar_gym.gap.unlike import Named
from acsar_gym.recording.alike import check_same
from acsar_gym.recording.types import Episode

Key = tuple[int | None, int]
"""Seed, and which one of the episodes with this seed."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """One episode of a task."""

    log: str
    key: Key
    success: float
    """1 or 0; NaN where the recording doesn't tell."""
    seconds: float
    track: Track
    episode: Episode

    @property
    def name(self) -> str:
        """The seed, and which one with this seed."""
        seed, again = self.key
        named = f"episode {again}" if seed is None else f"seed {seed}"
        return named if seed is None or not again else f"{named} ({again + 1})"


Pairs = tuple[tuple[Outcome, Outcome], ...]


@dataclass(frozen=True)
class Value:
    """A metric of an episode."""

    label: str
    unit: str
    scale: float
    of: Callable[[Outcome], float]


def _length(outcome: Outcome) -> float:
    """Return the length of the path by odometry [m]."""
    return float(np.hypot(*np.diff(outcome.episode.poses[:, :2], axis=0).T).sum())


def _turning(outcome: Outcome) -> float:
    """Return heading changes per metre [rad/m]."""
    headings = np.unwrap(outcome.episode.poses[:, 2])
    return float(np.abs(np.diff(headings)).sum()) / max(_length(outcome), 1e-9)


def _drift(outcome: Outcome) -> float:
    """Return the distance between odometry and truth at the end [m]; NaN on hardware."""
    track = outcome.track
    if not track.known:
        return math.nan
    return float(np.hypot(*(track.odometry[-1] - track.truth[-1])[:2]))


def _reward(outcome: Outcome) -> float:
    rewards = outcome.episode.rewards
    return float(rewards.sum()) if len(rewards) else math.nan


VALUES: dict[str, Value] = {
    "success_rate": Value("success", "%", 100.0, lambda outcome: outcome.success),
    "time_to_goal": Value(
        "time to the goal", "s", 1.0, lambda o: o.seconds if o.success == 1.0 else math.nan
    ),
    "episode_return": Value("return", "", 1.0, _reward),
    "length": Value("steps", "", 1.0, lambda o: float(len(o.episode.rewards) or math.nan)),
    "path": Value("path", "m", 1.0, _length),
    "smoothness": Value("turning", "rad/m", 1.0, _turning),
    "odometry_error": Value("odometry error", "cm", 100.0, _drift),
}
"""Metrics by name, the same as those of `evaluate`."""
RATES = ("success_rate",)


@dataclass(frozen=True, eq=False)
class Sides:
    """Two sides of a task, and their pairs."""

    task: str
    names: tuple[str, str]
    outcomes: tuple[tuple[Outcome, ...], tuple[Outcome, ...]]
    pairs: Pairs
    notes: tuple[str, ...]
    labels: tuple[str, ...] = ()
    """Names of the task's numbers in an observation, as far as the recordings tell them."""
    policies: str = ""
    """Says that the policies differ; empty where they don't."""

    def comparisons(self) -> dict[str, Comparison]:
        """Compare every metric that both sides have."""
        found = {name: self._compared(name) for name in VALUES}
        return {name: one for name, one in found.items() if min(one.counts)}

    def _compared(self, name: str) -> Comparison:
        value = VALUES[name].of
        sides = [[value(outcome) for outcome in side] for side in self.outcomes]
        pairs = [(value(a), value(b)) for a, b in self.pairs]
        return (of_rates if name in RATES else of_means)(sides[0], sides[1], pairs)

    def delays(self) -> TwoSample:
        """Test whether the delays of the two sides differ."""
        samples = [np.concatenate([o.track.delays for o in side]) for side in self.outcomes]
        return two_sample(samples[0], samples[1])

    def observations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return all observations of both sides, (n, size); empty if there are none."""
        first, second = (_stacked(side, "observations") for side in self.outcomes)
        return first, second

    def actions(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return all actions of both sides, (n, 2)."""
        first, second = (_stacked(side, "actions") for side in self.outcomes)
        return first, second


def _stacked(side: Sequence[Outcome], name: str) -> NDArray[np.float64]:
    """Return the rows of all episodes of a side that have any."""
    rows = [np.asarray(getattr(outcome.episode, name), np.float64) for outcome in side]
    return np.concatenate([one for one in rows if one.size] or [np.zeros((0, 0))])


def distances(first: NDArray[np.float64], second: NDArray[np.float64]) -> list[float]:
    """Return the Kolmogorov-Smirnov distance of each column, 0 (equal) to 1.

    It is a size, not a test: the rows of an episode aren't independent of each other.
    """
    with optional("a comparison", "scipy"):
        from scipy.stats import ks_2samp  # noqa: PLC0415 - slow to import

    if not (first.size and second.size):
        return []
    columns = range(first.shape[1])
    return [float(ks_2samp(first[:, i], second[:, i]).statistic) for i in columns]


def compare(first: Named, second: Named, names: tuple[str, str] = ("sim", "real")) -> Sides:
    """Pair the episodes of two sides by their seeds.

    Args:
        first: recordings of the first side, such as the simulation.
        second: recordings of the second side.
        names: what the sides are called.

    Raises:
        ConfigError: the recordings are of different robots or tasks, or have no seed in common.
    """
    logs = [*first, *second]
    odd = unlike.kinds(first, second, names)
    check_same(logs, "compare", wire=False)
    task = unlike.task(logs)
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
    policies = unlike.policies(first, second)
    return Sides(task, names, sides, pairs, tuple(notes), unlike.labels(first[0][1]), policies)


def _of_one_goal(pairs: Pairs) -> tuple[Pairs, list[str]]:
    """Leave out pairs whose goals differ; returns the others, and lines about those left out.

    Raises:
        ConfigError: no pair is left.
    """
    same = tuple(pair for pair in pairs if unlike.same_goal(pair[0].episode, pair[1].episode))
    others = [one for one in pairs if one not in same]
    if not same:
        one, other = others[0]
        raise ConfigError(
            f"no pair has the same goal: {one.name} of {one.log} and of {other.log} differ; record "
            "both with the same seeds and goals"
        )
    return same, [f"{one.name} of {two.log}: left out, another goal" for one, two in others]


def _outcomes(logs: Named) -> list[Outcome]:
    """Return the episodes of one side; repeated seeds are counted."""
    seen: Counter[int | None] = Counter()
    outcomes = []
    for name, recording in logs:
        for episode in recording.episodes:
            if tracks.damage(episode):
                continue
            seed = episode.info.get("seed")
            key = (None if seed is None else int(seed), seen[seed])
            seen[seed] += 1
            outcomes.append(
                Outcome(
                    name,
                    key,
                    math.nan if episode.success is None else float(episode.success),
                    float(episode.stamps[-1] - episode.stamps[0]) + recording.config.period,
                    tracks.recorded(episode, recording.config),
                    episode,
                )
            )
    return outcomes


def _seeds(side: Sequence[Outcome]) -> str:
    """Describe the seeds of a side."""
    seeds = sorted({outcome.key[0] for outcome in side if outcome.key[0] is not None})
    if not seeds:
        return "none"
    if len(seeds) == 1:
        return f"seed {seeds[0]}"
    whole = len(seeds) == seeds[-1] - seeds[0] + 1
    return f"seeds {seeds[0]} to {seeds[-1]}" if whole else f"{len(seeds)} seeds, {seeds[0]}, ..."


def _notes(
    logs: Named,
    sides: tuple[tuple[Outcome, ...], tuple[Outcome, ...]],
    pairs: Sequence[tuple[Outcome, Outcome]],
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
            notes += unlike.late(f"{name}, {one.name} of {one.log}", one.episode)
    if any(pair[0].key[0] is None for pair in pairs):
        notes.append("episodes without a seed were paired in their order")
    return notes


def conclusion(sides: Sides) -> list[str]:
    """Say in a few lines how far apart the sides are."""
    first, second = sides.names
    lines: list[str] = []
    for name, one in sides.comparisons().items():
        value = VALUES[name]
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
    said = [f"{count} pair{'s' * (count != 1)} of episodes", *lines, _about_delays(sides)]
    return [sides.policies, *said] if sides.policies else said


def _about_delays(sides: Sides) -> str:
    """Say whether the delays differ."""
    test, (first, second) = sides.delays(), sides.names
    if math.isnan(test.p_value):
        return too_few_steps(test)
    by = lag(test.difference)
    differ = "differ" if test.differs else "don't differ measurably"
    return f"delays {differ}: {second} answers {by} than {first} (p = {test.p_value:.2g})"
