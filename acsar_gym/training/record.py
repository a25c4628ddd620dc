"""config.yml beside a training: everything that is needed to repeat it."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import acsar_gym
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError
from acsar_gym.evaluation import provenance
from acsar_gym.reading import bounded, structured
from acsar_gym.training.options import Options
from acsar_gym.training.plan import Plan
from acsar_gym.vector.settings import cores

FILE = "config.yml"
RUN = "run"
"""Key of what isn't a recipe. The recipe is beside it, so that the file can be a --conf-file."""
LIBRARIES = ("torch", "stable-baselines3", "sb3-contrib", "numba")
"""Their versions are recorded, besides those of every result."""
MOST_BYTES = 1_000_000
"""Largest accepted config.yml [bytes]."""
PATIENCE = 5.0
"""Time limit of git [s]."""


def revision() -> str | None:
    """Return the git revision of the package, with "-dirty" where files differ; None outside."""
    folder = Path(acsar_gym.__file__).resolve().parent.parent
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        told = subprocess.run(
            [*command, "--exclude=*"], capture_output=True, text=True, timeout=PATIENCE, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return told.stdout.strip() or None


def begin(plan: Plan) -> dict[str, Any]:
    """Write config.yml at the beginning of a training.

    Args:
        plan: the training.

    Returns:
        Its content, for `finish`.
    """
    options = {each.name: _plain(getattr(plan.options, each.name)) for each in fields(Options)}
    options |= {"threads": plan.threads, "steps": plan.recipe.steps, "out": str(plan.out)}
    content = {
        ids.without_module(plan.env_id): plan.recipe.as_dict(),
        RUN: {
            "commands": [*_before(plan), command()],
            "options": options,
            "versions": provenance.versions(*LIBRARIES),
            "revision": revision(),
            "cores": cores(),
            "machine": f"{platform.system()} {platform.machine()}",
            "steps": 0,
            "seconds": 0.0,
        },
    }
    _write(plan.out, content)
    return content


def command() -> list[str]:
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
        if name == "--out":
            _ = equals or next(words, "")
        else:
            kept.append(f"{name}={_file(value)}" if equals else _file(word))
    return ["acsar-gym", *kept]


def _file(word: str) -> str:
    """Shorten an absolute path to its name."""
    return Path(word).name if Path(word).is_absolute() else word


def _before(plan: Plan) -> list[Any]:
    """Return the commands of a training that goes on."""
    if plan.options.resume != plan.out:
        return []
    commands: list[Any] = read(plan.out)["commands"]
    return commands


def finish(plan: Plan, content: dict[str, Any], **facts: Any) -> None:
    """Write config.yml again at the end of a training, with more facts about the run."""
    content[RUN] |= facts
    _write(plan.out, content)


def finished(folder: Path) -> bool:
    """Return whether a training wrote all that it leaves; `options` has read its folder."""
    return bool(read(folder).get("finished"))


def read(folder: Path) -> dict[str, Any]:
    """Read what a training has recorded of itself, besides its recipe.

    Raises:
        ConfigError: the folder has no config.yml of a training.
    """
    path = folder / FILE
    data = bounded.read(path, MOST_BYTES)
    try:
        found: dict[str, Any] = dict(structured.from_yaml(structured.decoded(data))[RUN])
    except (ConfigError, KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path}: not of 'acsar-gym train': {bounded.reason(error)}") from None
    return found


def options(folder: Path) -> Options:
    """Read the options of a training from its folder.

    Raises:
        ConfigError: it has no config.yml of a training.
    """
    path = folder / FILE
    try:
        given = read(folder)["options"]
        paths = ("conf_file", "out", "resume")
        given |= {name: Path(given[name]) for name in paths if given[name] is not None}
        given |= {name: tuple(each) for name, each in given.items() if isinstance(each, list)}
        return Options(**given)
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{path}: not of 'acsar-gym train': {bounded.reason(error)}") from None


def _write(out: Path, content: Mapping[str, Any]) -> None:
    """Write config.yml, whole or not at all."""
    text = structured.to_yaml(content)
    with bounded.replacing(out / FILE) as new:
        new.write_text(text, encoding="utf-8")


def _plain(value: Any) -> Any:
    """Convert a value to one that YAML has."""
    if isinstance(value, tuple):
        return list(value)
    return str(value) if isinstance(value, Path) else value
