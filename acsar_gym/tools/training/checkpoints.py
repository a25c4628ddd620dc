"""What makes a training survive its end: checkpoints, signals, and full disks.

A checkpoint is a zip of stable-baselines3 that also holds the state of everything else, so that a
training goes on as if nothing had happened:

| entry | content |
|---|---|
| `acsar_gym/state.json` | the rest of `TrainingState` |
| `acsar_gym/NAME.npy` | one array |
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import random
import re
import signal
import threading
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.errors import AcsarError, ConfigError
from acsar_gym.tools.policies.policy import format_error
from acsar_gym.vector import env as vector
from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

CHECKPOINTS_FOLDER = "checkpoints"
"""In the folder of a training."""
STATE_FOLDER = "acsar_gym/"
STATE_FILE = f"{STATE_FOLDER}state.json"
KEPT_CHECKPOINTS = 2
"""How many checkpoints are kept."""
_NAME = re.compile(r"rl_model_(\d+)_steps\.zip")
"""Named as RL Zoo does."""
REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
"""Arrays of a replay buffer; those of its next observations may be empty."""
DISK_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
"""Errors of a disk that takes no more."""
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class TrainingState:
    """What a training needs besides its model to go on as if nothing had happened."""

    run: str
    """Id of the training, which its config.yml has, too."""
    steps: int
    """Env steps so far."""
    seconds: float
    """Time so far [s]."""
    history: list[dict[str, float]]
    """The learning curve so far; see `held_out`."""
    random: dict[str, Any]
    """States of the generators that aren't arrays."""
    arrays: Arrays
    """The batch, generators, and what else the algorithm has."""

    @property
    def exact(self) -> bool:
        """Whether the robots go on in mid-episode, too."""
        return bool(select_arrays(self.arrays, "batch"))


def take_state(
    run: str,
    model: BaseAlgorithm,
    batch: RobotVectorEnv,
    seconds: float,
    history: list[dict[str, float]],
) -> TrainingState:
    """Copy the state of a training; its model isn't part of it. Imports torch."""
    import torch  # noqa: PLC0415 - takes seconds

    arrays: Arrays = {"torch": torch.get_rng_state().numpy()}
    if torch.cuda.is_available():
        arrays["cuda"] = torch.cuda.get_rng_state().numpy()
    kind, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 - stable-baselines3 uses it
    arrays["numpy"] = np.asarray(keys)
    arrays |= {f"batch/{name}": one for name, one in (vector.copy_state(batch) or {}).items()}
    recurrent: Any = getattr(model, "_last_lstm_states", None)
    for name, pair in zip(("pi", "vf"), recurrent or (), strict=False):
        arrays |= {f"lstm/{name}{i}": pair[i].cpu().numpy() for i in (0, 1)}
    buffer: Any = getattr(model, "replay_buffer", None)
    if buffer is not None:
        filled = buffer.buffer_size if buffer.full else buffer.pos
        for name in REPLAY_ARRAYS:
            if getattr(buffer, name, None) is not None:
                arrays[f"replay/{name}"] = getattr(buffer, name)[:filled]
        arrays["replay/place"] = np.array([buffer.pos, buffer.full])
    generators = {
        "numpy": [kind, *rest],
        "python": random.getstate(),
        "space": model.action_space.np_random.bit_generator.state,
    }
    return TrainingState(run, model.num_timesteps, seconds, list(history), generators, arrays)


def restore_state(state: TrainingState, model: BaseAlgorithm, batch: RobotVectorEnv) -> None:
    """Restore all but the model itself, right before the next rollout. Imports torch.

    Raises:
        ConfigError: the state is of another training.
    """
    import torch  # noqa: PLC0415 - takes seconds

    arrays, generators = state.arrays, state.random
    trained: Any = model
    try:
        if state.exact:
            vector.restore_state(batch, select_arrays(arrays, "batch"))
        recurrent = {
            name: torch.from_numpy(one).to(model.device)
            for name, one in select_arrays(arrays, "lstm").items()
        }
        if recurrent:
            pairs = ((recurrent[f"{name}0"], recurrent[f"{name}1"]) for name in ("pi", "vf"))
            trained._last_lstm_states = type(trained._last_lstm_states)(*pairs)  # noqa: SLF001
        replay = select_arrays(arrays, "replay")
        if replay:
            buffer, place = trained.replay_buffer, replay.pop("place")
            for name, array in replay.items():
                getattr(buffer, name)[: len(array)] = array
            buffer.pos, buffer.full = int(place[0]), bool(place[1])
        kind, *rest = generators["numpy"]
        np.random.set_state((kind, arrays["numpy"], *rest))  # noqa: NPY002
        version, keys, gauss = generators["python"]
        random.setstate((version, tuple(keys), gauss))
        model.action_space.np_random.bit_generator.state = generators["space"]
        torch.set_rng_state(torch.from_numpy(arrays["torch"]))
        if "cuda" in arrays and torch.cuda.is_available():
            torch.cuda.set_rng_state(torch.from_numpy(arrays["cuda"]))
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ConfigError(f"the checkpoint is of another training: {error}") from error


def write_checkpoint(folder: Path, save: Callable[[Path], object], state: TrainingState) -> Path:
    """Write a checkpoint whole or not at all (`save` writes the model), then remove older ones.

    Returns:
        Path of the checkpoint.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"rl_model_{state.steps}_steps.zip"
    facts = asdict(state)
    with reading.replace_file(path) as new:
        save(new)
        with zipfile.ZipFile(new, "a") as archive:
            for name, array in facts.pop("arrays").items():
                with archive.open(f"{STATE_FOLDER}{name}.npy", "w", force_zip64=True) as file:
                    np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(STATE_FILE, json.dumps(facts))
    for old in find_checkpoints(folder)[:-KEPT_CHECKPOINTS]:
        old.unlink(missing_ok=True)
    return path


def find_checkpoints(folder: Path) -> list[Path]:
    """List the checkpoints in a folder, the newest last."""
    named = [(_NAME.fullmatch(path.name), path) for path in folder.glob("*.zip")]
    return [path for _, path in sorted((int(name[1]), path) for name, path in named if name)]


def read_state(path: Path) -> TrainingState:
    """Read the state in a checkpoint; runs no code.

    Raises:
        ConfigError: it can't be read, or has no state.
    """
    arrays: Arrays = {}
    try:
        with zipfile.ZipFile(path) as archive:
            facts = json.loads(archive.read(STATE_FILE))
            for entry in archive.namelist():
                if entry.startswith(STATE_FOLDER) and entry.endswith(".npy"):
                    name = entry.removeprefix(STATE_FOLDER).removesuffix(".npy")
                    with archive.open(entry) as file:
                        arrays[name] = np.lib.format.read_array(file, allow_pickle=False)
            return TrainingState(**{"run": ""} | facts, arrays=arrays)
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        said = format_error(error)
        raise ConfigError(f"{path}: not a whole checkpoint of 'acsar-gym train': {said}") from error


def read_run(path: Path) -> str:
    """Read of which training a checkpoint is; empty where it doesn't say so, or can't be read."""
    try:
        with zipfile.ZipFile(path) as archive:
            return str(json.loads(archive.read(STATE_FILE))["run"])
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile):
        return ""


def select_arrays(arrays: Mapping[str, NDArray[Any]], prefix: str) -> Arrays:
    """Return the arrays whose name begins with "PREFIX/", without it."""
    start = f"{prefix}/"
    return {n.removeprefix(start): array for n, array in arrays.items() if n.startswith(start)}


@contextlib.contextmanager
def explain_disk_errors(out: Path) -> Iterator[None]:
    """Turn the errors of a full or broken disk into one line that says what there is.

    Raises:
        AcsarError: nothing more could be written into the folder.
    """
    try:
        yield
    except (OSError, AcsarError) as error:
        full = error if isinstance(error, OSError) else error.__context__  # of the policy's file
        if not isinstance(full, OSError) or full.errno not in DISK_ERRNOS:
            raise
        found = find_checkpoints(out / CHECKPOINTS_FOLDER)
        kept = f"{found[-1]} is whole" if found else "there is no checkpoint yet"
        go_on = f", then go on with --resume {out} --trust" if found else ""
        said = f"{os.strerror(full.errno)}; {kept}: make room{go_on}"
        raise AcsarError(f"--out {out}: can't be written: {said}") from error


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
                    self._before[each] = signal.signal(each, self._handle_signal)
        return self

    def __exit__(self, *_: object) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)

    def defer(self) -> None:
        """From now on, only record the first signal."""
        self._deferred = True

    @property
    def exit_code(self) -> int:
        """Exit code for shells: 128 plus the signal number, or 0 without a signal."""
        return 0 if self.number is None else 128 + self.number

    def _handle_signal(self, number: int, frame: FrameType | None) -> None:
        """Record the first signal after defer(), end the program otherwise."""
        first, self.number = self.number is None, number
        if self._deferred and first:
            return
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        raise SystemExit(self.exit_code)
