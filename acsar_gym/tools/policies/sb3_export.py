"""Export of stable-baselines3's models as ONNX policies. Imports torch."""

from __future__ import annotations

import io
import pickle
import warnings
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Dict, Space

from acsar_gym import reading
from acsar_gym.envs.ids import full_id, strip_module
from acsar_gym.envs.robot_env import RobotEnv
from acsar_gym.errors import PolicyError, escape_unprintable, format_error, require_extra
from acsar_gym.tools.policies.document import (
    DOCUMENT_KEY,
    PolicyDocument,
    describe_policy,
    parse_document,
)
from acsar_gym.tools.policies.export import Normalizer, Shape, export_network
from acsar_gym.tools.policies.saving import planar_env

with require_extra("stable-baselines3", "train"):
    import torch
    from stable_baselines3.common.base_class import BaseAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
    from stable_baselines3.common.save_util import load_from_zip_file
    from stable_baselines3.common.vec_env import VecNormalize

MAX_STATISTICS_BYTES = 100_000_000
"""Largest accepted VecNormalize file [bytes]; it can contain old observations."""
STATISTICS_PATTERNS = ("*vecnormalize*.pkl", "*/vecnormalize.pkl")
"""Names of VecNormalize files in a model's folder or, as RL Zoo stores them, one folder deeper."""
INFERENCE_OBJECTS = {"learning_rate": 0.0, "lr_schedule": None, "clip_range": 0.0}
"""Replace what only training needs; other Python versions may not unpickle schedules."""


class _Actor(torch.nn.Module):
    """Maps observations (batch, n) to the deterministic actions of a policy."""

    def __init__(self, policy: BasePolicy) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return self.policy._predict(observation, deterministic=True)  # noqa: SLF001


class _RecurrentActor(_Actor):
    """The same for a policy of RecurrentPPO, whose states are those of the actor's LSTM."""

    def forward(  # type: ignore[override]  # takes states
        self, observation: torch.Tensor, hidden: torch.Tensor, cell: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        policy: Any = self.policy
        features = policy.extract_features(observation, policy.pi_features_extractor)
        latent, (hidden, cell) = policy.lstm_actor(features.unsqueeze(0), (hidden, cell))
        action = policy.action_net(policy.mlp_extractor.forward_actor(latent.squeeze(0)))
        return action, hidden, cell


class _StackedActor(torch.nn.Module):
    """The same for a policy that was trained with VecFrameStack.

    Its observation is the last observations side by side, the newest at the end. The others are its
    first state, which is zeros at the start of an episode, as in VecFrameStack.
    """

    def __init__(self, actor: torch.nn.Module, normalizer: torch.nn.Module) -> None:
        super().__init__()
        self.actor = actor
        self.normalizer = normalizer

    def forward(self, observation: torch.Tensor, frames: torch.Tensor, *states: Any) -> Any:
        stacked = torch.cat((frames, observation), 1)
        returned = self.actor(self.normalizer(stacked), *states)
        action, *next_states = returned if isinstance(returned, tuple) else (returned,)
        return action, stacked[:, observation.shape[1] :], *next_states


def label(model: BaseAlgorithm, document: PolicyDocument) -> None:
    """Store in a model what it was trained for and how; `model.save` keeps this."""
    setattr(model, DOCUMENT_KEY, document.as_json())


def export_policy(
    policy: BasePolicy, document: PolicyDocument, normalizer: Normalizer | None = None
) -> bytes:
    """Return the deterministic actor of a model as the content of an ONNX file.

    Args:
        policy: The policy of a model of PPO, A2C, SAC, TD3, DDPG, TQC or RecurrentPPO.
        document: What it was trained for. If its observation is smaller than the policy's, earlier
            observations become a state.
        normalizer: Applied to observations first, or to the stacked observations if it has as many
            numbers as these.

    Raises:
        PolicyError: The policy doesn't fit the document, or can't be exported.
    """
    actor: torch.nn.Module = _Actor(policy)
    states: tuple[Shape, ...] = ()
    lstm: Any = getattr(policy, "lstm_actor", None)
    if lstm is not None:
        actor = _RecurrentActor(policy)
        states = ((lstm.num_layers, 1, lstm.hidden_size),) * 2

    width: int = sum(policy.observation_space.shape or ())
    if width > document.width:
        states = ((1, width - document.width), *states)
        if normalizer is not None and len(normalizer.mean) == width:
            actor = _StackedActor(actor, normalizer)
            normalizer = None
        else:
            actor = _StackedActor(actor, torch.nn.Identity())
    torch.distributions.Distribution.set_default_validate_args(False)  # can't be exported
    try:
        return export_network(actor, document, normalizer, states)
    finally:
        torch.distributions.Distribution.set_default_validate_args(__debug__)


def convert_zip(
    content: bytes,
    path: Path,
    env_id: str = "",
    robot: str | Path | None = None,
    vecnormalize: str | Path | None = None,
) -> bytes:
    """Return the policy of a model's zip as the content of an ONNX file; can run code of the zip.

    Args:
        content: Content of the zip.
        path: Its path, beside which a VecNormalize may be.
        env_id: Id of the env that it is for; by default that of its label.
        robot: Preset or file of the robot of the training, if there is no label.
        vecnormalize: File of the VecNormalize of the training, or "none".

    Raises:
        PolicyError: It can't be converted; the message doesn't name the zip.
    """
    data, policy = _load_zip(content)
    width: int = sum(policy.observation_space.shape or ())
    document = None
    with suppress(PolicyError):  # of an older version: like no label
        document = parse_document({DOCUMENT_KEY: str(data.get(DOCUMENT_KEY))})
    if document is None or (env_id and document.env != strip_module(full_id(env_id))):
        if not env_id:
            raise PolicyError(
                "doesn't say which environment it is for: add --env point_goal or another"
            )
        with planar_env(env_id, robot=robot) as env:
            document = describe_policy(env, env_id, width=_find_width(policy, env))

    file = _find_statistics(data, path, vecnormalize)
    normalizer = None if file is None else read_normalizer(file, {document.width, width})
    return export_policy(policy, document, normalizer)


def _load_zip(content: bytes) -> tuple[dict[str, Any], BasePolicy]:
    """Load the data and the policy of a zip."""
    loading: Any = load_from_zip_file
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about objects that can't be unpickled or are unused
            data, parameters, _ = loading(
                io.BytesIO(content), device="cpu", custom_objects=INFERENCE_OBJECTS
            )
        spaces = (data["observation_space"], data["action_space"])
        if all(isinstance(space, Box) for space in spaces):
            return data, _make_policy(data, spaces, parameters["policy"])
    except Exception as error:
        raise PolicyError(f"not a stable-baselines3 model: {format_error(error)}") from error

    raise PolicyError(
        f"made for {_describe(spaces[0])} and {_describe(spaces[1])}: a policy of this package "
        "gets a row of numbers and gives two"
    )


def _make_policy(data: Mapping[str, Any], spaces: Any, weights: Any) -> BasePolicy:
    """Make the policy of a model without its algorithm."""
    arguments = dict(data["policy_kwargs"])
    if issubclass(data["policy_class"], ActorCriticPolicy):
        arguments["use_sde"] = data["use_sde"]
    policy: BasePolicy = data["policy_class"](*spaces, lambda _: 0.0, **arguments)
    policy.load_state_dict(weights)
    return policy


def _find_width(policy: BasePolicy, env: RobotEnv) -> int:
    """Return how many numbers of an env's observation a policy takes.

    Raises:
        PolicyError: The spaces of the policy aren't those of the env.
    """
    observed: Any = env.observation_space
    space: Any = policy.observation_space
    width = len(space.low)
    frames = 1 if width % len(observed.low) else width // len(observed.low)
    ends = [np.repeat(end, frames)[:width] for end in (observed.low, observed.high)]  # SB3's order
    same = np.array_equal([space.low, space.high], ends) and policy.action_space == env.action_space
    if not same:
        raise PolicyError(
            f"made for {_describe(space)} and actions {_describe(policy.action_space)}, but "
            f"{env.spec.id if env.spec else 'the env'} has {_describe(observed)} and "
            f"{_describe(env.action_space)}: of the wrappers that change observations, only "
            "VecNormalize and VecFrameStack can be part of a policy"
        )
    return width // frames


def _describe(space: Space[Any]) -> str:
    """Describe a space in a few words, however many numbers it has."""
    if isinstance(space, Box):
        return f"Box({space.low.min()}, {space.high.max()}, {space.shape})"
    if isinstance(space, Dict):
        return f"a Dict of {escape_unprintable(', '.join(map(str, space)))[:100]}"
    return f"a {type(space).__name__}"


# VecNormalize


def _find_statistics(data: Mapping[str, Any], path: Path, named: str | Path | None) -> Path | None:
    """Return the VecNormalize file to use; PolicyError if the model needs one that isn't there."""
    if named is not None:
        return None if str(named) == "none" else Path(named)
    if not _is_normalized(data):
        return None
    for pattern in STATISTICS_PATTERNS:
        for file in sorted(path.parent.glob(pattern)):
            return file
    raise PolicyError(
        "was trained with a VecNormalize, whose file isn't beside it: convert it with 'acsar-gym "
        f"policy {path} --out policy.onnx --trust --vecnormalize FILE', or --vecnormalize none if "
        "it changed only rewards"
    )


def _is_normalized(data: Mapping[str, Any]) -> bool:
    """Find out whether a model was trained with a VecNormalize that changes observations.

    A zip contains the last observation as the network got it, and the original one if there was a
    VecNormalize. SAC, TD3, DDPG and TQC always have an original one, so there what the network got
    must have left the observation space.
    """
    normalized = data.get("_last_obs")
    original = data.get("_last_original_obs")
    if normalized is None or original is None or np.array_equal(normalized, original):
        return False
    space = data["observation_space"]
    is_inside = [
        bool(((space.low <= last) & (last <= space.high)).all()) for last in (normalized, original)
    ]
    return "replay_buffer_class" not in data or is_inside == [False, True]


def read_normalizer(path: Path, widths: set[int]) -> Normalizer | None:
    """Read the normalization of observations from a saved VecNormalize, which can run any code.

    Args:
        path: The pickle file.
        widths: Sizes that the observation may have: of one, and of stacked ones.

    Returns:
        The module; None if the VecNormalize doesn't change observations.

    Raises:
        PolicyError: The file can't be read, isn't a VecNormalize, or is for other observations.
    """
    data = reading.read_file(path, MAX_STATISTICS_BYTES, PolicyError)
    try:
        saved: Any = pickle.loads(data)  # noqa: S301 - only with --trust
    except Exception as error:
        raise PolicyError(f"{path}: not a VecNormalize: {format_error(error)}") from error
    if not isinstance(saved, VecNormalize):
        raise PolicyError(f"{path}: contains a {type(saved).__name__}, not a VecNormalize")
    if not saved.norm_obs:
        return None

    statistics: Any = saved.obs_rms
    mean: Any = getattr(statistics, "mean", None)
    shape = np.shape(mean)
    if shape not in {(width,) for width in widths}:
        sizes = " or ".join(f"({width},)" for width in sorted(widths))
        raise PolicyError(f"{path}: for observations of shape {shape}, the model takes {sizes}")
    deviation = np.sqrt(statistics.var + saved.epsilon)
    return Normalizer(mean, deviation, saved.clip_obs)
