"""The folder of a training, which no other one writes to, neither later nor at the same time."""

from __future__ import annotations

import contextlib
import errno
import itertools
from collections.abc import Iterator
from pathlib import Path

from acsar_gym import reading
from acsar_gym.errors import ConfigError, escape_unprintable, require_extra
from acsar_gym.tools.training import checkpoints
from acsar_gym.tools.training.checkpoints import CHECKPOINTS_FOLDER

CONFIG_FILE = "config.yml"
"""The record of a training."""
MAX_CONFIG_BYTES = 1_000_000
"""Largest accepted config.yml [bytes]."""
FINISHED_LINE = b"\n  finished: true\n"
"""In the record of a training whose steps are done."""
RESULT_FILES = ("policy.onnx", "model.zip")
"""What a training leaves: the policy to drive with, and the model to train on."""
CURVE_FILES = ("learning_curve.csv", "learning_curve.png")
SEEDS_FILE = "seeds.json"
"""The table of a training of several seeds."""
SEED_PREFIX = "seed-"
"""Begins the names of their folders."""
LOCK_FILE = ".lock"
"""Locked while a training runs; the system releases it however the process ends."""
RESUMABLE = ("a finished training", "an unfinished training")
"""Contents that `--resume` goes on with."""
SEVERAL_SEEDS = "trainings of several seeds"
UNLOCKABLE_ERRNOS = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)
"""Errors of file systems that can't lock, such as some of clusters."""


def describe_content(folder: Path) -> str | None:
    """Say what a folder holds of a training; None where a new one may begin in it.

    Returns:
        Words such as "a training", or the name of a file that a training would replace.
    """
    seeds = any(describe_content(path) for path in folder.glob(f"{SEED_PREFIX}*"))
    if seeds or (folder / SEEDS_FILE).exists():
        return SEVERAL_SEEDS
    if (config := folder / CONFIG_FILE).exists():
        with contextlib.suppress(ConfigError):
            if FINISHED_LINE in reading.read_file(config, MAX_CONFIG_BYTES):
                return RESUMABLE[0]
        return RESUMABLE[1]
    if checkpoints.find_checkpoints(folder / CHECKPOINTS_FOLDER):
        return "checkpoints"
    names = (*RESULT_FILES, *CURVE_FILES)
    return next((name for name in names if (folder / name).exists()), None)


def number_folders(default: Path) -> Iterator[Path]:
    """Yield runs/demo, runs/demo-2, runs/demo-3 and so on."""
    yield default
    for number in itertools.count(2):
        yield default.with_name(f"{default.name}-{number}")


def find_free_folder(default: Path) -> Path:
    """Find the first of `number_folders` that holds no training; it may be missing."""
    return next(path for path in number_folders(default) if describe_content(path) is None)


@contextlib.contextmanager
def claim_folder(folder: Path, *, resume: bool = False, numbered: bool = False) -> Iterator[Path]:
    """Make the folder of a training, and keep other trainings out of it until the block ends.

    Yields:
        The folder.
    """
    for path in number_folders(folder) if numbered else [folder]:
        with contextlib.ExitStack() as lock:
            refusal = _lock_folder(path, lock)
            if refusal is None and not resume and (content := describe_content(path)):
                go_on = f", or --resume {path}" if content in RESUMABLE else ""
                refusal = f"holds {content}: name another folder{go_on}"
            if refusal is None:
                if path != folder:
                    print(escape_unprintable(f"{folder} is another training's: using {path}"))
                yield path
                return
        if not numbered:
            raise ConfigError(f"{'--resume' if resume else '--out'} {path}: {refusal}")


def _lock_folder(folder: Path, lock: contextlib.ExitStack) -> str | None:
    """Make and lock a folder; returns why it isn't free, or None."""
    with require_extra("training", "train"):
        import filelock  # noqa: PLC0415 - comes with torch
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.enter_context(filelock.FileLock(folder / LOCK_FILE, blocking=False))
    except filelock.Timeout:
        return "a training is running in it: wait for its end, or name another folder"
    except OSError as error:
        if error.errno not in UNLOCKABLE_ERRNOS:
            why = reading.explain_error(error)
            raise ConfigError(f"--out {folder}: can't be written: {why}") from error
    return None
