"""`save` and `actor`: networks of any library become policy files."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium

from acsar_gym.config import RobotConfig
from acsar_gym.envs.ids import find_id
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import ConfigError, format_error
from acsar_gym.tools.policies.document import describe_policy
from acsar_gym.tools.policies.onnx import write_policy

if TYPE_CHECKING:
    import torch


def actor(network: torch.nn.Module, call: Callable[[Any, torch.Tensor], Any]) -> torch.nn.Module:
    """Adapt a network of another library to `save`, which wants observations in, actions out.

    For instance TorchRL's, which returns mean and scale before the tanh of its distribution.

    Args:
        network: Any module. Its weights become part of the file.
        call: Called with the network and observations (batch, n), returns actions (batch, 2).

    Returns:
        A module that maps observations (batch, n) to actions (batch, 2).

    Raises:
        MissingExtraError: torch, onnx or onnxscript isn't installed.

    Example:
        import torch
        from acsar_gym.tools import policies

        network = torch.nn.Linear(7, 4)
        module = policies.actor(network, lambda net, seen: net(seen)[:, :2].tanh())
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
    training: Mapping[str, Any] | None = None,
    states: Sequence[tuple[int, ...]] = (),
    **env_kwargs: Any,
) -> None:
    """Write a trained network as an ONNX policy, for `acsar-gym evaluate` and `run`.

    Args:
        module: Maps observations (batch, n) to actions (batch, 2), which are clipped to [-1, 1].
        env_id: The env of the training, such as "acsar_gym/PointGoal-v0".
        path: The ONNX file to write.
        normalizer: Of the observations: (mean, std), (mean, std, clip) or a module. Mean and std
            are numbers or arrays (n,). It becomes part of the file.
        robot: Preset, file or config of the robot that it was trained on.
        training: How it was trained, as values by name.
        states: Shapes of the states of a recurrent module, which maps an observation (1, n) and
            states to an action (1, 2) and the next states.
        **env_kwargs: Other arguments of the env in the training, such as policy_rate=20.0 or
            randomization. The file stores what follows from them.

    Raises:
        ConfigError: There is no such environment, or it doesn't take these arguments.
        PolicyError: The module doesn't fit the env, or can't be exported.
        MissingExtraError: torch, onnx or onnxscript isn't installed.

    Example:
        import torch
        from acsar_gym.tools.policies import OnnxPolicy, save

        save(torch.nn.Linear(7, 2), "point_goal", "linear.onnx")
        assert OnnxPolicy("linear.onnx").env_id == "acsar_gym/PointGoal-v0"
    """
    from acsar_gym.tools.policies import export  # noqa: PLC0415 - optional

    # A wrong normalizer is refused before an env is made.
    scaling = export.make_normalizer(normalizer)
    varied = env_kwargs.get("randomization")
    with planar_env(env_id, robot=robot, **env_kwargs) as env:
        document = describe_policy(env, env_id, randomization=varied, training=training)
    content = export.export_network(module, document, scaling, states)
    write_policy(Path(path), content)


@contextlib.contextmanager
def planar_env(env_id: str, **env_kwargs: Any) -> Iterator[RobotEnv]:
    """Make an env to describe a policy of, and close it.

    Raises:
        ConfigError: There is no such environment, or it doesn't take these arguments.
    """
    # Planar needs no extra, and the document doesn't depend on the body.
    try:
        env = gymnasium.make(find_id(env_id), link="planar", **env_kwargs).unwrapped
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise ConfigError(f"{env_id}: can't be made: {format_error(error)}") from error
    with contextlib.closing(env):
        if not isinstance(env, RobotEnv):
            raise ConfigError(f"{env_id}: not an environment of acsar_gym")
        yield env
