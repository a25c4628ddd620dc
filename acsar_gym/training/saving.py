"""What a training leaves: the model to train on, and the policy to drive with."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from acsar_gym.vector.env import RobotVectorEnv

if TYPE_CHECKING:
    from stable_baselines3 import PPO


def save(model: PPO, env_id: str, env: RobotVectorEnv, out: Path) -> tuple[Path, Path]:
    """Write policy.onnx and model.zip into a folder; returns both.

    Args:
        model: what was trained.
        env_id: what it was trained for, as `--env` takes it.
        env: a batch of that id.
        out: the folder, which exists.

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
    """Write a file whole or not at all: what was there before stays until then."""
    new = path.with_name(f".{path.name}")
    try:
        write(new)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)
