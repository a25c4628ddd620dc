"""Training with RLlib: batches of robots for its env runners, and what its networks' actions are.

Nothing here imports Ray.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError
from acsar_gym.tools.policies.onnx import actor as adapt_actor

if TYPE_CHECKING:
    import torch


class WithoutInfo(VectorWrapper):
    """A batch with an empty info.

    RLlib copies info for every step of every robot and sends it to the learner, which takes four
    times as long as to simulate the robots.

    Args:
        env: the batch.

    Raises:
        ConfigError: its autoreset mode is SAME_STEP, which puts last observations into info.
    """

    def __init__(self, env: VectorEnv[Any, Any, Any]) -> None:
        if env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
            raise ConfigError("autoreset_mode='SameStep': needs info; RLlib wants 'NextStep'")
        super().__init__(env)

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Begin new episodes; arguments and observations (num_envs, n) as those of the batch."""
        return self.env.reset(**options)[0], {}

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Do one env step of every robot; arguments and results as those of the batch."""
        observations, rewards, terminated, truncated, _ = self.env.step(actions)
        return observations, rewards, terminated, truncated, {}


def make_batch(asked: Mapping[str, Any]) -> WithoutInfo:
    """Make the robots of one env runner, on one thread.

    Register it with `ray.tune.register_env("batch", rllib.make_batch)`, name it with
    `environment("batch", env_config={"id": ...}, normalize_actions=False)`, and have runners step
    batches with `env_runners(gym_env_vectorize_mode="vector_entry_point")`.

    Args:
        asked: the env_config, `id` as `sb3.make_batch` takes it and `options`, a dict of arguments
            of the env and of `RobotVectorEnv`, if any; `num_envs` is set by RLlib.

    Raises:
        ConfigError: for unknown ids and options.
    """
    options = {"threads": 1, **asked.get("options", {})}
    return WithoutInfo(ids.make_vec(ids.find_id(asked["id"]), asked["num_envs"], **options))


def actor(module: torch.nn.Module) -> torch.nn.Module:
    """Return the mean action of RLlib's Gaussian policy, for `policies.save`.

    Args:
        module: the RLModule of a trained algorithm, `algorithm.get_module()`.

    Returns:
        A module that maps observations (batch, n) to actions (batch, 2).

    Raises:
        MissingExtraError: torch, onnx or onnxscript isn't installed.
    """
    # the network gives two means, then two logarithms of deviations
    return adapt_actor(
        module,
        lambda net, seen: net.forward_inference({"obs": seen})["action_dist_inputs"][:, :2],
    )
