"""Writes the results of a training: the model to continue from, and the policy to run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:
    from stable_baselines3 import PPO


def save(model: PPO, env_id: str, env: RobotVectorEnv, out: Path) -> tuple[Path, Path]:
    """Write policy.onnx and model.zip into a folder.

    Args:
        model: the trained model.
        env_id: the env that it was trained for, as given to `--env`.
        env: a batch of that env.
        out: an existing folder.

    Returns:
        Paths of policy.onnx and model.zip.

    Raises:
        PolicyError: the policy can't be exported.
    """
    from acsar_gym.policies import sb3_export  # noqa: PLC0415 - imports torch

    zipped, policy = out / "model.zip", out / "policy.onnx"
    replace(zipped, model.save)
    replace(
        policy,
        lambda path: sb3_export.export(model.policy, path, env_id, env.task, env.sensors),
    )
    return policy, zipped


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
