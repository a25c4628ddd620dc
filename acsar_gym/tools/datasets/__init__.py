"""Data sets for offline and imitation learning, made of recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from acsar_gym.errors import ConfigError, explain_error
from acsar_gym.tools.datasets.demonstrations import (
    DemonstrationEpisode,
    Demonstrations,
    read_demonstrations,
)
from acsar_gym.tools.datasets.lerobot import write_lerobot
from acsar_gym.tools.datasets.minari import write_minari

__all__ = [
    "DemonstrationEpisode",
    "Demonstrations",
    "read_demonstrations",
    "write_dataset",
]


def write_dataset(
    paths: Sequence[Path],
    to: str,
    folder: Path,
    env: str = "",
    goal: tuple[float, float] | None = None,
) -> tuple[Path, Demonstrations]:
    """Make one data set of recordings, "minari" or "lerobot", as by `read_demonstrations`.

    Returns:
        The folder of the data set, and what it holds.

    Raises:
        ConfigError: `read_demonstrations` refuses a file, or the folder can't be written.
        MissingExtraError: pyarrow or minari isn't installed.
    """
    data = read_demonstrations(paths, env, goal)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write = write_lerobot if to == "lerobot" else write_minari
        return write(data, folder, paths[0].stem), data
    except OSError as error:
        raise ConfigError(f"{folder}: can't be written: {explain_error(error)}") from error
