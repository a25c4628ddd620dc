"""Checkpoints: a model's zip that also holds the state of everything else in a training.

A checkpoint is a zip of stable-baselines3 with these entries more:

| entry | content |
|---|---|
| `acsar_gym/state.json` | the rest of `State` |
| `acsar_gym/NAME.npy` | one array |
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acsar_gym.errors import ConfigError
from acsar_gym.reading import bounded

FOLDER = "acsar_gym/"
STATE = f"{FOLDER}state.json"
KEPT = 2
"""How many checkpoints are kept."""
_NAME = re.compile(r"rl_model_(\d+)_steps\.zip")
"""Named as RL Zoo does."""


@dataclass(frozen=True)
class State:
    """What a training needs besides its model to go on as if nothing had happened."""

    steps: int
    """Env steps so far."""
    seconds: float
    """Time so far [s]."""
    history: list[dict[str, float]]
    """The learning curve so far; see `history`."""
    random: dict[str, Any]
    """States of the generators that aren't arrays."""
    arrays: dict[str, NDArray[Any]]
    """The batch, generators, and what else the algorithm has."""


def write(folder: Path, save: Callable[[Path], object], state: State) -> Path:
    """Write a checkpoint whole or not at all, then remove older ones.

    Args:
        folder: made if it is missing.
        save: writes the model's zip to the path that it is given.
        state: the rest.

    Returns:
        Path of the checkpoint.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"rl_model_{state.steps}_steps.zip"
    with bounded.replacing(path) as new:
        save(new)
        with zipfile.ZipFile(new, "a") as archive:
            _append(archive, state)
    for old in found(folder)[:-KEPT]:
        old.unlink(missing_ok=True)
    return path


def _append(archive: zipfile.ZipFile, state: State) -> None:
    """Add the state to a zip."""
    facts = asdict(state)
    for name, array in facts.pop("arrays").items():
        with archive.open(f"{FOLDER}{name}.npy", "w", force_zip64=True) as file:
            np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
    archive.writestr(STATE, json.dumps(facts))


def found(folder: Path) -> list[Path]:
    """List the checkpoints in a folder, the newest last."""
    named = [(_NAME.fullmatch(path.name), path) for path in folder.glob("*.zip")]
    return [path for _, path in sorted((int(name[1]), path) for name, path in named if name)]


def read(path: Path) -> State:
    """Read the state in a checkpoint; runs no code.

    Raises:
        ConfigError: it can't be read, or has no state.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            facts = json.loads(archive.read(STATE))
            return State(**facts, arrays=_arrays(archive))
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ConfigError(f"{path}: not a whole checkpoint of 'acsar-gym train': {said}") from None


def _arrays(archive: zipfile.ZipFile) -> dict[str, NDArray[Any]]:
    """Read all arrays of a checkpoint."""
    arrays = {}
    for entry in archive.namelist():
        if entry.startswith(FOLDER) and entry.endswith(".npy"):
            with archive.open(entry) as file:
                name = entry.removeprefix(FOLDER).removesuffix(".npy")
                arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
    return arrays


def part(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose name begins with "PREFIX/", without it."""
    start = f"{prefix}/"
    return {n.removeprefix(start): array for n, array in arrays.items() if n.startswith(start)}
