"""The folder of a training: its config.yml, its models, and what `--resume` takes from them.

A folder holds one training. `config.yml` is created exclusively, so that two trainings never write
to the same folder.
"""

from __future__ import annotations

import contextlib
import csv
import json
import shlex
import subprocess
import zipfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsar_gym import reading
from acsar_gym.errors import ConfigError, explain_error
from acsar_gym.resources import PACKAGE
from acsar_gym.tools.evaluation import provenance
from acsar_gym.tools.training.options import TrainingOptions

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

CONFIG_FILE = "config.yml"
"""The recipe by the env's id, so that the file is a --conf-file, and `RUN_KEY`."""
RUN_KEY = "run"
"""Key of options, versions, revision and command."""
MODEL_FILE = "model.zip"
POLICY_FILE = "policy.onnx"
CHECKPOINTS_FOLDER = "checkpoints"
BUFFER_FILE = "replay_buffer.pkl"
"""Beside a model with a replay buffer."""
KEPT_CHECKPOINTS = 2
MAX_CONFIG_BYTES = 1_000_000
RECORDED_LIBRARIES = ("torch", "stable-baselines3", "sb3-contrib", "numba")
"""Their versions are recorded, in addition to those of every result."""
GIT_TIMEOUT = 5.0
"""Time limit of git [s]."""
CHANGEABLE_OPTIONS = {
    *("steps", "target", "threads", "progress", "checkpoint_seconds", "device"),
    *("resume", "trust"),
}
"""Options that may change when a training goes on."""


def make_folder(out: Path | None, env: str) -> Path:
    """Make the folder of a new training: `out`, which may be empty, or the next of runs/ENV.

    Raises:
        ConfigError: `out` isn't empty, or a folder can't be made.
    """
    folder = out or Path("runs") / env / "1"
    try:
        if out is not None:
            check_empty(out)
            out.mkdir(parents=True, exist_ok=True)
            return out

        folder.parent.mkdir(parents=True, exist_ok=True)
        # Of several trainings that start at the same time, only one can make a folder.
        while True:
            try:
                folder.mkdir()
            except FileExistsError:  # another training's
                folder = folder.with_name(str(int(folder.name) + 1))
            else:
                return folder
    except OSError as error:
        raise ConfigError(f"--out {folder}: {explain_error(error)}") from error


def check_empty(out: Path) -> None:
    """Raise ConfigError for a folder that isn't empty."""
    if out.is_dir() and any(out.iterdir()):
        raise ConfigError(
            f"--out {out}: isn't empty: name another folder, or go on with its training: --resume "
            f"{shlex.quote(str(out))} --trust"
        )


# config.yml


def begin_config(folder: Path, key: str, recipe: dict[str, Any], options: TrainingOptions) -> None:
    """Write config.yml of a new training. ConfigError if another training has the folder."""
    facts = {"options": options.model_dump(mode="json"), **describe_origin(options)}
    # Only one of two trainings that started at the same time can create the file.
    try:
        with (folder / CONFIG_FILE).open("x", encoding="utf-8") as file:
            file.write(reading.format_yaml({key: recipe, RUN_KEY: facts}))
    except FileExistsError as error:
        raise ConfigError(f"--out {folder}: another training has it: name another") from error


def update_config(folder: Path, options: TrainingOptions) -> None:
    """Write the changed options of a training that goes on to config.yml, for the next time."""
    file = folder / CONFIG_FILE
    config = reading.parse_yaml(reading.decode_text(reading.read_file(file, MAX_CONFIG_BYTES)))
    recorded = CHANGEABLE_OPTIONS - {"resume", "trust"}
    config[RUN_KEY]["options"] |= options.model_dump(mode="json", include=recorded)
    with reading.replace_file(file) as new:
        new.write_text(reading.format_yaml(config), encoding="utf-8")


def describe_origin(options: TrainingOptions) -> dict[str, Any]:
    """Return command, versions and revision of a training."""
    return {
        "command": training_command(options),
        "versions": provenance.library_versions(*RECORDED_LIBRARIES),
        "revision": git_revision(),
    }


def training_command(options: TrainingOptions) -> str:
    """Return the command of a training, without folders: only the names of files elsewhere."""
    # Policies contain the command and are published: it names no folder of a machine.
    words = ["acsar-gym", "train"]
    values = options.model_dump(mode="json", exclude_defaults=True, exclude={"out", "address"})
    for name, value in values.items():
        flag = f"--{name.replace('_', '-')}"
        items = value if isinstance(value, list) else [value]
        texts = [Path(item).name if str(item).startswith("/") else str(item) for item in items]
        if isinstance(value, bool):
            words.append(flag if value else f"--no-{flag[2:]}")
        elif name == "worlds":
            words += [word for text in texts for word in (flag, text)]
        else:
            words += [flag, *texts]
    return shlex.join(words)


def git_revision() -> str | None:
    """Return the git revision of the package, with "-dirty" if files differ. None without git."""
    # The folder is named, as an installation may be inside another project's repository.
    command = ["git", f"--git-dir={PACKAGE.parent / '.git'}", f"--work-tree={PACKAGE.parent}"]
    command += ["describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        return subprocess.check_output(
            command, stderr=subprocess.DEVNULL, text=True, timeout=GIT_TIMEOUT
        ).strip()
    return None


# Models and tables


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file, all of it or nothing."""
    with reading.replace_file(path) as new, new.open("w", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([columns, *rows])


def write_model(model: BaseAlgorithm, path: Path) -> None:
    """Write a model, and its replay buffer beside it, each of them whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The buffer first: a model without its buffer would go on with an empty one.
    writer: Any = model
    if getattr(model, "replay_buffer", None) is not None:
        with reading.replace_file(path.with_name(BUFFER_FILE)) as new:
            writer.save_replay_buffer(new)
    with reading.replace_file(path) as new:
        writer.save(new)


def write_checkpoint(model: BaseAlgorithm, folder: Path) -> None:
    """Write a checkpoint, named as by stable-baselines3, then remove older ones."""
    checkpoints = folder / CHECKPOINTS_FOLDER
    write_model(model, checkpoints / f"rl_model_{model.num_timesteps}_steps.zip")
    for path in find_models(checkpoints)[KEPT_CHECKPOINTS:]:
        path.unlink(missing_ok=True)


def find_models(folder: Path) -> list[Path]:
    """List the complete models in a folder and its checkpoints, the newest first."""
    # A file that was cut by a full disk or a kill has no steps.
    steps = {path: count_steps(path) for path in folder.rglob("*.zip")}
    complete = [path for path in steps if steps[path] >= 0]
    return sorted(complete, key=steps.__getitem__, reverse=True)


def count_steps(path: Path) -> int:
    """Return the steps of a model. -1 if its zip isn't complete."""
    return int(read_data(path).get("num_timesteps", -1))


def read_data(path: Path) -> dict[str, Any]:
    """Return the numbers and texts in a model's zip. Empty if it isn't complete. Runs no code."""
    try:
        with zipfile.ZipFile(path) as archive:
            return dict(json.loads(archive.read("data")))
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile):
        return {}


def resume_options(options: TrainingOptions, folder: Path) -> tuple[TrainingOptions, Path]:
    """Find out with what a training goes on.

    Args:
        options: The user's options.
        folder: Folder of the training.

    Returns:
        The options of the folder, with the user's changes, and the model to go on with.

    Raises:
        ConfigError: The folder has no model, or is of another training.
    """
    config = folder / CONFIG_FILE
    with reading.name_errors(f"--resume {folder}"):
        text = reading.decode_text(reading.read_file(config, MAX_CONFIG_BYTES))
        run = (reading.parse_yaml(text) or {}).get(RUN_KEY)
        if not isinstance(run, dict):
            raise ConfigError(f"{CONFIG_FILE} isn't of 'acsar-gym train'")
        first_options = TrainingOptions.model_validate(run.get("options"))
        models = find_models(folder)
        if not models:
            raise ConfigError("has no complete model yet: start a new training")

    # Whatever would make it another training is refused.
    changes = options.model_dump(exclude_defaults=True)
    for name, value in changes.items():
        first_value = getattr(first_options, name)
        if name not in CHANGEABLE_OPTIONS and value != first_value:
            flag = f"--{name.replace('_', '-')}"
            raise ConfigError(
                f"{flag} {value}: {folder} is of a training with {first_value}: leave {flag} out, "
                "or start a new training"
            )

    # config.yml contains the hyperparameters that were options.
    fixed = {"out": folder, "conf_file": config, "trust": options.trust}
    fixed |= dict.fromkeys(("gamma", "learning_rate", "net"))
    return first_options.model_copy(update=changes | fixed), models[0]
