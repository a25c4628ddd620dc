"""What `--resume` begins with: a folder of a training to go on with, or a model to train on."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from acsar_gym.errors import ConfigError
from acsar_gym.policies import ZipPolicy
from acsar_gym.training import checkpoints, record, saving
from acsar_gym.training.checkpoints import State
from acsar_gym.training.options import Options

CHECKPOINTS = "checkpoints"
FREE = ("steps", "target", "threads", "progress", "checkpoint_seconds", "resume", "trust", "device")
"""Options that may change when a training goes on."""


@dataclass(frozen=True)
class Start:
    """What a training begins with."""

    options: Options
    """The user's; those of the folder where one is resumed."""
    saved: ZipPolicy | None = None
    """The model to load; None for a new one."""
    state: State | None = None
    """What to restore besides the model; None to begin anew."""


def start(options: Options) -> Start:
    """Find out what a training begins with.

    One whose steps are done, but whose policy couldn't be written, as on a full disk, goes on with
    no more steps.

    Args:
        options: the user's options.

    Raises:
        ConfigError: the folder has no checkpoint, all its steps are done, or the options are of
            another training.
        PolicyError: the zip can't be read, or isn't trusted.
    """
    if options.resume is None:
        return Start(options)
    if not options.resume.is_dir():
        return Start(options, ZipPolicy(options.resume, trust=options.trust))
    folder = options.resume
    merged = _merged(folder, options)
    merged.check()
    found = checkpoints.found(folder / CHECKPOINTS)
    if not found:
        raise ConfigError(f"{folder}: has no checkpoint yet: train anew, without --resume")
    saved, state = _read(found, trust=options.trust)
    done = merged.steps is not None and state.steps >= merged.steps
    if done and record.finished(folder) and all((folder / name).exists() for name in saving.FILES):
        raise ConfigError(
            f"{folder}: its {merged.steps:,} steps are done: ask for more with --steps"
        )
    return Start(merged, saved, state)


def _read(found: list[Path], *, trust: bool) -> tuple[ZipPolicy, State]:
    """Read the newest checkpoint; the error names an older one, if there is one."""
    *older, newest = found
    try:
        state = checkpoints.read(newest)
    except ConfigError as error:
        instead = f": delete it to go on from {older[-1]}" if older else ""
        raise ConfigError(f"{error}{instead}") from None
    return ZipPolicy(newest, trust=trust), state


def _merged(folder: Path, options: Options) -> Options:
    """Return the options of a folder, changed by what the user gave.

    Raises:
        ConfigError: the user gave what can't be changed.
    """
    before, changes = record.options(folder), _given(options)
    for name, value in changes.items():
        if name not in FREE and value != getattr(before, name) and name != "out":
            flag = name.replace("_", "-")
            raise ConfigError(
                f"--{flag} {value}: {folder} is of a training with "
                f"{getattr(before, name)}: leave --{flag} away, or train anew"
            )
    changes |= {"out": folder, "conf_file": folder / record.FILE}
    changes |= dict.fromkeys(("gamma", "learning_rate", "net"))  # in config.yml already
    return replace(before, **changes)


def _given(options: Options) -> dict[str, Any]:
    """Return the options that aren't the defaults."""
    usual = Options()
    pairs = {each.name: getattr(options, each.name) for each in fields(Options)}
    return {name: value for name, value in pairs.items() if value != getattr(usual, name)}
