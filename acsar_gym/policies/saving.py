"""Policies of other libraries: a torch module becomes a file that drives."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from acsar_gym.config import RobotConfig
from acsar_gym.envs.base import RobotEnv
from acsar_gym.envs.ids import full_id, registered, without_module
from acsar_gym.errors import ConfigError
from acsar_gym.policies.base import ENV_KEY, RATE_KEY, SCALE_KEY, one_line, scale_of

if TYPE_CHECKING:
    import torch


def save(
    module: torch.nn.Module,
    env_id: str,
    path: str | Path,
    *,
    normalizer: Sequence[Any] | torch.nn.Module | None = None,
    robot: RobotConfig | str | Path | None = None,
    **env_kwargs: Any,
) -> None:
    """Write a trained network as an ONNX policy, for `acsar-gym evaluate` and `run`.

    Args:
        module: maps observations (batch, n) to actions (batch, 2), the deterministic ones; what
            lies beyond [-1, 1] is clipped.
        env_id: what it was trained for, such as "acsar_gym/PointGoal-v0".
        path: the ONNX file.
        normalizer: what observations went through before: (mean, std) or (mean, std, clip), mean
            and std each a number or one for each number of the observation, clip a number or
            None; or a module. Becomes part of the file.
        robot: preset, file or config of the robot that it was trained on.
        **env_kwargs: other arguments of the env, as `gymnasium.make` had them for the training,
            such as goal_distance=(0.5, 10.0) or policy_rate=20.0. The file keeps what they scale
            distances by, and the rate.

    Raises:
        ConfigError: there is no such environment.
        PolicyError: the module doesn't fit the environment, or needs what a policy mustn't.
        MissingExtraError: torch, onnx or onnxscript isn't installed.
    """
    from acsar_gym.policies import torch_export  # noqa: PLC0415 - optional

    before = torch_export.normalizing(normalizer)
    env = _made(env_id, robot, env_kwargs)
    try:
        notes = {ENV_KEY: without_module(full_id(env_id)), **_notes(env)}
        torch_export.write(module, Path(path), env.task, env.sensors, before, notes)
    finally:
        env.close()


def _made(env_id: str, robot: Any, env_kwargs: dict[str, Any]) -> RobotEnv:
    """The environment; ConfigError where there is none of that id, or it takes other arguments."""
    try:
        env = gymnasium.make(registered(env_id), link="planar", robot=robot, **env_kwargs).unwrapped
    except (gymnasium.error.Error, ImportError) as error:
        raise ConfigError(f"{env_id}: {error}") from None
    except TypeError as error:
        raise ConfigError(f"{env_id}: doesn't take these arguments: {one_line(error)}") from None
    if not isinstance(env, RobotEnv):
        env.close()
        raise ConfigError(f"{env_id}: not an environment of acsar_gym")
    return env


def _notes(env: RobotEnv) -> dict[str, str]:
    """What the env's arguments change about an observation, but not about its signature."""
    scale = scale_of(env.task)
    rate = env.robot.config.control_rate / env.ticks_per_step
    return {RATE_KEY: repr(float(rate))} | (
        {} if scale is None else {SCALE_KEY: repr(float(scale))}
    )
