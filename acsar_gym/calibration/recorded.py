"""Runs of a recording, to give readings to."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from acsar_gym.calibration.runs import Run, check_robot
from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError
from acsar_gym.recording import Episode, read


def runs_of(path: Path, manoeuvre: str, config: RobotConfig) -> list[Run]:
    """Make a run of each episode of a recording.

    Args:
        path: the recording, such as one of `calibrate --record`.
        manoeuvre: what it recorded: straight, turn or square.
        config: of the robot.

    Raises:
        ConfigError: the file can't be read, nothing turned, it is of another robot, or the
            manoeuvre isn't named.
    """
    if manoeuvre == "all":
        raise ConfigError(f"{path}: say what was recorded: straight, turn or square")
    recording = read(path)
    check_robot(str(path), recording.config.model_dump(), config)
    moved = [episode for episode in recording.episodes if np.abs(episode.speeds).max(initial=0.0)]
    if not moved:
        raise ConfigError(f"{path}: no episode in which a wheel turned")
    return [
        Run(f"{manoeuvre} {number} of {path.name}", manoeuvre, _wheels(episode))
        for number, episode in enumerate(moved, start=1)
    ]


def _wheels(episode: Episode) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Angles of the left and right wheels at the end of each tick, (n + 1, 2) [rad]."""
    dt = np.diff(episode.stamps, prepend=episode.start)
    dt[0] = min(dt[0], np.median(dt))  # the reset's wait for standstill is before the first tick
    a, b, c, d = episode.speeds.T
    turned = np.column_stack([(b + c) / 2.0, (a + d) / 2.0]) * dt[:, None]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
