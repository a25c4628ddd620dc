"""Writes checkpoints during a training, and explains where the disk is full. Imports torch."""

from __future__ import annotations

import contextlib
import errno
import os
import time
from collections.abc import Iterator
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from acsar_gym.errors import AcsarError
from acsar_gym.tools.training import checkpoints, states
from acsar_gym.tools.training.callbacks import HeldOutEvaluation
from acsar_gym.tools.training.checkpoints import TrainingState
from acsar_gym.vector.env import RobotVectorEnv

DISK_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS}
"""Errors of a disk that takes no more."""


class TrainingClock:
    """Time since the beginning of a training.

    Args:
        begin: by `time.monotonic` [s].
        before: time that the training took before it was resumed [s].
    """

    def __init__(self, begin: float, before: float = 0.0) -> None:
        self._begin = begin - before

    def __call__(self) -> float:
        """Return the time so far [s]."""
        return time.monotonic() - self._begin


class CheckpointWriter(BaseCallback):
    """Writes a checkpoint between two rollouts, whenever some time has passed.

    Args:
        folder: where to.
        batch: the robots that are trained on.
        scores: has the learning curve.
        seconds: time between two checkpoints [s].
        state: what to restore before the first rollout; None for nothing.
    """

    def __init__(
        self,
        folder: Path,
        batch: RobotVectorEnv,
        scores: HeldOutEvaluation,
        seconds: float,
        state: TrainingState | None = None,
    ) -> None:
        super().__init__()
        self._folder, self._batch, self._scores = folder, batch, scores
        self._seconds, self._state = seconds, state
        self._due = self._written = 0.0

    def _on_training_start(self) -> None:
        if self._state is not None:
            states.restore_state(self._state, self.model, self._batch)
        self._state = None
        self._due = time.monotonic() + self._seconds
        self._written = self.model.num_timesteps

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        if time.monotonic() >= self._due:
            self.write()
            self._due = time.monotonic() + self._seconds

    def write(self) -> None:
        """Write a checkpoint, unless there is one of so many steps; only between two rollouts."""
        if self.model.num_timesteps > self._written:
            scores = self._scores
            state = states.take_state(self.model, self._batch, scores.clock(), scores.rows)
            checkpoints.write_checkpoint(self._folder, self.model.save, state)
            self._written = self.model.num_timesteps


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
        found = checkpoints.find_checkpoints(out / "checkpoints")
        kept = f"{found[-1]} is whole" if found else "there is no checkpoint yet"
        go_on = f", then go on with --resume {out} --trust" if found else ""
        said = f"{os.strerror(full.errno)}; {kept}: make room{go_on}"
        raise AcsarError(f"--out {out}: can't be written: {said}") from None
