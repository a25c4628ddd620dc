"""A second recording over the first: which episodes belong together, and how far apart they are."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, escape_unprintable
from acsar_gym.recording.pairs import SeedKey, have_same_goal, number_seeds
from acsar_gym.recording.types import Floats
from acsar_gym.tools.view.tail import GrowingEpisode, RecordingTail
from acsar_gym.worlds.world import to_odometry


class Partner(NamedTuple):
    """An episode that is drawn over another one."""

    episode: GrowingEpisode
    config: RobotConfig
    shift: float
    """What to add to a time of the other one, as a real robot waits for standstill before its
    first tick [s]."""


class Gap(NamedTuple):
    """How far two robots are from each other at the same time since their first ticks."""

    distance: float
    """[m]; NaN where a pose isn't known."""
    turn: float
    """Difference of the headings, 0 to pi [rad]."""


class Overlay:
    """A recording whose episodes are drawn over those of another one.

    Args:
        path: of the recording, which is read once.

    Raises:
        ConfigError: it can't be read, or holds no episode.
    """

    def __init__(self, path: Path) -> None:
        self._tail = RecordingTail(path)
        self.name = escape_unprintable(path.name)
        if not self._tail.episodes:
            raise ConfigError(f"{path}: holds no episode")
        keys = list_keys(self._tail.episodes)
        self._episodes = dict(zip(keys, self._tail.episodes, strict=True))

    def find_partner(self, episodes: Sequence[GrowingEpisode], number: int) -> Partner:
        """Find the episode of the same seed and goal, as `acsar-gym compare` does.

        Args:
            episodes: of the other recording.
            number: of the one whose partner is asked for.

        Raises:
            ConfigError: there is none.
        """
        seed, again = key = list_keys(episodes[: number + 1])[-1]
        found = self._episodes.get(key)
        named = f"episode {again + 1} without a seed" if seed is None else f"seed {seed}"
        named += f" for the {again + 1}th time" if seed is not None and again else ""
        if found is None:
            raise ConfigError(f"{self.name}: has no {named}: record both with the same seeds")
        if not have_same_goal(episodes[number].goal, found.goal):
            raise ConfigError(f"{self.name}: {named} has another goal: record both with the same")
        first = [one.column("stamp")[:1].sum() for one in (found, episodes[number])]
        return Partner(found, self._tail.config, float(first[0] - first[1]))


def list_keys(episodes: Sequence[GrowingEpisode]) -> list[SeedKey]:
    """Return the seed of each episode, and how many before it have the same one."""
    seeds = (episode.info.get("seed") for episode in episodes)
    return number_seeds(seed if isinstance(seed, int) else None for seed in seeds)


def measure_gaps(episode: GrowingEpisode, other: Partner, times: Floats) -> Floats:
    """Measure how far apart two robots are by odometry.

    A robot whose episode is over stays where it was.

    Args:
        episode: of the one.
        other: its partner.
        times: (n,) since the reset of `episode` [s].

    Returns:
        (n, 2) distances [m] and differences of the headings, 0 to pi [rad].
    """
    poses = [
        _interpolate(one.column("stamp"), one.poses, times + shift)
        for one, shift in ((episode, 0.0), (other.episode, other.shift))
    ]
    return _subtract(poses[0], poses[1])


def measure_true_gap(episode: GrowingEpisode, other: Partner, time: float) -> Gap:
    """Measure how far two simulated robots truly are from each other, seen from their starts."""
    poses = []
    for one, shift in (episode, 0.0), (other.episode, other.shift):
        rows, when = one.truth.rows, np.array([time + shift])
        pose = _interpolate(rows[:, 0], rows[:, 1:4], when)[0].tolist()
        poses.append(np.array([to_odometry(one.start, (pose[0], pose[1], pose[2]))]))
    return Gap(*_subtract(poses[0], poses[1])[0].tolist())


def _interpolate(stamps: Floats, poses: Floats, times: Floats) -> Floats:
    """Poses (m, 3) at some times, (n, 3); NaN where there are none."""
    if not len(stamps):
        return np.full((len(times), 3), np.nan)
    right = np.minimum(np.searchsorted(stamps, times, "right"), len(stamps) - 1)
    left = np.maximum(right - 1, 0)
    span, passed = stamps[right] - stamps[left], times - stamps[left]
    share = np.divide(passed, span, out=np.zeros(len(times)), where=span > 0.0)
    change = poses[right] - poses[left]
    change[:, 2] = _wrap(change[:, 2])
    found: Floats = poses[left] + np.clip(share, 0.0, 1.0)[:, None] * change
    return found


def _wrap(angles: Floats) -> Floats:
    """Wrap angles to [-pi, pi) [rad]."""
    wrapped: Floats = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped


def _subtract(one: Floats, other: Floats) -> Floats:
    """Distances and differences of headings of poses (n, 3), (n, 2)."""
    dx, dy, turn = (one - other).T
    return np.stack([np.hypot(dx, dy), np.abs(_wrap(turn))], axis=1)
