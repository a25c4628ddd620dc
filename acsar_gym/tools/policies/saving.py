"""Saves networks of any library based on torch as ONNX policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from acsar_gym.config import RobotConfig
from acsar_gym.envs.base import RobotEnv
from acsar_gym.envs.ids import find_id
from acsar_gym.errors import ConfigError
from acsar_gym.physics import Randomization
from acsar_gym.tools.policies.base import format_error
from acsar_gym.tools.policies.bundle import StateLayout, TrainingSummary
from acsar_gym.tools.policies.describe import describe_policy

if TYPE_CHECKING:
    import torch


def actor(network: torch.nn.Module, call: Callable[[Any, torch.Tensor], Any]) -> torch.nn.Module:
    """Adapt a network of another library to `save`, which wants observations in, actions out.

    For instance TorchRL's, which returns mean and scale before the tanh of its distribution:
    `policies.save(policies.actor(network, lambda net, seen: net(seen)[0].tanh()), ...)`.

    Args:
        network: any module; its weights become part of the file.
        call: called with the network and observations (batch, n); returns actions (batch, 2).

    Returns:
        A module that maps observations (batch, n) to actions (batch, 2).

    Raises:
        MissingExtraError: torch, onnx or onnxscript isn't installed.
    """
    from acsar_gym.tools.policies import export  # noqa: PLC0415 - optional

    return export.Actor(network, call)


def save(
    module: torch.nn.Module,
    env_id: str,
    path: str | Path,
    *,
    normalizer: Sequence[Any] | torch.nn.Module | None = None,
    robot: RobotConfig | str | Path | None = None,
    training: TrainingSummary | None = None,
    state: Sequence[StateLayout] = (),
    **env_kwargs: Any,
) -> None:
    """Write a trained network as an ONNX policy, for `acsar-gym evaluate` and `run`.

    Args:
        module: maps observations (batch, n) to actions (batch, 2), which are clipped to [-1, 1].
        env_id: the env of the training, such as "acsar_gym/PointGoal-v0".
        path: the ONNX file to write.
        normalizer: of the observations: (mean, std), (mean, std, clip) or a module; mean and std
            are numbers or arrays (n,). It becomes part of the file.
        robot: preset, file or config of the robot that it was trained on.
        training: how it was trained.
        state: of a recurrent module, (observation, state, ...) to (action, next state, ...).
        **env_kwargs: other arguments of the env in the training, such as policy_rate=20.0 or
            randomization; the file stores what follows from them.

    Raises:
        ConfigError: there is no such environment.
        PolicyError: the module doesn't fit the env, or uses operations that are refused.
        MissingExtraError: torch, onnx or onnxscript isn't installed.
    """
    from acsar_gym.tools.policies import export  # noqa: PLC0415 - optional

    before = export.make_normalizer(normalizer)
    env, varied = _made(env_id, robot, env_kwargs), env_kwargs.get("randomization")
    try:
        ranges = Randomization.of(varied, env.robot.config)
        bundle = describe_policy(env, env_id, randomization=ranges, training=training, state=state)
        export.write_network(module, Path(path), bundle, before)
    finally:
        env.close()


def _made(env_id: str, robot: Any, env_kwargs: dict[str, Any]) -> RobotEnv:
    """Make the environment; ConfigError for an unknown id and for unknown arguments."""
    try:
        env = gymnasium.make(find_id(env_id), link="planar", robot=robot, **env_kwargs).unwrapped
    except (gymnasium.error.Error, ImportError) as error:
        raise ConfigError(f"{env_id}: {error}") from None
    except TypeError as error:
        raise ConfigError(
            f"{env_id}: doesn't take these arguments: {format_error(error)}"
        ) from None
    if not isinstance(env, RobotEnv):
        env.close()
        raise ConfigError(f"{env_id}: not an environment of acsar_gym")
    return env
