"""Writes the results of a training: the model to continue from, and the policy to run."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from acsar_gym.policies.bundle import Bundle, Training
from acsar_gym.recording.header import plain, version

if TYPE_CHECKING:
    from stable_baselines3 import PPO


def save(model: PPO, bundle: Bundle, out: Path) -> tuple[Path, Path]:
    """Write policy.onnx and model.zip into a folder.

    Args:
        model: the trained model.
        bundle: what it was trained for and how.
        out: an existing folder.

    Returns:
        Paths of policy.onnx and model.zip.

    Raises:
        PolicyError: the policy can't be exported.
    """
    from acsar_gym.policies import sb3, sb3_export  # noqa: PLC0415 - imports torch

    sb3.label(model, bundle)
    zipped, policy = out / "model.zip", out / "policy.onnx"
    replace(zipped, model.save)
    replace(policy, lambda path: sb3_export.export(model.policy, path, bundle))
    return policy, zipped


def told(model: PPO, hyperparameters: Mapping[str, Any], seconds: float) -> Training:
    """Describe a training that has just ended, for the bundle of its policy.

    Args:
        model: the trained model.
        hyperparameters: of the algorithm, by name.
        seconds: how long it took [s].
    """
    return Training(
        algorithm=type(model).__name__,
        hyperparameters=plain(dict(hyperparameters)),
        steps=model.num_timesteps,
        seed=model.seed,
        command=shlex.join(sys.argv)[:2_000],
        versions=versions(),
        seconds=seconds,
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
    )


def versions() -> dict[str, str]:
    """Return the versions of this package and of the libraries that a training depends on."""
    names = ("gymnasium", "numpy", "stable_baselines3", "torch")
    return {"acsar_gym": version()} | {name: metadata.version(name) for name in names}


def replace(path: Path, write: Callable[[Path], object]) -> None:
    """Replace a file atomically: the old content stays until the new file is complete.

    Args:
        path: file to replace.
        write: writes the new content to the path that it is given.
    """
    new = path.with_name(f".{path.name}")
    try:
        write(new)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
