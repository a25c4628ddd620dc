"""Training with stable-baselines3: batches of robots as a VecEnv, and the export of its models."""

from __future__ import annotations

import pickle
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

from acsar_gym import reading
from acsar_gym.envs import ids
from acsar_gym.errors import ConfigError, PolicyError, format_error, require_extra
from acsar_gym.tools.policies.bundle import BUNDLE_KEY, Bundle, StateLayout
from acsar_gym.vector.env import RobotVectorEnv

with require_extra("stable-baselines3", "train"):
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
    from stable_baselines3.common.vec_env import VecEnv, VecNormalize

MAX_STATISTICS_BYTES = 100_000_000
"""Largest accepted VecNormalize file [bytes]; it can contain old observations."""
_GOES_ON: dict[str, Any] = {}
"""Info of a robot whose episode goes on."""


class BatchVecEnv(VecEnv):
    """A RobotVectorEnv as stable-baselines3's VecEnv, with the episode statistics of Monitor.

    The batch may be inside Gymnasium's vector wrappers; `make_batch` makes one. It must use
    AutoresetMode.SAME_STEP. While an episode goes on, the info of its robot is one shared empty
    dict; at its end the info has `terminal_observation`, `episode` (r, l, t), `is_success`,
    `TimeLimit.truncated`, and, where the batch has them, the number of its `world` and the `drawn_`
    keys of its randomization. There are no single envs, so methods of single envs can't be called.

    Args:
        batch: the batch to wrap.

    Raises:
        ConfigError: it isn't a RobotVectorEnv, or has another autoreset mode.
    """

    def __init__(self, batch: VectorEnv[Any, Any, Any]) -> None:
        if not isinstance(batch.unwrapped, RobotVectorEnv):
            raise ConfigError(f"{batch}: not a batch of acsar_gym; use sb3.make_batch")
        if batch.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise ConfigError("stable-baselines3 needs autoreset_mode='SameStep'")
        self._batch: Any = batch  # Any: VectorEnv types `seed` as int, ours also takes a list
        super().__init__(batch.num_envs, batch.single_observation_space, batch.single_action_space)
        self._actions: NDArray[np.float32] = np.zeros((batch.num_envs, 2), np.float32)
        self._asked: dict[str, Any] = {}
        self._started = time.monotonic()

    @property
    def robots(self) -> RobotVectorEnv:
        """The batch, without Gymnasium's wrappers."""
        robots: RobotVectorEnv = self._batch.unwrapped
        return robots

    def reset(self) -> NDArray[np.float32]:
        """Start a new episode of every robot, with the seeds and options that were set before.

        Returns:
            Observations, float32 (robots, n).
        """
        seeded = any(seed is not None for seed in self._seeds)
        seeds = self._seeds if seeded else None
        observations: NDArray[np.float32]
        observations, _ = self._batch.reset(seed=seeds, options=self._asked)
        self._reset_seeds()
        return observations

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Set the options of `RobotVectorEnv.reset` for all later episodes.

        Running episodes aren't affected.

        Args:
            options: one dict, whose values may have one row per robot; None removes the
                options.

        Raises:
            ConfigError: for unknown options, for a list, and for "reset_mask", as reset()
                always resets all robots.
        """
        if isinstance(options, list):
            raise ConfigError(
                "set_options: give one dict for all robots, whose values may have a row for each, "
                'such as {"world": [1000, 1001]}'
            )
        if options and "reset_mask" in options:
            raise ConfigError("set_options: 'reset_mask' isn't one here: all robots are reset")
        self._batch.unwrapped.set_options(options or {})
        self._asked = dict(options or {})

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Store actions (robots, 2) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, Any, Any, list[dict[str, Any]]]:
        """Step every robot once.

        Returns:
            Observations (robots, n), rewards (robots,), dones (robots,), and one info per
            robot.
        """
        observations, rewards, terminated, truncated, info = self._batch.step(self._actions)
        done = terminated | truncated
        infos = [_GOES_ON] * self.num_envs
        for index in np.flatnonzero(done):
            final = info["final_info"]
            infos[index] = {
                "terminal_observation": info["final_obs"][index],
                "is_success": bool(final["is_success"][index]),
                "TimeLimit.truncated": bool(truncated[index] and not terminated[index]),
                "episode": {
                    "r": float(final["episode_return"][index]),
                    "l": int(final["episode_length"][index]),
                    "t": time.monotonic() - self._started,
                },
                **{name: final[name][index] for name in final if name.startswith("drawn_")},
                **({"world": int(final["world"][index])} if "world" in final else {}),
            }
        return observations, rewards.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the batch."""
        self._batch.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the batch, repeated for each index."""
        holder = self._batch if hasattr(self._batch, attr_name) else self._batch.unwrapped
        return [getattr(holder, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not supported: robots of a batch have no attributes of their own."""
        raise ConfigError(f"can't set {attr_name!r}: robots of a batch have no attributes")

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Not supported: robots of a batch have no methods of their own."""
        raise ConfigError(f"can't call {method_name!r}: robots of a batch have no methods")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return True for Monitor, whose episode statistics are included, and False for others."""
        return [wrapper_class.__name__ == "Monitor"] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        """Return a picture for each robot, of which the first 16 are drawn.

        None for each where the batch was made without `render_mode="rgb_array"`.
        """
        return self._batch.render() or [None] * self.num_envs


def make_batch(env_id: str, num_envs: int, **options: Any) -> BatchVecEnv:
    """Make a batch of planar robots for training with stable-baselines3, in one process.

    Args:
        env_id: "point_goal", "acsar_gym/PointGoal-v0", or another package's id with the module
            that registers it, as in "mine.module:mine/Clearance-v0".
        num_envs: number of robots.
        **options: arguments of the env and of `RobotVectorEnv`: robot, worlds, randomization,
            threads, ...

    Returns:
        The batch, for the `env` argument of an algorithm.

    Raises:
        ConfigError: for unknown ids and options.
    """
    options = {"autoreset_mode": AutoresetMode.SAME_STEP, **options}
    return BatchVecEnv(ids.make_vec(ids.find_id(env_id), num_envs, **options))


def label(model: BaseAlgorithm, bundle: Bundle) -> None:
    """Store in a model what it was trained for and how; `model.save` keeps this."""
    setattr(model, BUNDLE_KEY, bundle.as_json())


class _Actor(torch.nn.Module):
    """The deterministic actor of a policy: observation to mean action in [-1, 1]."""

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__()
        self.policy = policy
        plain: Any = getattr(policy, "plain_actor", None)
        self.plain: torch.nn.Module | None = None if plain is None else plain()
        """Layers that do the same in less time, of a policy that has them (`MirrorPolicy`)."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Map observations (batch, n) to mean actions (batch, 2)."""
        policy: Any = self.policy
        if isinstance(policy, ActorCriticPolicy):
            features: Any = policy.extract_features(observation, policy.pi_features_extractor)
            if self.plain is not None:
                mean = self.plain(features)
            else:
                mean = policy.action_net(policy.mlp_extractor.forward_actor(features))
            return torch.tanh(mean) if policy.squash_output else mean
        if hasattr(policy.actor, "get_action_dist_params"):  # SAC, TQC
            return torch.tanh(policy.actor.get_action_dist_params(observation)[0])
        action: torch.Tensor = policy.actor(observation)  # TD3's is deterministic
        return action


class _RecurrentActor(torch.nn.Module):
    """The same for a policy of RecurrentPPO, whose state is that of the actor's LSTM."""

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__()
        self.policy = policy

    def forward(
        self, observation: torch.Tensor, hidden: torch.Tensor, cell: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Map an observation (1, n) and the states to the mean action (1, 2) and next states."""
        policy: Any = self.policy
        features = policy.extract_features(observation, policy.pi_features_extractor)
        latent, (hidden, cell) = policy.lstm_actor(features.unsqueeze(0), (hidden, cell))
        mean = policy.action_net(policy.mlp_extractor.forward_actor(latent.squeeze(0)))
        return torch.tanh(mean) if policy.squash_output else mean, hidden, cell


def recurrent_states(policy: BasePolicy) -> tuple[StateLayout, ...]:
    """Describe the states of a policy of RecurrentPPO; none for others."""
    lstm = getattr(policy, "lstm_actor", None)
    if lstm is None:
        return ()
    shape = (lstm.num_layers, 1, lstm.hidden_size)
    names = (("hidden", "next_hidden"), ("cell", "next_cell"))
    return tuple(StateLayout(input=old, output=new, shape=shape) for old, new in names)


class _StackedActor(torch.nn.Module):
    """The same for a policy that was trained with VecFrameStack.

    Its observation is the last ones side by side, the newest at the end. The others are its state,
    zeros at the start of an episode, as VecFrameStack has them.
    """

    def __init__(self, actor: torch.nn.Module, normalizer: torch.nn.Module | None) -> None:
        super().__init__()
        self.actor, self.normalizer = actor, normalizer

    def forward(self, observation: torch.Tensor, frames: torch.Tensor, *states: Any) -> Any:
        """Map an observation (1, n), earlier ones and other states to action and next states."""
        stacked = torch.cat((frames, observation), 1)
        seen = stacked if self.normalizer is None else self.normalizer(stacked)
        given = self.actor(seen, *states)
        action, *after = given if isinstance(given, tuple) else (given,)
        return action, stacked[:, observation.shape[1] :], *after


def export_policy(
    policy: BasePolicy, path: Path, bundle: Bundle, normalizer: torch.nn.Module | None = None
) -> None:
    """Write the deterministic actor of a model to one ONNX file.

    The model is of PPO, A2C, SAC, TD3, DDPG, TQC or RecurrentPPO. One that was trained with
    VecFrameStack, whose observation is several of those of the bundle, gets a state.

    Args:
        policy: the policy of the model.
        path: file to write.
        bundle: what it was trained for and how.
        normalizer: module that is applied to observations (batch, n) first, or to the stacked ones,
            where its mean has as many numbers as these.

    Raises:
        PolicyError: the policy doesn't fit the env, or can't be exported.
    """
    from acsar_gym.tools.policies import export  # noqa: PLC0415 - optional: onnx

    states = recurrent_states(policy)
    actor: torch.nn.Module = (_RecurrentActor if states else _Actor)(policy)
    width, stacked = bundle.observation.width, sum(policy.observation_space.shape or ())
    if stacked > width:
        frames = StateLayout(input="frames", output="next_frames", shape=(1, stacked - width))
        states = (frames, *states)
        whole = isinstance(normalizer, export.Normalizer) and normalizer.mean.numel() == stacked
        if normalizer is not None and whole:  # VecNormalize around VecFrameStack
            bundle = export.describe_normalizer(bundle, normalizer)
        actor = _StackedActor(actor, normalizer if whole else None)
        normalizer = None if whole else normalizer
    bundle = bundle.model_copy(update={"state": states})
    export.write_network(actor, path, bundle, normalizer)


def read_normalizer(path: Path, width: int, frames: int = 1) -> torch.nn.Module | None:
    """Read the normalization of observations from a saved VecNormalize.

    The file is a pickle: reading it can run any code in it.

    Args:
        path: the pickle file.
        width: size of the observation.
        frames: how many of them VecFrameStack gives the model at once.

    Returns:
        A module for observations (batch, width) or stacked ones (batch, frames * width); None if
        the VecNormalize doesn't change observations.

    Raises:
        PolicyError: the file can't be read, isn't a VecNormalize, or is for other observations.
    """
    from acsar_gym.tools.policies import export  # noqa: PLC0415 - optional: onnx

    data = reading.read_file(path, MAX_STATISTICS_BYTES, PolicyError)
    try:
        saved: Any = pickle.loads(data)  # noqa: S301 - only with --trust
    except Exception as error:
        raise PolicyError(f"{path}: not a VecNormalize: {format_error(error)}") from error
    if not isinstance(saved, VecNormalize):
        raise PolicyError(f"{path}: holds a {type(saved).__name__}, not a VecNormalize")
    if not saved.norm_obs:
        return None
    rms: Any = saved.obs_rms
    mean: Any = getattr(rms, "mean", None)
    shape = np.shape(mean)
    if shape not in ((width,), (frames * width,)):
        takes = " or ".join(f"({size},)" for size in dict.fromkeys((width, frames * width)))
        raise PolicyError(f"{path}: for observations of shape {shape}, the model takes {takes}")
    return export.Normalizer(mean, np.sqrt(rms.var + saved.epsilon), saved.clip_obs)
