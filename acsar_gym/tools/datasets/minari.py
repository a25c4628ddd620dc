"""Writes Minari data sets (https://minari.farama.org)."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np

from acsar_gym.errors import ConfigError, explain_error, require_extra
from acsar_gym.resources import package_version
from acsar_gym.tools.datasets.demonstrations import Demonstrations

MINARI_FOLDER = "MINARI_DATASETS_PATH"
"""Environment variable with the folder in which Minari keeps its data sets."""


def write_minari(data: Demonstrations, folder: Path, name: str) -> Path:
    """Write a data set into a folder in which Minari keeps them.

    Returns:
        The data set's own folder. Characters of the name that Minari doesn't take are replaced.

    Raises:
        ConfigError: A data set of this name is there already.
        MissingExtraError: minari isn't installed.
    """
    with require_extra("export to Minari", "export"):
        import minari  # noqa: PLC0415 - optional
        from gymnasium.spaces import Box  # noqa: PLC0415 - only here
        from minari.data_collector import EpisodeBuffer  # noqa: PLC0415 - optional

    buffers = []
    for number, episode in enumerate(data.episodes):
        is_end = np.arange(len(episode.actions)) == len(episode.actions) - 1
        buffer = EpisodeBuffer(
            id=number,
            seed=episode.seed,
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards.tolist(),
            terminations=(is_end & episode.terminated).tolist(),
            truncations=(is_end & (not episode.terminated)).tolist(),
        )
        buffers.append(buffer)

    name = "".join(c if c.isalnum() else "-" for c in name).strip("-") or "recording"
    user_folder = os.environ.get(MINARI_FOLDER)
    os.environ[MINARI_FOLDER] = str(folder.absolute())
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about authors
            minari.create_dataset_from_buffers(
                f"acsar/{name}-v0",
                buffers,
                observation_space=Box(-np.inf, np.inf, (len(data.names),), np.float32),
                action_space=Box(-1.0, 1.0, (2,), np.float32),
                data_format="arrow",
                algorithm_name=data.policy,
                description=f"Recorded by acsar_gym {package_version()}: {data.env_id}.",
            )
    except ValueError as error:  # it is there already
        raise ConfigError(f"{folder}: can't be written: {explain_error(error)}") from error
    finally:
        os.environ.pop(MINARI_FOLDER)
        if user_folder is not None:
            os.environ[MINARI_FOLDER] = user_folder
    return folder / "acsar" / f"{name}-v0"
