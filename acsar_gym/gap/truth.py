"""True poses of an emulated robot, from the emulator's log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from acsar_gym.errors import ConfigError
from acsar_gym.evaluation.episodes import true_poses
from acsar_gym.gap.delays import Floats
from acsar_gym.recording.types import Episode, Recording


def with_truth(recording: Recording, log: Path) -> Recording:
    """Add true poses to a recording that was made over a pseudo-terminal.

    The link and the emulator both use the machine's monotonic clock.

    Args:
        recording: whose truth isn't known.
        log: of `acsar-gym emulate --log`.

    Raises:
        ConfigError: the log holds no true poses, or is of another time.
    """
    stamps, poses = (np.array(column, np.float64) for column in true_poses(log))
    poses[:, 2] = np.unwrap(poses[:, 2])
    period = recording.config.period
    episodes = [_with_truth(episode, stamps, poses, period) for episode in recording.episodes]
    if not any(np.isfinite(episode.truth).any() for episode in episodes):
        raise ConfigError(f"{log}: is of another time than the recording")
    return replace(recording, episodes=tuple(episodes))


def _with_truth(episode: Episode, stamps: Floats, poses: Floats, period: float) -> Episode:
    """Add true poses to an episode, if the log covers it."""
    if not len(episode.stamps) or np.isfinite(episode.truth).any():
        return episode
    when = np.r_[episode.stamps[0] - period, episode.stamps]
    if when[0] < stamps[0] or when[-1] > stamps[-1]:
        return episode
    found = np.column_stack([np.interp(when, stamps, column) for column in poses.T])
    info = {**episode.info, "start": found[0].tolist()}
    return replace(episode, truth=found[1:], info=info)
