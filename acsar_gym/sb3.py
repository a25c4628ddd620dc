"""stable-baselines3 and the robot: batches to train on, and a trained actor as one ONNX file."""

from __future__ import annotations

import logging
import time
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from acsar_gym.config import RobotConfig
from acsar_gym.errors import ConfigError, MissingExtraError
from acsar_gym.policy import ENV_KEY, LAYOUT_KEY
from acsar_gym.tasks import Task, signature
from acsar_gym.vector import RobotVectorEnv

try:
    import onnx
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
    from stable_baselines3.common.vec_env import VecEnv
    from stable_baselines3.sac.policies import SACPolicy
except ImportError:
    raise MissingExtraError("exporting a stable-baselines3 model", "train") from None


class BatchVecEnv(VecEnv):
    """A RobotVectorEnv as stable-baselines3's VecEnv, with the episode statistics of Monitor.

    The batch must use AutoresetMode.SAME_STEP. Robots whose episode goes on share one empty info;
    those whose episode ends have `terminal_observation`, `episode` (r, l, t), `is_success` and
    `TimeLimit.truncated`. There are no single envs behind it to call methods of.
    """

    def __init__(self, batch: RobotVectorEnv) -> None:
        if batch.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise ConfigError("stable-baselines3 needs autoreset_mode='SameStep'")
        self._batch = batch
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)
        self._actions: NDArray[np.float32] = np.zeros((batch.num_envs, 2), np.float32)
        self._started = time.monotonic()

    def reset(self) -> NDArray[np.float32]:
        """Observations of new episodes, one row a robot."""
        seeded = any(seed is not None for seed in self._seeds)
        observations, _ = self._batch.reset(seed=self._seeds if seeded else None)
        self._reset_seeds()
        return observations

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        """Observations, rewards, dones and infos of one step of every robot."""
        observations, rewards, terminated, truncated, info = self._batch.step(self._actions)
        done = terminated | truncated
        infos = [_GOES_ON] * self.num_envs
        for index in np.flatnonzero(done):
            infos[index] = self._ended(info, int(index))
            infos[index]["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
        return observations, rewards.astype(np.float32), done, infos

    def _ended(self, info: dict[str, Any], index: int) -> dict[str, Any]:
        final = info["final_info"]
        return {
            "terminal_observation": info["final_obs"][index],
            "is_success": bool(final["is_success"][index]),
            "episode": {
                "r": float(final["episode_return"][index]),
                "l": int(final["episode_length"][index]),
                "t": time.monotonic() - self._started,
            },
        }

    def close(self) -> None:
        """Close the batch."""
        self._batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of the batch, once for each index."""
        return [getattr(self._batch, attr_name)] * len(self._indices(indices))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Robots have no attributes of their own."""
        raise ConfigError(f"can't set {attr_name!r}: robots of a batch have no attributes")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Robots have no methods of their own."""
        raise ConfigError(f"can't call {method_name!r}: robots of a batch have no methods")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Nothing is wrapped, though episode statistics are there as with a Monitor."""
        return [wrapper_class.__name__ == "Monitor"] * len(self._indices(indices))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """A batch has no pictures."""
        return [None] * self.num_envs

    def _indices(self, indices: int | Iterable[int] | None) -> list[int]:
        return list(self._get_indices(indices))


_GOES_ON: dict[str, Any] = {}


class _Actor(torch.nn.Module):
    """The deterministic actor of a policy: observation in, mean action out, in [-1, 1]."""

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        policy: Any = self.policy
        if isinstance(policy, ActorCriticPolicy):
            features: Any = policy.extract_features(observation, policy.pi_features_extractor)
            mean = policy.action_net(policy.mlp_extractor.forward_actor(features))
            return torch.tanh(mean) if policy.squash_output else torch.clamp(mean, -1.0, 1.0)
        if isinstance(policy, SACPolicy):
            return torch.tanh(policy.actor.get_action_dist_params(observation)[0])
        action: torch.Tensor = policy.actor(observation)  # TD3's is deterministic
        return action


def _forget_sources(model: Any) -> None:
    """Drop the stack traces that torch keeps in the file: paths of the machine that trained."""
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info):
        del part.metadata_props[:]
    for weight in graph.initializer:
        del weight.metadata_props[:]


def label(model: BaseAlgorithm, task: Task, config: RobotConfig) -> None:
    """Note in a model which env and observation it is for; `model.save` keeps the note."""
    setattr(model, ENV_KEY, task.id)
    setattr(model, LAYOUT_KEY, signature(task, config))


def export(policy: BasePolicy, path: Path, task: Task, config: RobotConfig) -> None:
    """Write the deterministic actor of a trained policy to one ONNX file at `path`.

    The policy is one of PPO, A2C, SAC, TD3 or DDPG.
    The file maps `observation` (batch, n) to `action` (batch, 2), float32, and carries the env's id
    and the observation's signature, which `OnnxPolicy` checks.
    """
    actor = _Actor(policy).eval().cpu()
    example = (torch.zeros(1, *(policy.observation_space.shape or ())),)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it misses torchvision, we don't
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations inside torch's own exporter
        program: Any = torch.onnx.export(
            actor,
            example,
            input_names=["observation"],
            output_names=["action"],
            dynamic_shapes=({0: "batch"},),
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    _forget_sources(model)
    onnx.helper.set_model_props(model, {ENV_KEY: task.id, LAYOUT_KEY: signature(task, config)})
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, path)
