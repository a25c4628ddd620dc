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
import signal
import threading
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.errors import ConfigError

STATE_FOLDER = "acsar_gym/"
STATE_FILE = f"{STATE_FOLDER}state.json"
KEPT_CHECKPOINTS = 2
"""How many checkpoints are kept."""
_NAME = re.compile(r"rl_model_(\d+)_steps\.zip")
"""Named as RL Zoo does."""


@dataclass(frozen=True)
class TrainingState:
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


def write_checkpoint(folder: Path, save: Callable[[Path], object], state: TrainingState) -> Path:
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
    with reading.replace_file(path) as new:
        save(new)
        with zipfile.ZipFile(new, "a") as archive:
            _append(archive, state)
    for old in find_checkpoints(folder)[:-KEPT_CHECKPOINTS]:
        old.unlink(missing_ok=True)
    return path


def _append(archive: zipfile.ZipFile, state: TrainingState) -> None:
    """Add the state to a zip."""
    facts = asdict(state)
    for name, array in facts.pop("arrays").items():
        with archive.open(f"{STATE_FOLDER}{name}.npy", "w", force_zip64=True) as file:
            np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
    archive.writestr(STATE_FILE, json.dumps(facts))


def find_checkpoints(folder: Path) -> list[Path]:
    """List the checkpoints in a folder, the newest last."""
    named = [(_NAME.fullmatch(path.name), path) for path in folder.glob("*.zip")]
    return [path for _, path in sorted((int(name[1]), path) for name, path in named if name)]


def read_state(path: Path) -> TrainingState:
    """Read the state in a checkpoint; runs no code.

    Raises:
        ConfigError: it can't be read, or has no state.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            facts = json.loads(archive.read(STATE_FILE))
            return TrainingState(**facts, arrays=_arrays(archive))
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        said = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise ConfigError(f"{path}: not a whole checkpoint of 'acsar-gym train': {said}") from None


def _arrays(archive: zipfile.ZipFile) -> dict[str, NDArray[Any]]:
    """Read all arrays of a checkpoint."""
    arrays = {}
    for entry in archive.namelist():
        if entry.startswith(STATE_FOLDER) and entry.endswith(".npy"):
            with archive.open(entry) as file:
                name = entry.removeprefix(STATE_FOLDER).removesuffix(".npy")
                arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
    return arrays


def select_arrays(arrays: Mapping[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    """Return the arrays whose name begins with "PREFIX/", without it."""
    start = f"{prefix}/"
    return {n.removeprefix(start): array for n, array in arrays.items() if n.startswith(start)}


# Handles Ctrl-C and SIGTERM during training, so that the model is saved first.

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class StopRequest:
    """A context in which SIGINT and SIGTERM set `number` instead of ending the program.

    This starts with `defer()`; before, there is nothing to save, and a signal ends the program at
    once. So does a second signal. Signals that were ignored stay ignored, such as SIGINT in a
    background process of a shell without job control. Outside the main thread, which can't set
    handlers, signals aren't changed.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        """The signal that arrived; None before."""
        self._deferred = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for each in STOP_SIGNALS:
                if signal.getsignal(each) is not signal.SIG_IGN:
                    self._before[each] = signal.signal(each, self._note)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)

    def defer(self) -> None:
        """From now on, only record the first signal."""
        self._deferred = True

    @property
    def exit_code(self) -> int:
        """Exit code for shells: 128 plus the signal number, or 0 without a signal."""
        return 0 if self.number is None else 128 + self.number

    def _note(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal: record the first one after defer(), end the program otherwise."""
        first, self.number = self.number is None, number
        if self._deferred and first:
            return
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(self.exit_code)
