"""The folder of a training: its record, its results, and what `--resume` takes from them."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import acsar_gym
from acsar_gym import reading
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError
from acsar_gym.recording.messages import to_plain_json
from acsar_gym.tools.evaluation import provenance
from acsar_gym.tools.policies import ZipPolicy
from acsar_gym.tools.policies.bundle import Bundle, TrainingSummary
from acsar_gym.tools.training import checkpoints, recipes
from acsar_gym.tools.training.checkpoints import CHECKPOINTS_FOLDER, TrainingState
from acsar_gym.tools.training.folder import (
    CONFIG_FILE,
    MAX_CONFIG_BYTES,
    RESULT_FILES,
    SEVERAL_SEEDS,
    describe_content,
)
from acsar_gym.tools.training.plan import TrainingOptions, TrainingPlan
from acsar_gym.vector.threads import usable_cores

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

RUN_KEY = "run"
"""Key of what isn't a recipe. The recipe is beside it, so that the file can be a --conf-file."""
RECORDED_LIBRARIES = ("torch", "stable-baselines3", "sb3-contrib", "numba")
"""Their versions are recorded, besides those of every result."""
GIT_TIMEOUT = 5.0
"""Time limit of git [s]."""
CHANGEABLE_OPTIONS = (
    "steps",
    "target",
    "threads",
    "progress",
    "checkpoint_seconds",
    "resume",
    "trust",
    "device",
    "out",
)
"""Options that may change when a training goes on."""


@dataclass(frozen=True)
class TrainingStart:
    """What a training begins with."""

    options: TrainingOptions
    """The user's; those of the folder where one is resumed."""
    saved: ZipPolicy | None = None
    """The model to load; None for a new one."""
    state: TrainingState | None = None
    """What to restore besides the model; None to begin anew."""


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
            "commands": [*before["commands"], training_command()],
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


def training_command() -> list[str]:
    """Return the command that began this training, without the folders of one machine.

    Neither has it the folder that it writes to, and of files elsewhere only their names. Of another
    program than this package's own, such as a notebook's or a worker's of Ray, only its name is
    told: its options aren't those of the training, and may hold addresses and passwords.
    """
    program, begin = Path(sys.argv[0]), sys.argv[1:]
    if program.name != "acsar-gym" and program.parts[-2:] != ("acsar_gym", "__main__.py"):
        return [program.name]
    words, kept = iter(begin), list[str]()
    for word in words:
        name, equals, value = word.partition("=")
        path = Path(value if equals else word)
        if name == "--out":
            _ = equals or next(words, "")
        else:
            said = path.name if path.is_absolute() else (value if equals else word)
            kept.append(f"{name}={said}" if equals else said)
    return ["acsar-gym", *kept]


def read_record(folder: Path) -> dict[str, Any]:
    """Read what a training has recorded of itself, besides its recipe."""
    path = folder / CONFIG_FILE
    if describe_content(folder) == SEVERAL_SEEDS:
        raise ConfigError(f"{folder}: holds {SEVERAL_SEEDS}: name one, such as {folder}/seed-0")
    data = reading.read_file(path, MAX_CONFIG_BYTES)
    try:
        found: dict[str, Any] = dict(reading.parse_yaml(reading.decode_text(data))[RUN_KEY])
    except (ConfigError, KeyError, TypeError, ValueError) as error:
        said = reading.explain_error(error)
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


def find_start(options: TrainingOptions) -> TrainingStart:
    """Find out what a training begins with.

    One whose steps are done, but whose policy couldn't be written, as on a full disk, goes on with
    no more steps.
    """
    folder = options.resume
    if folder is None:
        return TrainingStart(options)
    if not folder.is_dir():
        return TrainingStart(options, ZipPolicy(folder, trust=options.trust))
    if options.out is not None and options.out.resolve() != folder.resolve():
        raise ConfigError(f"--out {options.out}: {folder} goes on in its own folder: leave it out")
    recorded = read_record(folder)
    merged = _merge_options(folder, recorded.get("options"), options)
    found = checkpoints.find_checkpoints(folder / CHECKPOINTS_FOLDER)
    if not found:
        raise ConfigError(f"{folder}: has no checkpoint yet: train anew, in another folder")
    states = []
    for number, path in enumerate(found):
        try:
            states.append(checkpoints.read_state(path))
        except ConfigError as error:
            instead = f": delete it to go on from {found[number - 1]}" if number else ""
            raise ConfigError(f"{error}{instead}") from error
        if states[-1].run != recorded.get("id"):
            raise ConfigError(
                f"{path}: isn't of the training of {folder / CONFIG_FILE}: move it elsewhere, or "
                f"begin a new training with it: --resume {path} --trust --out FOLDER"
            )
    newest, state = found[-1], states[-1]
    saved = ZipPolicy(newest, trust=options.trust)
    whole = recorded.get("finished") and all((folder / name).exists() for name in RESULT_FILES)
    if whole and merged.steps is not None and state.steps >= merged.steps:
        raise ConfigError(
            f"{folder}: its {merged.steps:,} steps are done: ask for more with --steps"
        )
    return TrainingStart(merged, saved, state)


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
