"""What makes a training survive its end: checkpoints, signals, and full disks.

A checkpoint is a model as stable-baselines3 saves it, which also says of which training it is, and
beside it the replay buffer and the statistics of VecNormalize, where the training has them.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import signal
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Self

from acsar_gym import reading
from acsar_gym.errors import AcsarError, ConfigError, format_error

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

CHECKPOINTS_FOLDER = "checkpoints"
"""In the folder of a training."""
TRAINING_KEY = "acsar_gym.training"
"""Attribute of a model, and so key in its zip, that holds the `TrainingState`."""
KEPT_CHECKPOINTS = 2
"""How many checkpoints are kept."""
BUFFER_FILE, NORMALIZER_FILE = "replay_buffer.pkl", "vecnormalize.pkl"
"""Beside the checkpoints, of the newest one."""
_NAME = re.compile(r"rl_model_(\d+)_steps\.zip")
"""Named as RL Zoo does."""
DISK_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
"""Errors of a disk that takes no more."""
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass(frozen=True)
class TrainingState:
    """What a checkpoint says of its training."""

    run: str
    """Id of the training, which its config.yml has, too."""
    steps: int
    """Env steps so far."""
    seconds: float
    """Time so far [s]."""
    history: list[dict[str, float]]
    """The learning curve so far; see `held_out`."""


def write_checkpoint(folder: Path, model: BaseAlgorithm, state: TrainingState) -> Path:
    """Write a checkpoint whole or not at all, then remove older ones.

    Returns:
        Path of the checkpoint.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"rl_model_{state.steps}_steps.zip"
    setattr(model, TRAINING_KEY, asdict(state))
    trained: Any = model
    if getattr(model, "replay_buffer", None) is not None:
        with reading.replace_file(folder / BUFFER_FILE) as new:
            trained.save_replay_buffer(new)
    if (normalizer := model.get_vec_normalize_env()) is not None:
        with reading.replace_file(folder / NORMALIZER_FILE) as new:
            normalizer.save(str(new))
    with reading.replace_file(path) as new:
        model.save(new)
    for old in find_checkpoints(folder)[:-KEPT_CHECKPOINTS]:
        old.unlink(missing_ok=True)
    return path


def load_beside(folder: Path, model: BaseAlgorithm) -> None:
    """Load the replay buffer and the statistics of rewards beside a checkpoint; can run code."""
    from stable_baselines3.common.vec_env import VecNormalize  # noqa: PLC0415 - imports torch

    trained: Any = model
    if getattr(model, "replay_buffer", None) is not None and (folder / BUFFER_FILE).exists():
        trained.load_replay_buffer(folder / BUFFER_FILE)
    normalizer = model.get_vec_normalize_env()
    if normalizer is not None and (folder / NORMALIZER_FILE).exists():
        saved = VecNormalize.load(str(folder / NORMALIZER_FILE), normalizer.venv)
        normalizer.ret_rms = saved.ret_rms


def find_checkpoints(folder: Path) -> list[Path]:
    """List the checkpoints in a folder, the newest last."""
    named = [(_NAME.fullmatch(path.name), path) for path in folder.glob("*.zip")]
    return [path for _, path in sorted((int(name[1]), path) for name, path in named if name)]


def read_state(path: Path) -> TrainingState:
    """Read what a checkpoint says of its training; runs no code."""
    try:
        with zipfile.ZipFile(path) as archive:
            return TrainingState(**json.loads(archive.read("data"))[TRAINING_KEY])
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        said = format_error(error)
        raise ConfigError(f"{path}: not a whole checkpoint of 'acsar-gym train': {said}") from error


@contextlib.contextmanager
def explain_disk_errors(out: Path) -> Iterator[None]:
    """Turn the errors of a full or broken disk into one line that says what there is."""
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
