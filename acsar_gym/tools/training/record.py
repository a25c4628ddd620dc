"""The folder of a training: its record, its results, and what `--resume` takes from them.

No other training writes to it, neither later nor at the same time.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import platform
import shlex
import subprocess
import uuid
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import acsar_gym
from acsar_gym import reading
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError, escape_unprintable, explain_error, require_extra
from acsar_gym.recording.messages import to_plain_json
from acsar_gym.tools.evaluation import provenance
from acsar_gym.tools.policies import ZipPolicy
from acsar_gym.tools.policies.bundle import Bundle, TrainingSummary
from acsar_gym.tools.training import checkpoints, recipes
from acsar_gym.tools.training.checkpoints import CHECKPOINTS_FOLDER, TrainingState
from acsar_gym.tools.training.plan import TrainingOptions, TrainingPlan
from acsar_gym.vector.threads import usable_cores

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

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
RUN_KEY = "run"
"""Key of what isn't a recipe. The recipe is beside it, so that the file can be a --conf-file."""
RECORDED_LIBRARIES = ("torch", "stable-baselines3", "sb3-contrib", "numba")
"""Their versions are recorded, besides those of every result."""
GIT_TIMEOUT = 5.0
"""Time limit of git [s]."""
CHANGEABLE_OPTIONS = (
    *("steps", "target", "threads", "progress", "checkpoint_seconds", "resume", "trust"),
    *("device", "out"),
)
"""Options that may change when a training goes on."""


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
            why = explain_error(error)
            raise ConfigError(f"--out {folder}: can't be written: {why}") from error
    return None


def git_revision() -> str | None:
    """Return the git revision of the package, with "-dirty" where files differ; None outside."""
    folder = Path(acsar_gym.__file__).resolve().parent.parent
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        told = subprocess.run(
            [*command, "--exclude=*"],
            capture_output=True,
            text=True,
            timeout=GIT_TIMEOUT,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return told.stdout.strip() or None


def begin_record(plan: TrainingPlan) -> dict[str, Any]:
    """Write config.yml, which has all that is needed to repeat a training, at its beginning.

    Returns:
        Its content, for `finish_record`.
    """
    options = plan.options.model_dump(mode="json")
    options |= {"threads": plan.threads, "steps": plan.recipe.steps, "out": str(plan.out)}
    goes_on = plan.options.resume == plan.out
    before = read_record(plan.out) if goes_on else {"id": uuid.uuid4().hex, "commands": []}
    content = {
        ids.strip_module(plan.env_id): plan.recipe.as_dict(),
        RUN_KEY: {
            "id": before["id"],
            "commands": [*before["commands"], training_command(plan.options)],
            "options": options,
            "versions": provenance.library_versions(*RECORDED_LIBRARIES),
            "revision": git_revision(),
            "cores": usable_cores(),
            "machine": f"{platform.system()} {platform.machine()}",
            "steps": 0,
            "seconds": 0.0,
        },
    }
    finish_record(plan, content)
    return content


def finish_record(plan: TrainingPlan, content: dict[str, Any], **facts: Any) -> None:
    """Write config.yml, whole or not at all, with more facts about the run."""
    content[RUN_KEY] |= facts
    text = reading.format_yaml(content)
    with reading.replace_file(plan.out / CONFIG_FILE) as new:
        new.write_text(text, encoding="utf-8")


def training_command(options: TrainingOptions) -> list[str]:
    """Return the command of a training, without folders: of files elsewhere only their names."""
    given = options.model_dump(mode="json", exclude_defaults=True, exclude={"out", "address"})
    words = ["acsar-gym", "train"]
    for name, value in given.items():
        flag = name.replace("_", "-")
        if isinstance(value, bool):
            words.append(f"--{flag}" if value else f"--no-{flag}")
            continue
        values = value if isinstance(value, list) else [value]
        texts = [
            Path(str(one)).name if Path(str(one)).is_absolute() else str(one) for one in values
        ]
        words += (
            [word for text in texts for word in (f"--{flag}", text)]  # a repeated option
            if name == "worlds"
            else [f"--{flag}", *texts]
        )
    return words


def read_record(folder: Path) -> dict[str, Any]:
    """Read what a training has recorded of itself, besides its recipe."""
    path = folder / CONFIG_FILE
    if describe_content(folder) == SEVERAL_SEEDS:
        raise ConfigError(f"{folder}: holds {SEVERAL_SEEDS}: name one, such as {folder}/seed-0")
    data = reading.read_file(path, MAX_CONFIG_BYTES)
    try:
        found: dict[str, Any] = dict(reading.parse_yaml(reading.decode_text(data))[RUN_KEY])
    except (ConfigError, KeyError, TypeError, ValueError) as error:
        said = explain_error(error)
        raise ConfigError(f"{path}: not of 'acsar-gym train': {said}") from error
    return found


def save_results(model: BaseAlgorithm, bundle: Bundle, out: Path) -> tuple[Path, Path]:
    """Write policy.onnx and model.zip into a folder.

    Returns:
        Paths of policy.onnx and model.zip.
    """
    from acsar_gym.tools.policies import sb3  # noqa: PLC0415 - imports torch

    sb3.label(model, bundle)
    policy, zipped = (out / name for name in RESULT_FILES)
    with reading.replace_file(zipped) as new:
        model.save(new)
    sb3.export_policy(model.policy, policy, bundle)
    return policy, zipped


def describe_training(
    model: BaseAlgorithm, plan: TrainingPlan, commands: Sequence[Sequence[str]], seconds: float
) -> TrainingSummary:
    """Describe a training that has just ended, for the bundle of its policy."""
    return TrainingSummary(
        algorithm=type(model).__name__,
        hyperparameters=to_plain_json(plan.recipe.as_dict()),
        steps=model.num_timesteps,
        seed=plan.options.seed,
        command="; ".join(map(shlex.join, commands))[:2_000],
        versions=provenance.library_versions(*RECORDED_LIBRARIES),
        revision=git_revision() or "",
        seconds=seconds,
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def find_start(
    options: TrainingOptions,
) -> tuple[TrainingOptions, ZipPolicy | None, TrainingState | None]:
    """Find out what a training begins with.

    One whose steps are done, but whose policy couldn't be written, as on a full disk, goes on with
    no more steps.

    Returns:
        The options, those of the folder where one is resumed; the model to load, None for a new
        one; and what to restore besides it, None to begin anew.
    """
    folder = options.resume
    if folder is None:
        return options, None, None
    if not folder.is_dir():
        return options, ZipPolicy(folder, trust=options.trust), None
    if options.out is not None and options.out.resolve() != folder.resolve():
        raise ConfigError(f"--out {options.out}: {folder} goes on in its own folder: leave it out")
    recorded = read_record(folder)
    merged = _merge_options(folder, recorded.get("options"), options)
    found = checkpoints.find_checkpoints(folder / CHECKPOINTS_FOLDER)
    if not found:
        raise ConfigError(f"{folder}: has no checkpoint yet: train anew, in another folder")
    newest = found[-1]
    try:
        state = checkpoints.read_state(newest)
    except ConfigError as error:
        raise ConfigError(f"{error}: delete it to go on from the one before") from error
    if state.run != recorded.get("id"):
        raise ConfigError(
            f"{newest}: isn't of the training of {folder / CONFIG_FILE}: move it elsewhere, or "
            f"begin a new training with it: --resume {newest} --trust --out FOLDER"
        )
    saved = ZipPolicy(newest, trust=options.trust)
    whole = recorded.get("finished") and all((folder / name).exists() for name in RESULT_FILES)
    if whole and merged.steps is not None and state.steps >= merged.steps:
        raise ConfigError(
            f"{folder}: its {merged.steps:,} steps are done: ask for more with --steps"
        )
    return merged, saved, state


def _merge_options(folder: Path, recorded: Any, options: TrainingOptions) -> TrainingOptions:
    """Return the options of a folder, changed by what the user gave and may change."""
    with recipes.name_errors(folder / CONFIG_FILE):
        before = TrainingOptions.model_validate(recorded)
    changes = options.model_dump(exclude_defaults=True)
    for name, value in changes.items():
        if name not in CHANGEABLE_OPTIONS and value != getattr(before, name):
            flag = name.replace("_", "-")
            raise ConfigError(
                f"--{flag} {value}: {folder} is of a training with "
                f"{getattr(before, name)}: leave --{flag} away, or train anew"
            )
    changes |= {"out": folder, "conf_file": folder / CONFIG_FILE, "conf_entry": None}
    changes |= dict.fromkeys(("gamma", "learning_rate", "net"))  # in config.yml already
    return before.model_copy(update=changes)
