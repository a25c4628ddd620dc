"""Exports actors of stable-baselines3 as ONNX policies. Imports torch."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from acsar_gym import reading
from acsar_gym.errors import MissingExtraError, PolicyError
from acsar_gym.tools.policies import export
from acsar_gym.tools.policies.base import format_error
from acsar_gym.tools.policies.bundle import Bundle, StateLayout

try:
    import torch
    from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
    from stable_baselines3.common.vec_env import VecNormalize
except ImportError:
    raise MissingExtraError("exporting a stable-baselines3 model", "train") from None

MAX_STATISTICS_BYTES = 100_000_000
"""Largest accepted VecNormalize file [bytes]; it can contain old observations."""


class _Actor(torch.nn.Module):
    """The deterministic actor of a policy: observation to mean action in [-1, 1]."""

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__()
        self.policy = policy
        plain = getattr(policy, "plain_actor", None)
        self.plain = None if plain is None else plain()
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


def export_policy(
    policy: BasePolicy, path: Path, bundle: Bundle, normalizer: torch.nn.Module | None = None
) -> None:
    """Write the deterministic actor of a model to one ONNX file.

    The model is of PPO, A2C, SAC, TD3, DDPG, TQC or RecurrentPPO.

    Args:
        policy: the policy of the model.
        path: file to write.
        bundle: what it was trained for and how.
        normalizer: module that is applied to observations (batch, n) first.

    Raises:
        PolicyError: the policy doesn't fit the env, or can't be exported.
    """
    actor = (_RecurrentActor if recurrent_states(policy) else _Actor)(policy)
    bundle = bundle.model_copy(update={"state": recurrent_states(policy)})
    export.write_network(actor, path, bundle, normalizer)


def read_normalizer(path: Path, width: int) -> torch.nn.Module | None:
    """Read the normalization of observations from a saved VecNormalize.

    The file is a pickle: reading it can run any code in it.

    Args:
        path: the pickle file.
        width: size of the observation.

    Returns:
        A module for observations (batch, width); None if the VecNormalize doesn't change
        observations.

    Raises:
        PolicyError: the file can't be read, isn't a VecNormalize, or is for other observations.
    """
    data = reading.read_file(path, MAX_STATISTICS_BYTES, PolicyError)
    try:
        saved: Any = pickle.loads(data)  # noqa: S301 - only with --trust
    except Exception as error:  # noqa: BLE001 - whatever a pickle raises
        raise PolicyError(f"{path}: not a VecNormalize: {format_error(error)}") from None
    if not isinstance(saved, VecNormalize):
        raise PolicyError(f"{path}: holds a {type(saved).__name__}, not a VecNormalize")
    if not saved.norm_obs:
        return None
    rms: Any = saved.obs_rms
    mean: Any = getattr(rms, "mean", None)
    shape = np.shape(mean)
    if shape != (width,):
        raise PolicyError(f"{path}: for observations of shape {shape}, the model takes ({width},)")
    return export.Normalizer(mean, np.sqrt(rms.var + saved.epsilon), saved.clip_obs)
